"""Training budgets and seeds."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from qfolio.core.errors import QfolioError, require_type, require_whole

if TYPE_CHECKING:
    from qfolio.core.mdp import Agent, Task
    from qfolio.core.population import Population


SCHEDULES = ("learning_rate_steps", "epsilon_steps", "importance_steps")
"""Settings of agents in which the length of training counts."""

MOST_STARTS = 2**20
"""Largest number of start states of a grade, which are played side by side."""


@dataclass(frozen=True)
class Budget:
    """The length of each member's training: in episodes, or in steps of all its environments.

    Raises QfolioError unless exactly one of the two is given, from 1 to 2³¹ − 1.
    """

    episodes: int | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        if (self.episodes is None) == (self.steps is None):
            raise QfolioError("give each agent's training budget in either episodes or steps.")
        require_whole(self.unit, self.amount, 1, 2**31 - 1)
        object.__setattr__(self, self.unit, int(self.amount))  # a plain number, for files

    @property
    def unit(self) -> str:
        """What the budget counts: "episodes" or "steps"."""
        return "episodes" if self.steps is None else "steps"

    @property
    def amount(self) -> int:
        """The number of units."""
        amount = self.episodes if self.steps is None else self.steps
        assert amount is not None
        return amount

    def env_steps(self, task: "Task", agent: "Agent") -> int:
        """Environment steps of a member, if no episode ends early."""
        return self.amount * self._of_a_unit(task, agent)

    def longest(self, task: "Task", agent: "Agent") -> int:
        """Steps of each environment, if no episode ends early."""
        return -(-self.amount // agent.num_envs) * self._of_a_unit(task, agent)

    def _of_a_unit(self, task: "Task", agent: "Agent") -> int:
        """Steps of an episode, or 1."""
        from qfolio.core.training import episode_steps

        return episode_steps(task, agent) if self.steps is None else 1

    def planned(self, population: "Population") -> int:
        """Total steps of all environments of a member, rounded up to whole rollouts."""
        left = population.agent.whole_rollouts(self.left(population))
        return (population.steps + left) * population.agent.num_envs

    def left(self, population: "Population") -> int:
        """Steps of each environment until every member of a population has used its budget."""
        return population.steps_left(self.episodes, steps=self.steps)


def require_budget(value: object) -> Budget:
    """The value if it is a budget; raises QfolioError if not."""
    require_type("budget", value, Budget, "a budget, such as Budget(episodes=100)")
    assert isinstance(value, Budget)
    return value


def unlearned(agent: "Agent", steps: int) -> str:
    """Why an agent learns nothing in ``steps`` steps of all its environments; empty if it does.

    The verb and the rest of a sentence whose subject is the agent.
    """
    stored = agent.whole_rollouts(agent.warm_up()) * agent.num_envs
    if steps > stored:
        return ""
    return (
        f"learns nothing: it begins after {stored:,} environment steps, and a seed has {steps:,}. "
        "Give it more episodes or steps, or lower learning_starts."
    )


def seed_range(seeds: int, seed: int) -> range:
    """``seeds`` consecutive seeds from ``seed``; raises QfolioError if one exceeds 32 bits."""
    require_whole("seeds", seeds, 1, 2**20)
    require_whole("seed", seed, 0, 2**32 - seeds)
    return range(int(seed), int(seed + seeds))  # plain numbers, which files can hold
