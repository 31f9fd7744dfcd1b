"""Executors of jobs: in this process, one after another."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar, runtime_checkable

from qfolio.experiments.fit import Listener
from qfolio.experiments.interrupts import interruptible

R_co = TypeVar("R_co", covariant=True)
R = TypeVar("R")


@runtime_checkable
class Job(Protocol[R_co]):
    """Work as a value: its result depends only on its fields.

    A job may therefore run twice, anywhere, and in any order.
    """

    @property
    def name(self) -> str:
        """Its name, unique among the jobs of one experiment."""
        ...

    def run(self, listeners: Sequence[Listener]) -> R_co | None:
        """The result; None if Ctrl-C stopped it."""
        ...


@runtime_checkable
class Executor(Protocol):
    """Runs jobs and yields their results as they finish; ends early if Ctrl-C stopped one."""

    def map(
        self, jobs: Sequence[Job[R]], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Iterator[tuple[Job[R], R]]:
        """Each finished job with its result; ``listen`` returns the listeners of a job."""
        ...


class Here:
    """Runs jobs in this process, one after another."""

    def map(
        self, jobs: Sequence[Job[R]], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Iterator[tuple[Job[R], R]]:
        with interruptible() as stop:
            for job in jobs:
                result = None if stop.is_set() else job.run(listen(job))
                if result is None:
                    return
                yield job, result
