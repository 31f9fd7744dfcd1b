"""Presets for environments of Gymnasium."""

from typing import Any

from qfolio.experiments.presets.preset import Preset, Presets

# Small inputs matter (input_gain), and the rare bad ends must propagate fast (n_steps).
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
    "learning_rate_final": 0.0,
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


def of_any(id: str, agent: str, steps: int, **changes: Any) -> Preset:
    return Preset(agent, changes, steps=steps, seeds=4, task={"id": id})


def _dqn(id: str, steps: int, **changes: Any) -> dict[str, Preset]:
    """DQN whose learning rate has fallen to zero at the end."""
    settings = {**_DQN, **changes}
    settings["learning_rate_steps"] = float(steps // settings["num_envs"])
    return {"fast": of_any(id, "dqn", steps, **settings)}


PRESETS: Presets = {
    ("gym:CartPole-v1", "dqn"): _dqn("CartPole-v1", 120_000, discount=0.98, epsilon_end=0.05),
    ("gym:CartPole-v1", "ppo"): {"fast": of_any("CartPole-v1", "ppo", 100_000, **_PPO)},
    ("gym:Acrobot-v1", "dqn"): _dqn("Acrobot-v1", 60_000),
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
    ("gym:LunarLander-v3", "dqn"): _dqn(
        "LunarLander-v3",
        300_000,
        replay_capacity=131_072,
        input_gain=1.0,
        learning_rate=1e-3,
        reward_scale=0.03,
    ),
}
