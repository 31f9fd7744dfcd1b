"""Hyperparameters that belong together: what was tuned for which task."""

from typing import TYPE_CHECKING, Any, NamedTuple

from qfolio import settings
from qfolio.errors import QfolioError
from qfolio.registry import AGENTS, find

if TYPE_CHECKING:
    from qfolio.mdp import Agent


class Preset(NamedTuple):
    """An agent's settings, and how many episodes and seeds are trained unless told otherwise."""

    agent: str
    settings: dict[str, Any]
    episodes: int
    seeds: int

    def build(self, **changes: Any) -> "Agent":
        """The agent, with some settings changed."""
        return settings.build(find("agent", AGENTS, self.agent), {**self.settings, **changes})


_FAST = {
    "hidden": (128, 128),
    "input_gain": 6.0,
    "environments": 32,
    "episode_steps": 28,
    "batch_size": 256,
    "replay_capacity": 65_536,
    "learning_starts": 1024,
    "target_period": 1,
    "target_rate": 0.03,
    "discount": 0.995,
    "learning_rate": 3e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 7500.0,
    "epsilon_decay": 0.995,
    "huber": 0.3,
    "reward_scale": 0.3,
}

_BEST = {
    **_FAST,
    "hidden": (192, 192),
    "episode_steps": 40,
    "replay_capacity": 262_144,
    "learning_rate": 2e-3,
    "learning_rate_steps": 30_000.0,
}

PRESETS = {
    ("pendulum", "dqn"): {
        "fast": Preset("dqn", _FAST, episodes=8608, seeds=8),
        "best": Preset("dqn", _BEST, episodes=24_032, seeds=8),
        # Each hyperparameter of the report that qfolio grew out of; they are DQN's defaults.
        "report": Preset("dqn", {}, episodes=600, seeds=1),
    }
}
"""By task and agent."""


def preset(name: str, task: str = "pendulum", agent: str = "dqn") -> Preset:
    """The preset of that name; raises QfolioError where there is none."""
    presets = PRESETS.get((task, agent), {})
    if name not in presets:
        there = f"there is {', '.join(presets)}" if presets else "there is none at all"
        raise QfolioError(f"there is no preset {name!r} for {agent} on {task}; {there}.")
    return presets[name]
