"""The progress of trainings that run on workers, for listeners in the driver."""

from collections.abc import Callable
from time import perf_counter
from typing import Any, Literal

from qfolio.core.errors import QfolioError
from qfolio.experiments.fit import Listener, Training
from qfolio.experiments.machines.messages import Report, place
from qfolio.experiments.records import Records

EVERY = 0.5
"""Minimum number of seconds between two reports, since many workers may have short chunks."""


class Reporter(Listener):
    """Reports a training to the driver: at its start, at its end and at intervals in between."""

    def __init__(self, send: Callable[[Report], None]) -> None:
        self.send, self.sent = send, 0.0
        self.rows: list[Records] = []  # of each chunk
        self.members: list[int] = []
        self.ends: list[int] = []

    def on_start(self, training: Training) -> None:
        self._report("on_start", training)

    def on_chunk(self, training: Training, rows: Records) -> None:
        self.rows.append(rows)
        self.members += training.members
        self.ends += training.ends
        if training.finished or perf_counter() - self.sent > EVERY:
            self._report("on_chunk", training)
            self.sent = perf_counter()

    def on_end(self, training: Training) -> None:
        self._report("on_end", training)

    def _report(self, hook: Literal["on_start", "on_chunk", "on_end"], training: Training) -> None:
        self.send(
            Report(
                hook,
                place(),
                training.budget,
                training.config,
                training.begun,
                training.left,
                training.steps,
                training.seconds,
                training.share,
                training.steps_per_second,
                training.seconds_left,
                Records.joined(self.rows),
                self.members,
                self.ends,
            )
        )
        self.rows, self.members, self.ends = [], [], []


class RemoteTraining(Training):
    """A training on a worker, as last reported; its population stays on the worker."""

    def __init__(self, report: Report) -> None:
        self.budget, self.config, self.begun = report.budget, report.config, report.begun
        self.left, self.seconds = report.left, report.seconds
        self.members, self.ends = report.members, report.ends
        self.interrupted, self.where = False, report.where
        self._report = report

    @property
    def steps(self) -> int:
        return self._report.steps

    @property
    def share(self) -> float:
        return self._report.share

    @property
    def steps_per_second(self) -> float:
        return self._report.steps_per_second

    @property
    def seconds_left(self) -> float:
        return self._report.seconds_left

    def __getattr__(self, name: str) -> Any:
        if name == "population":
            raise QfolioError(
                "A listener asks for the population of a training that runs on a worker; it may "
                "ask for progress and rows, or train in this process (--on here)."
            )
        raise AttributeError(name)


def hear(report: Report, listener: Listener) -> None:
    """Passes a worker's report to a listener."""
    training = RemoteTraining(report)
    if report.hook == "on_chunk":
        listener.on_chunk(training, report.rows)
    elif report.hook == "on_start":
        listener.on_start(training)
    else:
        listener.on_end(training)
