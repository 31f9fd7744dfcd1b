"""Presets for environments of Gymnasium."""

from typing import Any

from qfolio.experiments.presets.preset import Preset, Presets

# Small inputs matter (input_gain), and rare failures must propagate fast (n_steps).
_DQN = {
    "hidden": (128, 128),
    "input_gain": 3.0,
    "dueling": True,
    "double": True,
    "n_steps": 4,
    "num_envs": 8,
    "batch_size": 256,
    "replay_capacity": 65_536,
    "learning_starts": 1000,
    "target_update_interval": 1,
    "tau": 0.03,
    "learning_rate": 2e-3,
    "epsilon_decay": 0.99,
    "epsilon_end": 0.02,
    "huber_delta": 1.0,
    "reward_scale": 0.1,
}


_PPO: dict[str, Any] = {
    "num_envs": 8,
    "rollout_length": 32,
    "batch_size": 256,
    "epochs": 20,
    "discount": 0.98,
    "gae_lambda": 0.8,
    "learning_rate": 1e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 7800.0,
}


# Observations and rewards in any units; small steps from many environments.
_NORMALIZED_PPO: dict[str, Any] = {
    "num_envs": 32,
    "rollout_length": 128,
    "batch_size": 256,
    "epochs": 4,
    "gae_lambda": 0.98,
    "activation": "tanh",
    "learning_rate": 1e-3,
    "normalize_observations": True,
    "normalize_rewards": True,
}

# Small networks and four gradient steps a call: Python takes a small part of the time.
_SAC: dict[str, Any] = {
    "hidden": (64, 64),
    "num_envs": 4,
    "gradient_steps": 4,
    "batch_size": 128,
}

_NORMALIZED = {"normalize_observations": True, "normalize_rewards": True}

# A gradient step for every second step of an environment, four in one call.
_OFF_POLICY: dict[str, Any] = {
    "hidden": (128, 128),
    "num_envs": 8,
    "gradient_steps": 4,
    "batch_size": 128,
    **_NORMALIZED,
}

_UNKNOWN: dict[str, dict[str, Any]] = {
    "ppo": {"num_envs": 8, "rollout_length": 256, "activation": "tanh", **_NORMALIZED},
    "a2c": _NORMALIZED,
    "sac": _OFF_POLICY,
    "td3": _OFF_POLICY,
    "ddpg": _OFF_POLICY,
}
"""Settings for environments without a preset, where they differ from the agent's defaults."""


def of_any(id: str, agent: str) -> Preset:
    """A preset for an environment that has none."""
    return _preset(id, agent, 100_000, **_UNKNOWN.get(agent, {}))


def _preset(id: str, agent: str, steps: int, **settings: Any) -> Preset:
    return Preset(agent, settings, steps=steps, seeds=4, task={"id": id})


def _dqn(id: str, steps: int, **changes: Any) -> dict[str, Preset]:
    settings = {**_DQN, **changes}
    return _falling(id, "dqn", steps, 1 / settings["num_envs"], settings)


def _ppo(id: str, steps: int, **changes: Any) -> dict[str, Preset]:
    settings = {**_NORMALIZED_PPO, **changes}
    return _falling(id, "ppo", steps, settings["epochs"] / settings["batch_size"], settings)


def _sac(id: str, steps: int, **changes: Any) -> dict[str, Preset]:
    settings = {**_SAC, **changes}
    updates = settings["gradient_steps"] / settings["num_envs"]
    return _falling(id, "sac", steps, updates, settings)


def _falling(
    id: str, agent: str, steps: int, updates: float, settings: dict[str, Any]
) -> dict[str, Preset]:
    """The preset ``fast``, with a learning rate that falls to zero at the end.

    updates: gradient steps per environment step.
    """
    end = {"learning_rate_final": 0.0, "learning_rate_steps": float(int(steps * updates))}
    return {"fast": _preset(id, agent, steps, **{**settings, **end})}


PRESETS: Presets = {
    # Near the ends of the track an agent is early in training only: the replay forgets nothing.
    ("gym:CartPole-v1", "dqn"): _dqn(
        "CartPole-v1", 120_000, discount=0.98, epsilon_end=0.1, replay_capacity=131_072
    ),
    ("gym:CartPole-v1", "ppo"): {"fast": _preset("CartPole-v1", "ppo", 100_000, **_PPO)},
    ("gym:Acrobot-v1", "dqn"): _dqn("Acrobot-v1", 60_000),
    ("gym:Acrobot-v1", "ppo"): _ppo("Acrobot-v1", 3_000_000),
    # The goal is hardly ever found by chance. Persistent pushes reach it; and untried actions keep
    # their initial value of about 0, above all tried ones, unless multi-step returns, a stream for
    # V or a flat first layer lower it.
    ("gym:MountainCar-v0", "dqn"): _dqn(
        "MountainCar-v0",
        400_000,
        input_gain=10.0,
        dueling=False,
        n_steps=1,
        discount=0.98,
        num_envs=16,
        replay_capacity=262_144,
        persistence=0.9,
        reward_scale=0.03,
    ),
    ("gym:MountainCar-v0", "ppo"): _ppo("MountainCar-v0", 2_000_000),
    # Independent noise never reaches the goal; noise that pushes one way for 30 steps does. Each
    # push costs, so a high initial temperature would drown what the first goals pay.
    ("gym:MountainCarContinuous-v0", "sac"): _sac(
        "MountainCarContinuous-v0",
        80_000,
        noise_theta=0.03,
        input_gain=3.0,
        tau=0.01,
        learning_rate=1e-3,
        reward_scale=0.1,
        initial_temperature=0.1,
    ),
    ("gym:Pendulum-v1", "sac"): _sac(
        "Pendulum-v1",
        20_000,
        input_gain=6.0,
        spread=0.05,
        discount=0.98,
        tau=0.02,
        learning_rate=2e-3,
        actor_learning_rate_ratio=0.5,
    ),
    ("gym:LunarLander-v3", "ppo"): _ppo(
        "LunarLander-v3",
        2_000_000,
        num_envs=16,
        rollout_length=256,
        discount=0.999,
        entropy_coef=0.01,
    ),
    ("gym:LunarLander-v3", "dqn"): _dqn(
        "LunarLander-v3",
        300_000,
        replay_capacity=131_072,
        input_gain=1.0,
        learning_rate=1e-3,
        reward_scale=0.03,
    ),
}
