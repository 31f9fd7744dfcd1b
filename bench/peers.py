"""Other libraries' DQN with the report's settings, as contestants for run.py.

Runs in .venv-bench. Once warm it prints a line; then each line {"seconds": 2.0} that it reads is
one round, answered by {"rate": 812.3}: steps a second, each with one update. In between it sleeps.

    .venv-bench/bin/python bench/peers.py rejax --threads 1
"""

import argparse
import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

from race import serve, timed

TORQUES = 11
CHUNK = 600
"""Steps between two looks at the clock."""

EPSILON = 0.32
"""The mean of the report's, which decays; it matters, as exploring saves a pass of the network."""


def gymnasium_dqn(library: str) -> Callable[[], int]:
    """Steps of stable-baselines3 or of sbx, which has the same interface."""
    import gymnasium
    import numpy as np

    class Torques(gymnasium.ActionWrapper):
        """The pendulum with a choice of torques."""

        def __init__(self, env: Any) -> None:
            super().__init__(env)
            self.action_space = gymnasium.spaces.Discrete(TORQUES)

        def action(self, action: Any) -> Any:
            return np.array([4 * action / (TORQUES - 1) - 2], np.float32)

    model = import_module(library).DQN(
        "MlpPolicy",
        Torques(gymnasium.make("Pendulum-v1", disable_env_checker=True)),
        learning_rate=1e-3,
        buffer_size=50_000,
        learning_starts=64,
        batch_size=64,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=200,
        gamma=0.99,
        exploration_initial_eps=EPSILON,
        exploration_final_eps=EPSILON,
        policy_kwargs={"net_arch": [256, 256]},
        device="cpu",
        seed=0,
    )

    def advance() -> int:
        model.learn(CHUNK, reset_num_timesteps=False)
        return CHUNK

    return advance


def rejax_dqn() -> Callable[[], int]:
    import jax
    from gymnax.environments.classic_control.pendulum import Pendulum
    from gymnax.environments.spaces import Discrete
    from rejax import DQN
    from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy

    class Torques(Pendulum):
        """The pendulum with a choice of torques."""

        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            return super().step_env(key, state, 4 * action / (TORQUES - 1) - 2, params)

        def action_space(self, params: Any = None) -> Any:
            return Discrete(TORQUES)

    dqn = DQN.create(
        env=Torques(),
        learning_rate=1e-3,
        gamma=0.99,
        num_envs=1,
        num_epochs=1,
        batch_size=64,
        buffer_size=50_000,
        fill_buffer=64,
        target_update_freq=200,
        polyak=0.0,
        ddqn=False,
        eps_start=EPSILON,
        eps_end=EPSILON,
        total_timesteps=CHUNK,
        eval_freq=CHUNK,
        skip_initial_evaluation=True,
    ).replace(
        # `create` offers neither another network size nor a run without evaluations.
        agent=EpsilonGreedyPolicy(DiscreteQNetwork)(
            hidden_layer_sizes=(256, 256), action_dim=TORQUES, activation=jax.nn.relu
        ),
        eval_callback=lambda *_: (),
    )
    train = jax.jit(lambda state: dqn.train(train_state=state)[0])
    state = dqn.init_state(jax.random.key(0))

    def advance() -> int:
        nonlocal state
        state = jax.block_until_ready(train(state))
        return CHUNK

    return advance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("library", choices=("stable_baselines3", "sbx", "rejax"))
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    answers, sys.stdout = sys.stdout, sys.stderr  # a library may print, too

    # torch reads the one, jax the other; jax knows only one thread or one for each core.
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)
    if arguments.threads == 1:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"

    library = arguments.library
    advance = rejax_dqn() if library == "rejax" else gymnasium_dqn(library)
    for _ in range(3):  # fills the replay beyond learning's start and compiles
        advance()
    serve(timed(advance), answers)


if __name__ == "__main__":
    main()
