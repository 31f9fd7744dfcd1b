"""An agent whose training takes a moment."""

from qfolio.experiments.presets import Preset

PATHWISE = Preset(
    "pathwise", {"rollout_length": 10, "num_envs": 4, "hidden": (4,)},
    episodes=8, seeds=2, task={"window": 10, "horizon": 20},
)  # fmt: skip
