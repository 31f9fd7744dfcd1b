"""Where jobs run: here, one after the other."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar, runtime_checkable

from qfolio.experiments.fit import Listener
from qfolio.experiments.interrupts import interruptible

R_co = TypeVar("R_co", covariant=True)
R = TypeVar("R")


@runtime_checkable
class Job(Protocol[R_co]):
    """Work as a value: it holds all that it needs, and its result depends on nothing else.

    A job may therefore run twice, anywhere, and in any order.
    """

    @property
    def name(self) -> str:
        """What it is called; unique among the jobs of one experiment."""
        ...

    def run(self, listeners: Sequence[Listener]) -> R_co | None:
        """The result; None where Ctrl-C stopped it."""
        ...


@runtime_checkable
class Executor(Protocol):
    """Runs jobs and gives their results as they come; it ends early where Ctrl-C stopped one."""

    def map(
        self, jobs: Sequence[Job[R]], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Iterator[tuple[Job[R], R]]:
        """Each finished job with its result; ``listen`` makes the listeners to a job's training."""
        ...


class Here:
    """Runs jobs in this process, one after the other."""

    def map(
        self, jobs: Sequence[Job[R]], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Iterator[tuple[Job[R], R]]:
        with interruptible() as stop:
            for job in jobs:
                result = None if stop.is_set() else job.run(listen(job))
                if result is None:
                    return
                yield job, result
