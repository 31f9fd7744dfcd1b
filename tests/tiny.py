"""Agents whose training takes a moment."""

from qfolio.experiments.presets import Preset

DQN = Preset(
    "dqn",
    {"network": "mlp", "hidden": (8, 8), "all_actions": True, "num_envs": 4, "batch_size": 8,
     "learning_starts": 40, "replay_capacity": 400, "episode_steps": 0},
    episodes=16, seeds=2, task={"menu": "tilts:0.2", "window": 10, "horizon": 20},
)  # fmt: skip
PATHWISE = Preset(
    "pathwise", {"rollout_length": 10, "num_envs": 4, "hidden": (4,)},
    episodes=8, seeds=2, task={"window": 10, "horizon": 20},
)  # fmt: skip


def with_task(preset, **changes):
    """The preset with other settings of its task."""
    return preset._replace(task={**preset.task, **changes})
