"""The type of a preset."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from qfolio.core import settings
from qfolio.core.registry import find
from qfolio.experiments.budget import Budget

if TYPE_CHECKING:
    from qfolio.core.mdp import Agent, Task


class Preset(NamedTuple):
    """An agent's settings, with its default budget and number of seeds.

    The budget is in episodes, or in steps of all environments if episodes may end early.
    """

    agent: str
    settings: dict[str, Any]
    episodes: int = 0
    seeds: int = 1
    task: Mapping[str, Any] = MappingProxyType({})  # the task's settings that it was tuned for
    steps: int = 0

    def build(self, **changes: Any) -> "Agent":
        """The agent, with some settings changed."""
        return settings.build(find("agent", self.agent), {**self.settings, **changes})

    def described(self, task: "type[Task]") -> dict[str, Any]:
        """The settings of agent and task, except those that have no default."""
        agent = settings.defaults(find("agent", self.agent), self.settings)
        return agent | settings.defaults(task, self.task)

    @property
    def budget(self) -> Budget:
        """The budget of each seed."""
        return Budget(steps=self.steps) if self.steps else Budget(self.episodes)


Presets = dict[tuple[str, str], dict[str, Preset]]
"""Presets by task and agent, and then by name."""
