"""Presets for the markets with known answers."""

from typing import Any

from qfolio.experiments.presets.preset import Preset, Presets

_PATHWISE = {"hidden": (16, 16), "learning_rate": 1e-2, "learning_rate_final": 0.0}


_DQN = {
    "hidden": (32,),
    "all_actions": True,
    "double": True,
    "num_envs": 1024,
    "replay_capacity": 524_288,
    "learning_starts": 1024,
    "target_update_interval": 1,
    "tau": 0.05,
    "discount": 0.97,
    "learning_rate": 3e-2,
    "learning_rate_final": 0.0,
    "epsilon_end": 1.0,  # exploration does not matter, since all actions are learned
    "reward_scale": 100.0,
}


def _pathwise(episodes: int, **changes: Any) -> dict[str, Preset]:
    """Episodes as long as rollouts, so that each rollout starts from a random holding."""
    changes["episode_steps"] = changes["rollout_length"]
    return {"fast": Preset("pathwise", {**_PATHWISE, **changes}, episodes, seeds=5)}


def _all_actions(menu: str, **changes: Any) -> dict[str, Preset]:
    changes = {**_DQN, **changes}
    return {"fast": Preset("dqn", changes, 8192, seeds=5, task={"menu": menu})}


_ON_FACTORS = _pathwise(
    25_600,
    num_envs=64,
    rollout_length=50,
    tail=20,
    learning_rate_steps=400.0,
    reward_scale=10.0,
    max_grad_norm=0.3,
)

PRESETS: Presets = {
    ("market/kelly", "pathwise"): _pathwise(
        307_200, num_envs=1024, rollout_length=5, learning_rate_steps=300.0, reward_scale=10.0
    ),
    ("market/merton", "pathwise"): _pathwise(
        153_600, num_envs=512, rollout_length=5, learning_rate_steps=300.0, reward_scale=10.0
    ),
    ("market/regime", "pathwise"): _pathwise(
        25_600,
        num_envs=64,
        rollout_length=50,
        bootstrap=True,
        slope_learning_rate_ratio=3.0,
        learning_rate=5e-3,
        learning_rate_steps=400.0,
        reward_scale=100.0,
        max_grad_norm=1e-4,
    ),
    # Regimes of a hundred steps need a discount near 1. The values of these actions (no order, all
    # in, all out, …) are straight lines in the holding, those of fixed weights have kinks.
    ("market/regime", "dqn"): _all_actions(
        "tilts:0.1",
        batch_size=1024,
        discount=0.99,
        tau=0.02,
        learning_rate=1e-2,
        learning_rate_steps=2000.0,
    ),
    ("market/ar1", "pathwise"): _pathwise(
        25_600,
        num_envs=64,
        rollout_length=63,
        tail=21,
        learning_rate_steps=400.0,
        reward_scale=100.0,
    ),
    ("market/ar1", "dqn"): _all_actions("grid:10", batch_size=1024, learning_rate_steps=2016.0),
    # A trade pays off over years, that is, thousands of daily steps: the slopes carry its value
    # beyond the rollout. All gradients are clipped, so that the large first ones, far from the
    # region, do not outweigh the later ones in Adam's mean of squares.
    ("market/no-trade", "pathwise"): _pathwise(
        12_800,
        num_envs=16,
        rollout_length=480,
        bootstrap=True,
        slope_learning_rate_ratio=40.0,
        learning_rate=1e-3,
        learning_rate_steps=800.0,
        reward_scale=100.0,
        max_grad_norm=1e-4,
    ),
    ("market/garleanu-pedersen", "pathwise"): _ON_FACTORS,
    ("market/signals", "pathwise"): _ON_FACTORS,
    ("market/leverage", "pathwise"): _pathwise(
        153_600, num_envs=512, rollout_length=5, learning_rate_steps=300.0, reward_scale=10.0
    ),
    ("market/liquidation", "pathwise"): _pathwise(
        25_600, num_envs=64, rollout_length=5, learning_rate_steps=400.0
    ),
    # The critics learn the value's curvature in the position only if exploration reaches around it.
    ("market/liquidation", "sac"): {
        "fast": Preset(
            "sac",
            {
                "hidden": (64, 64),
                "num_envs": 16,
                "gradient_steps": 4,
                "batch_size": 256,
                "replay_capacity": 32_768,
                "discount": 1.0,
                "tau": 0.02,
                "learning_rate": 3e-3,
                "learning_rate_steps": 7500.0,
                "learning_rate_final": 0.0,
                "initial_temperature": 0.01,
                "spread": 0.1,
            },
            steps=30_000,
            seeds=5,
        )
    },
}
