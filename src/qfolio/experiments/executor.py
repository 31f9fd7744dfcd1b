"""Executors of jobs: in this process, one after another; on many workers, see ``machines``."""

import contextlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax

from qfolio.core.devices import LOCKSTEP, places
from qfolio.experiments.fit import Listener
from qfolio.experiments.interrupts import interruptible
from qfolio.experiments.log import Log

AT_ONCE = 32
"""Number of members in a job if they advance in lockstep."""

R_co = TypeVar("R_co", covariant=True)
R = TypeVar("R")


@runtime_checkable
class Job(Protocol[R_co]):
    """A unit of work whose result depends only on its fields.

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
class MembersJob(Job[R_co], Protocol[R_co]):
    """A job that trains several members."""

    @property
    def members(self) -> Sequence[str]:
        """Their names, for the log."""
        ...


@runtime_checkable
class Executor(Protocol):
    """Runs jobs and yields their results as they finish; ends early if Ctrl-C stopped one."""

    @property
    def devices(self) -> int:
        """Number of devices of one worker: GPUs, or cores."""
        ...

    @property
    def lockstep(self) -> bool:
        """Whether a device steps its members in lockstep, as a GPU does."""
        ...

    def map(
        self, jobs: Iterable[Job[R] | None], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Generator[tuple[Job[R], R], None, None]:
        """Yields each finished job with its result; ``listen`` returns the listeners of a job.

        ``jobs`` are taken one by one, when a worker is free; a None means that there is no job at
        present.
        """
        ...


class Here:
    """Runs jobs in this process, one after another."""

    @property
    def devices(self) -> int:
        return len(places())

    @property
    def lockstep(self) -> bool:
        return jax.devices()[0].platform in LOCKSTEP

    def map(
        self, jobs: Iterable[Job[R] | None], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Generator[tuple[Job[R], R], None, None]:
        with interruptible() as stop:
            for job in jobs:
                result = None if stop.is_set() or job is None else job.run(listen(job))
                if job is None or result is None:
                    return
                yield job, result


def at_once(executor: Executor, in_lockstep: int = AT_ONCE) -> int:
    """Number of members that fill a worker; in_lockstep: the number on a device in lockstep."""
    return max(executor.devices, in_lockstep if executor.lockstep else 1)


ListenToJob = Callable[[Job, float, float], Sequence[Listener]]
"""Called before each job, with the share of the whole experiment that is finished and that of this
job; returns the listeners of its training."""


def carry_out(
    executor: Executor,
    jobs: Sequence[MembersJob],
    listen: ListenToJob,
    store: Callable[[Any, Any], None],
    log: Log,
    members: int = 0,
) -> bool:
    """Runs jobs; returns whether Ctrl-C stopped them.

    store: called with each finished job and its result. log: the experiment's log; its listener
    comes first in each job. members: of the experiment, if some have been trained before (default:
    those of the jobs).
    """
    left = sum(len(job.members) for job in jobs)
    whole = max(members, left)
    log.queue([job.name for job in jobs])

    def listeners(job: Job) -> Sequence[Listener]:
        assert isinstance(job, MembersJob)
        done, share = (whole - left) / whole, len(job.members) / whole
        return [log.job(job.name, job.members), *listen(job, done, share)]

    with (
        interruptible() as stop,
        contextlib.closing(executor.map(jobs, listeners)) as finished,
    ):
        for job, result in finished:
            store(job, result)
            assert isinstance(job, MembersJob)
            left -= len(job.members)
        log.settle(not left)
        return stop.is_set()


class _Persistent:
    """An executor that keeps its workers from one ``map`` to the next."""

    def __init__(self, executor: Executor) -> None:
        self.devices, self.lockstep = executor.devices, executor.lockstep
        self._waiting = SimpleQueue[Job]()
        self._listen: Callable[[Job], Sequence[Listener]] = lambda job: ()
        self.results = executor.map(self._jobs(), lambda job: self._listen(job))

    def map(
        self, jobs: Iterable[Job[R] | None], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Generator[tuple[Job[R], R], None, None]:
        self._listen = listen
        given = [job for job in jobs if job is not None]
        for job in given:
            self._waiting.put(job)
        yield from islice(self.results, len(given))

    def _jobs(self) -> Iterator[Job | None]:
        while True:
            try:
                yield self._waiting.get_nowait()
            except Empty:
                yield None


@contextlib.contextmanager
def persistent(executor: Executor) -> Iterator[Executor]:
    """Keeps the workers of an executor from one ``map`` to the next; ``Here`` has none to keep."""
    if isinstance(executor, Here):
        yield executor
        return
    workers = _Persistent(executor)
    # One event for all maps: the executor's generator, which goes on from one to the next, would
    # keep that of the first.
    with interruptible(), contextlib.closing(workers.results):
        yield workers
