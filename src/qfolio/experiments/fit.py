"""The driver of all training: chunks, records, listeners and Ctrl-C.

Every command that learns trains a population with ``fit``. Listeners do everything else between two
chunks: files, learning curves, progress, checkpoints.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError, require_list, require_methods
from qfolio.core.population import Population
from qfolio.core.training import Episodes
from qfolio.experiments.budget import Budget
from qfolio.experiments.interrupts import interruptible
from qfolio.experiments.records import Records


@dataclass
class Training:
    """A training in progress, as its listeners see it, in this process or from a worker.

    Attributes:
        budget: The budget of each member.
        begun: Steps of each environment before this training.
        left: Remaining steps of each environment.
        done: Steps of each environment in this training so far.
        num_envs: Environments of each member.
        count: Number of members.
        seconds: Time spent on training, excluding compilation.
        members: The member that each row of the last chunk belongs to.
        ends: The steps of all environments of a member at the end of each row's episode.
        interrupted: Whether Ctrl-C asked the training to stop.
        where: The worker that the training runs on; empty in this process.
    """

    _population: Population | None  # None in a report from a worker
    budget: Budget
    begun: int = 0
    left: int = 0
    done: int = 0
    num_envs: int = 1
    count: int = 1
    seconds: float = 0.0
    members: Sequence[int] = ()
    ends: Sequence[int] = ()
    interrupted: bool = False
    where: str = ""
    _learned: int = 0  # steps of each environment since learning began, and their time
    _learning_seconds: float = 0.0

    @property
    def population(self) -> Population:
        """The population in training; raises QfolioError if it is on a worker."""
        if self._population is None:
            raise QfolioError(
                "A listener asks for the population of a training that runs on a worker; it may "
                "ask for progress and rows, or train in this process (--on here)."
            )
        return self._population

    @property
    def finished(self) -> bool:
        """Whether the budget is used up."""
        return self.left == 0

    @property
    def steps(self) -> int:
        """Steps of all environments of a member so far, earlier training included."""
        return (self.begun + self.done) * self.num_envs

    @property
    def share(self) -> float:
        """The share of this training that is done, in steps."""
        return self.share_since(self.begun * self.num_envs)

    def share_since(self, steps: int = 0) -> float:
        """The share that is done of what follows the first ``steps`` of a member."""
        done = self.steps - steps
        return done / max(done + self.left * self.num_envs, 1)

    @property
    def steps_per_second(self) -> float:
        """Environment steps of all members per second; once learning has begun, since then."""
        return self._rate * (self.num_envs * self.count)

    @property
    def seconds_left(self) -> float:
        """Estimated time left; NaN before learning begins, as the warm-up has another speed."""
        return self.left / self._rate if self._learned or self.finished else math.nan

    @property
    def _rate(self) -> float:
        if self._learned:
            return self._learned / max(self._learning_seconds, 1e-9)
        return self.done / max(self.seconds, 1e-9)

    def advance(self, most: int, strict: bool) -> Records:
        """Trains one chunk of at most ``most`` steps; returns the episodes that it finished."""
        population = self.population
        episodes, steps, compiled = (
            population.member_episodes,
            population.steps,
            population.seconds_compile,
        )
        learning, start = population.learning, perf_counter()
        records = population.advance(min(self.left, most), strict=strict)
        seconds = perf_counter() - start - (population.seconds_compile - compiled)
        self.seconds += seconds
        self.done = population.steps - self.begun
        if learning:
            self._learned += population.steps - steps
            self._learning_seconds += seconds
        self.left = self.budget.left(population)
        if not strict and not any(population.healthy):
            self.left = 0
        rows, self.members, times = _records(population.seeds, episodes, records)
        self.ends = ((steps + 1 + times) * self.num_envs).tolist()
        return rows


class Listener:
    """Hooks into a training; a listener overrides those that it needs."""

    def on_start(self, training: Training) -> None:
        """Before the first chunk."""

    def on_chunk(self, training: Training, rows: Records) -> None:
        """After each chunk, with a row for each episode that it finished, in order of time."""

    def on_end(self, training: Training) -> None:
        """After the last chunk, also if Ctrl-C stopped the training; not after an error."""


def require_listeners(listeners: Any) -> None:
    """Raises QfolioError unless the argument is a list of listeners that can be called."""
    wanted = "a list of objects whose classes derive from qfolio.Listener"
    require_list("listeners", listeners, Listener, wanted)
    for listener in listeners:
        require_methods(type(listener), Listener)


def fit(
    population: Population,
    budget: Budget,
    listeners: Sequence[Listener] = (),
    *,
    chunk: int = 2**31,
    strict: bool = True,
) -> Training:
    """Trains a population until each member has used its budget.

    A first Ctrl-C stops after the current chunk and sets ``interrupted``.

    Args:
        population: The population to train, from its current state.
        budget: The budget of each member, including earlier training.
        listeners: Called after every chunk, in their order.
        chunk: Maximum number of steps of a chunk, if below the population's own.
        strict: Whether a loss that is not finite raises QfolioError; otherwise the other members
            continue.
    """
    require_listeners(listeners)
    training = Training(
        population,
        budget,
        begun=population.steps,
        left=budget.left(population),
        num_envs=population.agent.num_envs,
        count=len(population.seeds),
    )
    if training.finished:
        return training
    with interruptible() as stop:
        for listener in listeners:
            listener.on_start(training)
        training.interrupted = stop.is_set()
        while not (training.finished or training.interrupted):
            rows = training.advance(chunk, strict)
            for listener in listeners:
                listener.on_chunk(training, rows)
            training.interrupted = stop.is_set()
        for listener in listeners:
            listener.on_end(training)
        training.interrupted = stop.is_set()
    return training


def _records(
    seeds: Sequence[int], before: Sequence[int], episodes: Episodes
) -> tuple[Records, list[int], np.ndarray]:
    """A row for each finished episode, its member and its time in the chunk, in order of time.

    before: finished episodes of each member until now.
    """
    # By time first, so that the order does not depend on the chunks.
    time, member, environment = np.argwhere(episodes.finished.swapaxes(0, 1)).T
    by_member = np.argsort(member, kind="stable")
    counts = np.bincount(member, minlength=len(seeds))
    earlier = np.cumsum(counts) - counts - before  # rows of other members, less episodes until now
    number = np.empty_like(by_member)
    number[by_member] = 1 + np.arange(len(member)) - np.repeat(earlier, counts)
    columns = {"seed": np.array(seeds)[member], "episode": number}
    for name, values in {"return": episodes.returns, **episodes.metrics}.items():
        columns[name] = np.asarray(values[member, time, environment], float)
    return Records(columns), member.tolist(), time
