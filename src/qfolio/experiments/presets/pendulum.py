"""Presets for the pendulum, with and without its velocity, and for Catch."""

import math
from typing import Any

from qfolio.experiments.presets.preset import Preset, Presets

_FAST = {
    "hidden": (128, 128),
    "input_gain": 6.0,
    "num_envs": 32,
    "episode_steps": 28,
    "batch_size": 256,
    "replay_capacity": 65_536,
    "learning_starts": 1024,
    "target_update_interval": 1,
    "tau": 0.03,
    "discount": 0.995,
    "learning_rate": 3e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 7500.0,
    "epsilon_decay": 0.995,
    "huber_delta": 0.3,
    "reward_scale": 0.3,
    "v_min": -100.0,
    "v_max": 100.0,
}


_BEST = {
    **_FAST,
    "hidden": (192, 192),
    "episode_steps": 40,
    "replay_capacity": 262_144,
    "learning_rate": 2e-3,
    "learning_rate_steps": 30_000.0,
}


_RAINBOW = {
    **_FAST,
    "double": True,
    "dueling": True,
    "n_steps": 2,
    "prioritized": True,
    "values": "quantile",
    "atoms": 8,
    "noisy": True,
    "noise_scale": 0.1,
    "gradient_steps": 2,
    "learning_rate_steps": 15_000.0,
    "importance_steps": 15_000.0,
}


_CATEGORICAL = {
    **_FAST,
    "values": "categorical",
    "value_rescaling": True,
    "reward_scale": 1.0,
    "v_min": -400.0,
    "v_max": 400.0,
    "n_steps": 2,
    "tau": 0.02,
    "gradient_steps": 2,
    "learning_rate_steps": 15_000.0,
}


_HIDDEN = {**_FAST, "network": "lstm", "hidden": (64, 128), "input_gain": 12.0}


_CATCH = {
    "network": "cnn",
    "hidden": (128,),
    "num_envs": 32,
    "batch_size": 64,
    "replay_capacity": 32_768,
    "learning_starts": 1024,
    "target_update_interval": 1,
    "tau": 0.05,
    "discount": 0.97,
    "learning_rate": 1e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 36_000.0,
    "epsilon_end": 0.1,
    "epsilon_decay": 0.9995,
}


_ON_POLICY = {
    "episode_steps": 64,
    "input_gain": 6.0,
    "reward_scale": 0.1,
    "learning_rate_final": 0.0,
}


_PPO = {
    **_ON_POLICY,
    "num_envs": 64,
    "rollout_length": 64,
    "batch_size": 512,
    "discount": 0.99,
    "gae_lambda": 0.9,
    "learning_rate": 3e-3,
    "learning_rate_steps": 19_520.0,
    "entropy_coef": 0.02,
}


_A2C = {
    **_ON_POLICY,
    "num_envs": 8,
    "rollout_length": 8,
    "gae_lambda": 0.95,
    "discount": 0.99,
    "learning_rate": 1e-3,
    "learning_rate_steps": 15_616.0,
    "entropy_coef": 0.02,
}


_REINFORCE = {
    **_ON_POLICY,
    "num_envs": 16,
    "rollout_length": 64,
    "discount": 0.99,
    "learning_rate": 2e-3,
    "learning_rate_steps": 3906.0,
}


_TORQUE = {
    "hidden": (128, 128),
    "input_gain": 6.0,
    "num_envs": 12,
    "episode_steps": 28,
    "batch_size": 256,
    "n_steps": 2,
    "replay_capacity": 131_072,
    "learning_starts": 1024,
    "tau": 0.02,
    "discount": 0.995,
    "learning_rate": 3e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 8000.0,
    "actor_learning_rate_ratio": 0.6,
    "huber_delta": 0.3,
    "value_rescaling": True,
}


_MODEL = {  # 2,000 real steps, with 4 gradient steps of SAC for each after the first 200
    **_TORQUE,
    "num_envs": 1,
    "episode_steps": 40,
    "n_steps": 1,
    "replay_capacity": 2048,
    "learning_starts": 200,
    "tau": 0.03,
    "discount": 0.99,
    "learning_rate_steps": 7200.0,
    "huber_delta": math.inf,
    "gradient_steps": 4,
    "model_updates": 2,
    "ensemble_size": 3,
    "spread": 0.05,
}


def _torque(agent: str, **changes: Any) -> dict[str, Preset]:
    """The pendulum with any torque; 8,000 steps of all environments."""
    changes = {**_TORQUE, **changes}
    episodes = 289 * changes["num_envs"]
    return {"fast": Preset(agent, changes, episodes, seeds=8, task={"torques": 0})}


PRESETS: Presets = {
    ("pendulum", "dqn"): {
        "fast": Preset("dqn", _FAST, episodes=8608, seeds=8),
        "best": Preset("dqn", _BEST, episodes=24_032, seeds=8),
        "categorical": Preset("dqn", _CATEGORICAL, episodes=8608, seeds=8),
        "rainbow": Preset("dqn", _RAINBOW, episodes=8608, seeds=8),
        # The hyperparameters of the report that qfolio grew out of; they are DQN's defaults.
        "report": Preset("dqn", {}, episodes=600, seeds=1),
    },
    ("pendulum/hidden", "dqn"): {
        "fast": Preset("dqn", _HIDDEN, episodes=8608, seeds=8, task={"window": 2}),
    },
    ("catch", "dqn"): {
        "fast": Preset(
            "dqn",
            _CATCH,
            episodes=115_200,
            seeds=8,
            task={"rows": 12, "columns": 11, "decoys": 3},
        ),
    },
    ("pendulum", "ppo"): {
        "fast": Preset("ppo", _PPO, episodes=15_616, seeds=8),
    },
    ("pendulum", "a2c"): {
        "fast": Preset("a2c", _A2C, episodes=15_616, seeds=8, task={"torques": 0}),
    },
    ("pendulum", "reinforce"): {
        "fast": Preset("reinforce", _REINFORCE, episodes=62_496, seeds=8, task={"torques": 0}),
    },
    ("pendulum", "ddpg"): _torque(
        "ddpg",
        num_envs=32,
        replay_capacity=262_144,
        gradient_steps=2,
        learning_rate_steps=16_000.0,
        exploration_noise=0.3,
        actor_learning_rate_ratio=0.3,
    ),
    ("pendulum", "td3"): _torque("td3", policy_delay=1, target_noise=0.05, exploration_noise=0.3),
    ("pendulum", "sac"): _torque("sac", spread=0.05),
    ("pendulum", "mbpo"): {"fast": Preset("mbpo", _MODEL, 50, seeds=8, task={"torques": 0})},
}
