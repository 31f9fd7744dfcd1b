"""What a preset is."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from qfolio.core import settings
from qfolio.core.registry import find
from qfolio.experiments.budget import Budget

if TYPE_CHECKING:
    from qfolio.core.mdp import Agent


class Preset(NamedTuple):
    """An agent's settings, and how far it is trained, with how many seeds, unless told otherwise.

    That is a number of episodes, or of steps of an agent's environments where episodes end early.
    """

    agent: str
    settings: dict[str, Any]
    episodes: int = 0
    seeds: int = 1
    task: Mapping[str, Any] = MappingProxyType({})  # of the task's settings, those it goes with
    steps: int = 0

    def build(self, **changes: Any) -> "Agent":
        """The agent, with some settings changed."""
        return settings.build(find("agent", self.agent), {**self.settings, **changes})

    @property
    def budget(self) -> Budget:
        """How far each seed is trained."""
        return Budget(steps=self.steps) if self.steps else Budget(self.episodes)


Presets = dict[tuple[str, str], dict[str, Preset]]
"""By task and agent, and then by name."""
