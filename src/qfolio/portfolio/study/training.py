"""Training for a study: the jobs of one backtest after another, as workers become free."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from qfolio.core.errors import QfolioError
from qfolio.experiments.executor import Executor, Job, ListenToJob
from qfolio.experiments.fit import Listener
from qfolio.experiments.log import Log
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.training import FoldsJob, TrainedFold
from qfolio.portfolio.study.folder import Variant

Listen = Callable[[str, Variant, Backtest], ListenToJob]


@dataclass(frozen=True)
class PlacedJob:
    """A job of the backtest of one table and variant."""

    table: str
    variant: Variant
    job: FoldsJob

    @property
    def name(self) -> str:
        return f"{self.table}/{self.variant.name}/{self.job.name}"

    def run(self, listeners: Sequence[Listener]) -> dict[str, TrainedFold] | None:
        with of_table(self.table):
            return self.job.run(listeners)


@dataclass
class Place:
    """A backtest in training, and how many of its members are left."""

    table: str
    variant: Variant
    backtest: Backtest
    left: int
    listen: ListenToJob | None = None


class Trainings:
    """The training that backtests still need, as jobs for an executor.

    places: tables and variants. open_backtest: called when a worker is free for a backtest's first
    job. listen: called when that job begins. log: the study's log.
    """

    def __init__(
        self,
        places: Iterable[tuple[str, Variant]],
        open_backtest: Callable[[str, Variant], Backtest],
        executor: Executor,
        listen: Listen | None,
        log: Log,
    ) -> None:
        self._places, self._open, self._executor = list(places), open_backtest, executor
        self._listen, self._log = listen, log
        self._of: dict[str, Place] = {}  # the place of each job that is not finished

    def jobs(self) -> Iterator[PlacedJob]:
        """The jobs, of one backtest after another."""
        for table, variant in self._places:
            with of_table(table):
                backtest = self._open(table, variant)
            made = [PlacedJob(table, variant, job) for job in backtest.jobs(self._executor)]
            place = Place(table, variant, backtest, sum(len(job.job.members) for job in made))
            self._of.update((job.name, place) for job in made)
            self._log.queue([job.name for job in made])
            yield from made

    def listeners(self, job: Job[dict[str, TrainedFold]]) -> Sequence[Listener]:
        """The listeners of a job that begins."""
        assert isinstance(job, PlacedJob)
        log = self._log.job(job.name, job.job.members)
        if self._listen is None:
            return [log]
        place = self._of[job.name]
        if place.listen is None:
            place.listen = self._listen(place.table, place.variant, place.backtest)
        whole = place.backtest.members
        done, share = (whole - place.left) / whole, len(job.job.members) / whole
        return [log, *place.listen(job.job, done, share)]

    def store(self, job: Job[dict[str, TrainedFold]], trained: dict[str, TrainedFold]) -> Place:
        """Keeps what a job has trained, and returns its backtest's place."""
        assert isinstance(job, PlacedJob)
        place = self._of.pop(job.name)
        place.backtest.store(job.job, trained)
        place.left -= len(job.job.members)
        return place


@contextlib.contextmanager
def of_table(name: str) -> Iterator[None]:
    """Puts the table's name in front of errors in this block."""
    try:
        yield
    except QfolioError as error:
        raise QfolioError(f"{name}: {error}") from None
