"""What a report of a run sets beside its agent: the same agent with one thing changed."""

import dataclasses
from typing import NamedTuple

from qfolio.agents.dqn import DQN
from qfolio.core.mdp import Agent


class Contrast(NamedTuple):
    """A variant of an agent, and how the two are called where they stand side by side."""

    name: str
    variant_name: str
    variant: Agent


def contrast_of(agent: Agent) -> Contrast | None:
    """The variant of an agent that its report shows, where there is one."""
    if not isinstance(agent, DQN):
        return None
    if agent.all_actions:
        single = dataclasses.replace(agent, all_actions=False)
        return Contrast("all actions at once", "one action at a time", single)
    names = ("without double DQN", "double DQN")
    other = dataclasses.replace(agent, double=not agent.double)
    return Contrast(names[agent.double], names[not agent.double], other)
