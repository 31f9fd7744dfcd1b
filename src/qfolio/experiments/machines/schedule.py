"""The assignment of jobs to workers. Pure bookkeeping: no processes, no clock, no network."""

from collections import Counter, deque
from collections.abc import Iterable
from typing import Generic, TypeVar

from qfolio.core.errors import QfolioError
from qfolio.experiments.executor import Job

ATTEMPTS = 3
"""Maximum number of workers lost on one job, and of failed starts in a row in one place."""

R = TypeVar("R")


class Schedule(Generic[R]):
    """Gives jobs to workers in order; the job of a lost worker comes first again.

    jobs: taken one by one, when a worker is free or a place for one is; a None means that there is
    no job at present. Workers are numbers.
    """

    def __init__(self, jobs: Iterable[Job[R] | None]) -> None:
        self._jobs, self._exhausted = iter(jobs), False
        self._again: deque[Job[R]] = deque()
        self._taken: deque[Job[R]] = deque()
        self._running: dict[int, Job[R]] = {}
        self._losses: Counter[str] = Counter()
        self._failed_starts: Counter[int] = Counter()

    def give(self, worker: int) -> Job[R] | None:
        """The next job for a worker that is free; None if there is none at present."""
        if not self.waiting(1):
            return None
        self._running[worker] = (self._again or self._taken).popleft()
        return self._running[worker]

    def waiting(self, most: int) -> int:
        """Number of jobs that wait for a worker, up to ``most``; takes more until there are."""
        while (count := len(self._again) + len(self._taken)) < most and not self._exhausted:
            try:
                job = next(self._jobs)
            except StopIteration:
                self._exhausted = True
            else:
                if job is None:
                    break
                self._taken.append(job)
        return min(count, most)

    @property
    def running(self) -> int:
        """Number of jobs that workers run."""
        return len(self._running)

    @property
    def finished(self) -> bool:
        """Whether no job is running, waits, or may still come."""
        return self._exhausted and not (self._running or self._again or self._taken)

    def of(self, worker: int) -> Job[R]:
        """The job that a worker is running."""
        return self._running[worker]

    def start(self, worker: int) -> None:
        """Records that a worker has started."""
        self._failed_starts[worker] = 0

    def finish(self, worker: int) -> Job[R]:
        """Records that a worker has finished its job; returns the job."""
        return self._running.pop(worker)

    def lose(self, worker: int, why: str, begun: bool = True) -> bool:
        """Records that a worker is lost; returns whether to start another in its place.

        Raises QfolioError if its job has lost too many workers. begun: whether the worker may have
        begun the job; otherwise the job is not to blame.
        """
        job = self._running.pop(worker, None)
        if job is None:
            self._failed_starts[worker] += 1
            return self._failed_starts[worker] < ATTEMPTS
        self._losses[job.name] += begun
        if self._losses[job.name] == ATTEMPTS:
            raise QfolioError(
                f"{job.name} was given up, because {ATTEMPTS} workers ended while they ran it "
                f"(the last one: {why}); give each worker more memory, or run fewer at once."
            )
        self._again.append(job)
        return True
