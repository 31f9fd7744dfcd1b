"""Presets for portfolios of real assets."""

from qfolio.experiments.presets.preset import Preset, Presets

_TASK = {"window": 60, "horizon": 50, "reward": "crra", "risk_aversion": 5.0}


_DQN = {
    "network": "mlp",
    "hidden": (16, 16),
    "all_actions": True,
    "market_baseline": True,
    "num_envs": 8,
    "batch_size": 64,
    "replay_capacity": 8192,
    "learning_starts": 3200,
    "target_update_interval": 1,
    "tau": 0.05,
    "discount": 0.99,
    "learning_rate": 3e-4,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 600.0,
    "reward_scale": 100.0,
}


_PATHWISE = {
    "hidden": (16, 16),
    "rollout_length": 25,
    "num_envs": 16,
    "learning_rate": 5e-4,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 100.0,
    "reward_scale": 100.0,
    "max_grad_norm": 1.0,
}


def of_any(agent: str) -> Preset:
    """An agent's own defaults, on the task that the other agents have."""
    return Preset(agent, {}, episodes=800, seeds=5, task=_TASK)


PRESETS: Presets = {
    ("portfolio", "dqn"): {
        "fast": Preset(
            "dqn",
            _DQN,
            episodes=160,
            seeds=5,
            task={**_TASK, "menu": "overweight:0.1"},
        ),
    },
    ("portfolio", "pathwise"): {
        "fast": Preset("pathwise", _PATHWISE, episodes=800, seeds=5, task=_TASK)
    },
}
