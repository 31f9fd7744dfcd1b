"""The progress of trainings that run on workers, for listeners in the driver."""

import dataclasses
from collections.abc import Callable
from time import perf_counter
from typing import Literal

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
        told = dataclasses.replace(
            training,
            _population=None,
            where=place(),
            members=self.members,
            ends=self.ends,
            interrupted=False,
        )
        self.send(Report(hook, told, Records.joined(self.rows)))
        self.rows, self.members, self.ends = [], [], []


def hear(report: Report, listener: Listener) -> None:
    """Passes a worker's report to a listener."""
    if report.hook == "on_chunk":
        listener.on_chunk(report.training, report.rows)
    elif report.hook == "on_start":
        listener.on_start(report.training)
    else:
        listener.on_end(report.training)
