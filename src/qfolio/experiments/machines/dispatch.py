"""The driver's side: gives jobs to workers, calls listeners and yields results.

A thread of its own talks to the workers, so that they get their next job while the main thread
writes files or a report.
"""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import AbstractContextManager
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

from qfolio.core.errors import QfolioError, WorkerError
from qfolio.experiments.executor import Job
from qfolio.experiments.fit import Listener
from qfolio.experiments.interrupts import interruptible
from qfolio.experiments.machines.messages import (
    Done,
    Failed,
    Lost,
    Message,
    Ready,
    Report,
    versions,
)
from qfolio.experiments.machines.remote import hear
from qfolio.experiments.machines.schedule import Schedule

R = TypeVar("R")

PATIENCE = 0.2
"""Seconds between a thread's checks of whether it should stop."""


@runtime_checkable
class Workers(Protocol):
    """Numbered places for workers; closing ends every worker. All calls come from one thread."""

    @property
    def count(self) -> int: ...

    def start(self, worker: int) -> None:
        """Starts a fresh worker in a place; a ``Ready`` follows."""
        ...

    def send(self, worker: int, job: Job) -> None:
        """Gives a worker a job; ``Report``s follow, and then a ``Done`` or ``Failed``."""
        ...

    def receive(self, seconds: float) -> list[tuple[int, Message]]:
        """Messages from workers, each with its worker's number; waits at most ``seconds``."""
        ...


class _Began(NamedTuple):
    """A worker has begun a job."""


class _Ended(NamedTuple):
    """The thread has ended, with an error or without."""

    error: BaseException | None


News = _Began | Report | Done


def dispatch(
    open_workers: Callable[[], AbstractContextManager[Workers]],
    jobs: Iterable[Job[R] | None],
    listen: Callable[[Job[R]], Sequence[Listener]],
) -> Generator[tuple[Job[R], R], None, None]:
    """Runs jobs on workers and yields each with its result, in the order in which they finish.

    Ctrl-C stops all workers at once; results that have arrived are still yielded.
    """
    heard: SimpleQueue[tuple[Job[R], News] | _Ended] = SimpleQueue()
    stop = threading.Event()

    def talk() -> None:
        error: BaseException | None = None
        try:
            with open_workers() as workers:
                drive(workers, jobs, lambda job, said: heard.put((job, said)), stop)
        except BaseException as raised:
            error = raised
        heard.put(_Ended(error))

    thread = threading.Thread(target=talk, daemon=True, name="qfolio-driver")
    listeners: dict[str, Sequence[Listener]] = {}
    with interruptible() as interrupted:
        thread.start()
        try:
            while True:
                if interrupted.is_set():
                    stop.set()
                try:
                    next_heard = heard.get(timeout=PATIENCE)
                except Empty:
                    continue
                if isinstance(next_heard, _Ended):
                    if next_heard.error is not None:
                        raise next_heard.error
                    return
                job, said = next_heard
                if isinstance(said, Done):
                    listeners.pop(job.name, None)
                    yield job, said.result
                elif not interrupted.is_set():
                    if isinstance(said, _Began):
                        listeners[job.name] = listen(job)
                    else:
                        for listener in listeners[job.name]:
                            hear(said, listener)
        finally:
            stop.set()
            thread.join()


def drive(
    workers: Workers,
    jobs: Iterable[Job[R] | None],
    tell: Callable[[Job[R], News], None],
    stop: threading.Event,
) -> None:
    """Gives every job to a worker, and to another if that worker is lost, until all are done.

    tell: called with each job that a worker begins, and with each of the worker's messages on it.

    Raises:
        QfolioError: A job failed or lost too many workers, or no worker starts.
    """
    schedule, wanted = Schedule(jobs), versions()
    idle, there, unused = list[int](), set[int](), deque(range(workers.count))
    while True:
        while idle and not stop.is_set():
            if (job := schedule.give(idle[-1])) is None:
                break
            worker = idle.pop()
            tell(job, _Began())
            workers.send(worker, job)
        if unused and not idle:
            coming = len(there) - schedule.running  # workers that start, and will take jobs, too
            for _ in range(schedule.waiting(coming + len(unused)) - coming):
                worker = unused.popleft()
                there.add(worker)
                workers.start(worker)
        if schedule.finished or stop.is_set():
            return
        for worker, said in workers.receive(PATIENCE):
            if isinstance(said, Ready):
                _require_same(said, wanted)
                schedule.start(worker)
                idle.append(worker)
            elif isinstance(said, Report):
                tell(schedule.of(worker), said)
            elif isinstance(said, Done):
                tell(schedule.finish(worker), said)
                idle.append(worker)
            elif isinstance(said, Failed):
                raise _failure(schedule.of(worker), said)
            elif isinstance(said, Lost):
                if worker in idle:
                    idle.remove(worker)
                if schedule.lose(worker, said.why, said.begun):
                    workers.start(worker)
                else:
                    there.remove(worker)
                    if not (there or unused):
                        raise QfolioError(f"No worker stays alive; the last one: {said.why}.")


def _require_same(ready: Ready, wanted: dict[str, str]) -> None:
    """Raises QfolioError if a worker's software versions differ from the driver's."""
    for name, version in wanted.items():
        if (other := ready.versions.get(name)) != version:
            raise QfolioError(
                f"The worker {ready.where} has {name} {other}, and this machine {version}; install "
                "the same version on all machines."
            )


def _failure(job: Job, failed: Failed) -> Exception:
    if failed.plain:
        return QfolioError(failed.error)
    return WorkerError(f"{job.name} failed on a worker:\n{failed.error}", failed.sentence)
