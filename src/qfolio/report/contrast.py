"""The variant that a run's report compares with its agent: one setting changed."""

import dataclasses
from typing import NamedTuple

from qfolio.agents.dqn import DQN
from qfolio.core.mdp import Agent


class Contrast(NamedTuple):
    """A variant of an agent, and the names of the two in the report."""

    name: str
    variant_name: str
    variant: Agent


def contrast_of(agent: Agent) -> Contrast | None:
    """The variant of an agent that its report shows, if there is one."""
    if not isinstance(agent, DQN):
        return None
    if agent.all_actions:
        single = dataclasses.replace(
            agent,
            all_actions=False,
            outcomes=0,
            market_baseline=False,
            bootstrap_heads=1,
            caution=0.0,
        )
        return Contrast("all actions at once", "one action at a time", single)
    names = ("without double DQN", "double DQN")
    other = dataclasses.replace(agent, double=not agent.double)
    return Contrast(names[agent.double], names[not agent.double], other)
