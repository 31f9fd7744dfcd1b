"""Training the folds of a backtest: all seeds of some folds are one job."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from qfolio.core.mdp import Agent
from qfolio.core.population import Population, Rehearsal
from qfolio.experiments.budget import Budget
from qfolio.experiments.fit import Listener, Training, fit
from qfolio.experiments.records import Records
from qfolio.portfolio.task import Portfolio


class TrainedFold(NamedTuple):
    """The trained agents of a fold.

    kept: their weights, with a leading seed axis, or their whole states. rows: one for every
    training episode, in order of time.
    """

    kept: PyTree
    rows: Records


@dataclass(frozen=True)
class FoldsJob:
    """Trains all seeds of an agent on some folds, as one population.

    agent_name: the agent's name in the backtest. folds: their names. tasks: each fold's part of the
    table. whole: the fold whose whole states are kept, so that learning can continue; the others
    keep only weights, because a state may hold a large replay memory. most: number of folds in the
    backtest's largest job; all jobs share its programs.
    """

    agent_name: str
    agent: Agent
    folds: tuple[str, ...]
    tasks: tuple[Portfolio, ...]
    seeds: tuple[int, ...]
    budget: Budget
    whole: str
    most: int

    @property
    def name(self) -> str:
        return f"{self.agent_name}/{self.folds[0]}"

    @property
    def members(self) -> list[str]:
        """The names of its members for the log, one for each fold and seed."""
        return [f"{fold}, seed {seed}" for fold in self.folds for seed in self.seeds]

    def run(self, listeners: Sequence[Listener]) -> dict[str, TrainedFold] | None:
        """The trained folds by name; None if Ctrl-C stopped it."""
        population = Population(*self._population)
        records = _RowsByFold(self)
        training = fit(population, self.budget, [records, *listeners])
        if training.interrupted and not training.finished:
            return None
        return {
            fold: TrainedFold(self._of_fold(population, i), Records.joined(records.rows[i]))
            for i, fold in enumerate(self.folds)
        }

    def prepare(self) -> None:
        """Compiles the programs of ``run``."""
        Rehearsal(*self._population)

    @property
    def _population(self) -> tuple[list[Portfolio], Agent, tuple[int, ...], int]:
        """The arguments of its population."""
        tasks = [task for task in self.tasks for _ in self.seeds]
        seeds, room = self.seeds * len(self.folds), self.most * len(self.seeds)
        return tasks, self.agent, seeds, room

    def _of_fold(self, population: Population, fold: int) -> PyTree:
        whole = self.folds[fold] == self.whole
        members = population.fetch().agent if whole else population.weights()
        first, count = fold * len(self.seeds), len(self.seeds)
        return jax.tree.map(lambda x: x[first : first + count], members)


@contextlib.contextmanager
def preparing(jobs: Iterable[FoldsJob]) -> Iterator[None]:
    """Prepares jobs in a thread beside the block, which may run them at any time."""
    with ThreadPoolExecutor(1) as thread:
        for job in jobs:
            thread.submit(job.prepare)  # what it raises, the job raises again when it runs
        try:
            yield
        finally:
            # Cancels what has not begun; leaving the block waits for the rest.
            thread.shutdown(wait=False, cancel_futures=True)


class _RowsByFold(Listener):
    """Keeps the training records of each fold."""

    def __init__(self, job: FoldsJob) -> None:
        self.seeds = len(job.seeds)
        self.rows: list[list[Records]] = [[] for _ in job.folds]  # of each chunk

    def on_chunk(self, training: Training, rows: Records) -> None:
        fold = np.asarray(training.members, int) // self.seeds
        for i, mine in enumerate(self.rows):
            mine.append(rows[fold == i])
