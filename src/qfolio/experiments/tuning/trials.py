"""Training of configurations in jobs: each job has some of them, with all their seeds."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from qfolio.core.host import population_of
from qfolio.core.mdp import Agent, Task
from qfolio.experiments.budget import Budget
from qfolio.experiments.executor import Executor, Here, at_once
from qfolio.experiments.fit import Listener, fit


@dataclass(frozen=True)
class TrialsJob:
    """Trains configurations that share all settings which shape the program, as one population.

    All members take as many steps as the episodes would if none ended early, so that a
    configuration's result does not depend on the others.

    names: of the configurations. starts: key data of the start states for grading. most: number of
    configurations of the largest job, whose programs all share.
    """

    names: tuple[str, ...]
    task: Task
    agents: tuple[Agent, ...]
    seeds: tuple[int, ...]
    budget: Budget
    starts: np.ndarray
    most: int

    @property
    def name(self) -> str:
        first, *others = self.names
        if len(others) > 1:
            return f"{first} to {others[-1]}"
        return " and ".join(self.names)  # such as the best and the preset

    @property
    def members(self) -> list[str]:
        return [f"{name}, seed {seed}" for name in self.names for seed in self.seeds]

    def run(self, listeners: Sequence[Listener]) -> Float[np.ndarray, "configuration seed"] | None:
        """Mean greedy returns, NaN where the loss diverged; None if Ctrl-C stopped the training."""
        count = len(self.seeds)
        members = [agent for agent in self.agents for _ in self.seeds]
        population = population_of(
            self.task, members, self.seeds * len(self.agents), self.most * count
        )
        steps = self.budget.left(population) * population.agent.num_envs
        training = fit(population, Budget(steps=steps), listeners, strict=False)
        if not training.finished:
            return None
        keys = jax.random.wrap_key_data(jnp.asarray(self.starts[: population.starts]))
        returns = np.asarray(population.evaluate(keys, tail=0).returns).mean(1)
        finite = np.array(population.healthy) & np.isfinite(returns)
        return np.where(finite, returns, np.nan).reshape(len(self.agents), count)


def trials_jobs(
    task: Task,
    agents: Mapping[str, Agent],
    seeds: Sequence[int],
    budget: Budget,
    starts: np.ndarray,
    executor: Executor,
) -> list[TrialsJob]:
    """The jobs of these configurations: as large as possible in this process, else worker-sized."""
    groups = defaultdict(list)
    for name, agent in agents.items():
        groups[jax.tree.structure(agent)].append(name)
    size = len(agents) if isinstance(executor, Here) else math.ceil(at_once(executor) / len(seeds))
    parts = [
        (group[i : i + size], min(size, len(group)))
        for group in groups.values()
        for i in range(0, len(group), size)
    ]
    return [
        TrialsJob(
            tuple(names), task, tuple(agents[n] for n in names), tuple(seeds), budget, starts, most
        )
        for names, most in parts
    ]
