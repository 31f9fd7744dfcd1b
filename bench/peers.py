"""Other libraries' algorithms with the same settings as qfolio's, as contestants for run.py.

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

_OFF_POLICY = {
    "learning_rate": 1e-3, "buffer_size": 50_000, "learning_starts": 256, "batch_size": 256,
    "tau": 0.005, "gamma": 0.99, "train_freq": 1, "gradient_steps": 1, "net_arch": [256, 256],
}  # fmt: skip

SETTINGS: dict[str, dict[str, Any]] = {
    "dqn": {
        "learning_rate": 1e-3,
        "buffer_size": 50_000,
        "learning_starts": 64,
        "batch_size": 64,
        "train_freq": 1,
        "gradient_steps": 1,
        "target_update_interval": 200,
        "gamma": 0.99,
        "exploration_initial_eps": EPSILON,
        "exploration_final_eps": EPSILON,
        "net_arch": [256, 256],
    },
    "ppo": {
        "num_envs": 4,
        "n_steps": 1024,
        "n_epochs": 10,
        "batch_size": 64,
        "gamma": 0.9,
        "gae_lambda": 0.95,
        "learning_rate": 1e-3,
        "ent_coef": 0.0,
        "net_arch": [64, 64],
    },
    "sac": _OFF_POLICY,
    "td3": _OFF_POLICY,
    "ddpg": _OFF_POLICY,
    "dqn-CartPole-v1": {
        "learning_rate": 1e-3,
        "buffer_size": 50_000,
        "learning_starts": 1000,
        "batch_size": 64,
        "train_freq": 1,
        "gradient_steps": 1,
        "target_update_interval": 200,
        "gamma": 0.99,
        "net_arch": [64, 64],
    },
    "ppo-CartPole-v1": {
        "num_envs": 8,
        "n_steps": 128,
        "n_epochs": 10,
        "batch_size": 64,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "learning_rate": 1e-3,
        "ent_coef": 0.0,
        "net_arch": [64, 64],
    },
    "sac-Pendulum-v1": {
        **_OFF_POLICY,
        "learning_rate": 2e-3,
        "batch_size": 128,
        "tau": 0.02,
        "gamma": 0.98,
        "train_freq": 4,
        "gradient_steps": 4,
        "net_arch": [64, 64],
    },
}
"""By algorithm, and where that is not the pendulum, environment; in stable-baselines3's names.

Of PPO on the pendulum they are those of rl-baselines3-zoo.
"""


def gymnasium(library: str, algorithm: str) -> Callable[[], int]:
    """Steps of stable-baselines3 or of sbx, which has the same interface."""
    import gymnasium as gym
    import numpy as np

    class Torques(gym.ActionWrapper):
        """The pendulum with a choice of torques."""

        def __init__(self, env: Any) -> None:
            super().__init__(env)
            self.action_space = gym.spaces.Discrete(TORQUES)

        def action(self, action: Any) -> Any:
            return np.array([4 * action / (TORQUES - 1) - 2], np.float32)

    name, _, where = algorithm.partition("-")
    settings = SETTINGS[algorithm]
    if where:
        from stable_baselines3.common.env_util import make_vec_env

        env: Any = make_vec_env(where, settings.get("num_envs", 1))
    elif name == "ppo":
        from stable_baselines3.common.env_util import make_vec_env

        env = make_vec_env("Pendulum-v1", settings["num_envs"])
    else:
        env = gym.make("Pendulum-v1", disable_env_checker=True)
        env = Torques(env) if name == "dqn" else env
    kept = {key: value for key, value in settings.items() if key != "num_envs"}
    relu = import_module("torch.nn").ReLU if library != "sbx" else import_module("jax").nn.relu
    policy = {"net_arch": kept.pop("net_arch"), "activation_fn": relu}
    model = getattr(import_module(library), name.upper())(
        "MlpPolicy", env, **kept, policy_kwargs=policy, device="cpu", seed=0
    )
    chunk = settings.get("n_steps", CHUNK) * settings.get("num_envs", 1)

    def advance() -> int:
        model.learn(chunk, reset_num_timesteps=False)
        return chunk

    return advance


def rejax(algorithm: str) -> Callable[[], int]:
    import jax
    import rejax as library
    from gymnax.environments.classic_control.pendulum import Pendulum
    from gymnax.environments.spaces import Discrete
    from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy

    class Torques(Pendulum):
        """The pendulum with a choice of torques."""

        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            return super().step_env(key, state, 4 * action / (TORQUES - 1) - 2, params)

        def action_space(self, params: Any = None) -> Any:
            return Discrete(TORQUES)

    chunk, settings = CHUNK, SETTINGS[algorithm]
    if algorithm == "ppo":
        chunk = settings["n_steps"] * settings["num_envs"]
        own = {
            "num_envs": settings["num_envs"],
            "num_steps": settings["n_steps"],
            "num_epochs": settings["n_epochs"],
            "num_minibatches": chunk // settings["batch_size"],
            "gae_lambda": settings["gae_lambda"],
            "ent_coef": settings["ent_coef"],
            "agent_kwargs": {"hidden_layer_sizes": settings["net_arch"], "activation": "relu"},
        }
    else:
        own = {
            "num_envs": 1,
            "num_epochs": 1,
            "batch_size": settings["batch_size"],
            "buffer_size": settings["buffer_size"],
            "fill_buffer": settings["learning_starts"],
        }
    if algorithm == "dqn":
        own |= {"target_update_freq": 200, "polyak": 0.0, "ddqn": False}
        own |= {"eps_start": EPSILON, "eps_end": EPSILON}
    elif algorithm == "sac":
        own |= {"polyak": 1 - settings["tau"], "hidden_layer_sizes": settings["net_arch"]}
    elif algorithm == "td3":
        own |= {"polyak": 1 - settings["tau"]}
        own |= {"actor_kwargs": {"activation": "relu"}, "critic_kwargs": {"activation": "relu"}}
    agent = (
        getattr(library, algorithm.upper())
        .create(
            env=Torques() if algorithm == "dqn" else Pendulum(),
            learning_rate=settings["learning_rate"],
            gamma=settings["gamma"],
            total_timesteps=chunk,
            eval_freq=chunk,
            skip_initial_evaluation=True,
            **own,
        )
        .replace(eval_callback=lambda *_: ())
    )  # `create` offers no run without evaluations,
    if algorithm == "dqn":  # nor another size of this network
        network = EpsilonGreedyPolicy(DiscreteQNetwork)(
            hidden_layer_sizes=(256, 256), action_dim=TORQUES, activation=jax.nn.relu
        )
        agent = agent.replace(agent=network)
    elif algorithm == "td3":
        layers = {"hidden_layer_sizes": tuple(settings["net_arch"])}
        agent = agent.replace(
            actor=agent.actor.clone(**layers), critic=agent.critic.clone(**layers)
        )
    train = jax.jit(lambda state: agent.train(train_state=state)[0])
    state = agent.init_state(jax.random.key(0))

    def advance() -> int:
        nonlocal state
        state = jax.block_until_ready(train(state))
        return chunk

    return advance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("library", choices=("stable_baselines3", "sbx", "rejax"))
    parser.add_argument("--algorithm", choices=SETTINGS, default="dqn")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    answers, sys.stdout = sys.stdout, sys.stderr  # a library may print, too

    # torch reads the one, jax the other; jax knows only one thread or one for each core.
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)
    if arguments.threads == 1:
        os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"

    library = arguments.library
    algorithm = arguments.algorithm
    advance = rejax(algorithm) if library == "rejax" else gymnasium(library, algorithm)
    for _ in range(3):  # fills the replay beyond learning's start and compiles
        advance()
    serve(timed(advance), answers)


if __name__ == "__main__":
    main()
