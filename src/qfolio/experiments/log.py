"""Writing the log of an experiment, which ``events.py`` describes."""

import contextlib
import math
import os
import platform
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import msgspec
import numpy as np

from qfolio.core.errors import QfolioError, one_line, told
from qfolio.core.files import naming
from qfolio.experiments.events import BEAT, EVENTS
from qfolio.experiments.fit import Listener, Training
from qfolio.experiments.interrupts import before_leaving
from qfolio.experiments.lasting import current
from qfolio.experiments.records import Records

SHARE, SHORTEST, LONGEST = 0.05, 0.05, 1.0
"""Time between two records: a share of the training time so far, within limits in seconds."""

PARTS = 50
"""Minimum number of records of a training with enough episodes; long chunks are split."""

RECENT = 500
"""A record's means are of the latest episodes: so many, or more that ended at the same step (four
per member if that is more)."""


class Tracker:
    """A follower of a log, such as TensorBoard; subclasses override the methods that they need."""

    def start(self, folder: Path | None, about: Mapping[str, Any]) -> None:
        """Called when work begins.

        folder: of the experiment; None if it has none. about: the content of the ``start`` event.
        """

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Called with numbers by name; with several jobs, the names are ``job/metric``.

        step: environment steps of each of the job's members. Grades are ``result/agent/measure``;
            a command logs them after its training, at its largest step. A search logs those of its
            best so far after each batch, at the number of its trials.
        """

    def event(self, event: Mapping[str, Any]) -> None:
        """Called with every event after the start, as logged; numbers also go to ``log``."""

    def finish(self) -> None:
        """Called when the work has ended, for whatever reason."""


_trackers: ContextVar[tuple[Tracker, ...]] = ContextVar("trackers", default=())


@contextlib.contextmanager
def tracked(*trackers: Tracker) -> Iterator[None]:
    """Has trackers follow all work that begins in this block."""
    token = _trackers.set((*_trackers.get(), *trackers))
    try:
        yield
    finally:
        _trackers.reset(token)


class Log:
    """The log of an experiment; use it within ``opened``.

    folder: the experiment's folder; without one, events go to trackers only.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder, self._file = folder, -1
        self._trackers: list[Tracker] = []
        self._telling = threading.Lock()
        self._step = 0  # the largest that trackers were told
        self.state = "done"  # how the work ends, unless an error ends it

    @contextlib.contextmanager
    def opened(self, **about: Any) -> Iterator["Log"]:
        """Logs the start, and the end for whatever reason; about: a description of the work.

        Within ``lasting`` it ends with that block, and goes on if it is opened there again.
        """
        outer = current()
        if outer is None or self.folder is None:
            with self._opened(about) as log:
                yield log
            return
        if self.folder not in outer.logs:
            outer.logs[self.folder] = outer.enter_context(self._opened(about))
        log = outer.logs[self.folder]
        try:
            yield log
        except BaseException as error:  # which the block around may catch
            log.state = "failed" if isinstance(error, Exception) else "stopped"
            raise

    @contextlib.contextmanager
    def _opened(self, about: Mapping[str, Any]) -> Iterator["Log"]:
        trackers = _trackers.get()
        with contextlib.ExitStack() as stack:
            if self.folder is not None:
                stack.enter_context(self.appending())
                stack.enter_context(_heartbeat(self.folder / EVENTS))
            here = {"pid": os.getpid(), "host": platform.node()}
            self.write("start", **about, **here)
            stack.callback(self._tell, lambda tracker: tracker.finish())
            stopped = partial(self._append, "end", state="stopped", **here)
            stack.enter_context(before_leaving(stopped))
            begin = lambda tracker: tracker.start(self.folder, about)  # noqa: E731
            try:
                for tracker in trackers:
                    if self._heard(tracker, begin, QfolioError):
                        self._trackers.append(tracker)
                yield self
            except BaseException as error:
                failed = isinstance(error, Exception)
                sentence = told(error) if failed else None
                why = {"error": sentence} if sentence else {}
                self.write("end", state="failed" if failed else "stopped", **why, **here)
                raise
            self.write("end", state=self.state, **here)

    @contextlib.contextmanager
    def appending(self) -> Iterator[None]:
        """Within the block, events go to the folder's log, without a start and an end."""
        assert self.folder is not None
        self._file = _open(self.folder / EVENTS)
        try:
            yield
        finally:
            os.close(self._file)
            self._file, self._trackers = -1, []

    def write(self, event: str, **values: Any) -> None:
        """Appends an event, and tells it to the trackers."""
        content = self._append(event, **values)
        self._tell(lambda tracker: tracker.event(content))

    def _append(self, event: str, **values: Any) -> dict[str, Any]:
        """Appends an event in one write, so that several threads and processes can share a log."""
        content = {"event": event, "time": round(time.time(), 3), **values}
        if self.folder is not None and self._file >= 0:
            with naming(self.folder / EVENTS):
                os.write(self._file, msgspec.json.encode(content) + b"\n")
        return content

    def settle(self, finished: bool) -> None:
        """Sets how the work ends: finished, or stopped early."""
        self.state = "done" if finished else "stopped"

    def queue(self, jobs: Sequence[str]) -> None:
        """Logs the jobs that will run."""
        if jobs:
            self.write("queued", jobs=list(jobs))

    def job(self, name: str = "", members: Sequence[str] = (), since: int = 0) -> "JobLog":
        """The listener that logs a job's training.

        members: their names, such as seeds. since: a member's steps before the job first began.
        """
        return JobLog(self, name, members, since)

    def result(
        self, values: Mapping[str, Mapping[str, float | None]], step: int | None = None
    ) -> None:
        """Logs the measures of trained agents, by name.

        step: what trackers are told (default: the largest before).
        """
        self.write("result", values=values)
        known = {
            f"result/{name}/{measure}": x
            for name, measures in values.items()
            for measure, x in measures.items()
            if x is not None and math.isfinite(x)
        }
        at = self._step if step is None else step
        self._tell(lambda tracker: tracker.log(known, at))

    def track(self, job: str, step: int, values: Mapping[str, Sequence[float | None]]) -> None:
        """Passes the means over members to the trackers."""
        if self._trackers:
            prefix = f"{job}/" if job else ""
            known = {
                name: [x for x in each if x is not None and math.isfinite(x)]
                for name, each in values.items()
            }
            means = {f"{prefix}{k}": sum(x) / len(x) for k, x in known.items() if x}
            self._step = max(self._step, step)
            self._tell(lambda tracker: tracker.log(means, step))

    def _tell(self, tell: Callable[[Tracker], None]) -> None:
        """Calls all trackers; one that fails is dropped with a warning, and training goes on.

        One call at a time: a study queues jobs while others report.
        """
        with self._telling:
            self._trackers = [tracker for tracker in self._trackers if self._heard(tracker, tell)]

    def _heard(
        self, tracker: Tracker, tell: Callable[[Tracker], None], *fatal: type[Exception]
    ) -> bool:
        """Whether a call of a tracker succeeded; warns if not, unless the error is fatal."""
        try:
            tell(tracker)
        except fatal:
            raise
        except Exception as error:
            name = type(tracker).__name__
            warnings.warn(f"The tracker {name} is left out: {one_line(error)}", stacklevel=2)
            return False
        return True


class JobLog(Listener):
    """Logs the training of a job."""

    def __init__(self, log: Log, name: str, members: Sequence[str], since: int) -> None:
        self.log, self.name, self.members, self.since = log, name, list(members), since
        self._rows: list[Records] = []  # of each chunk
        self._of: list[int] = []  # the member of each row
        self._ends: list[int] = []  # the step at which the episode of each row ended
        self._due = 0.0
        self._step, self._share = 0, 0.0  # of the previous record

    def on_start(self, training: Training) -> None:
        self._step, self._share = training.steps, training.share_since(self.since)
        self.log.write(
            "running",
            job=self.name,
            step=training.steps,
            worker=training.where,
            members=self.members,
            share=round(self._share, 4),
        )

    def on_chunk(self, training: Training, rows: Records) -> None:
        self._rows.append(rows)
        self._of += training.members
        self._ends += training.ends
        if perf_counter() >= self._due:
            self._flush(training)
            apart = min(max(SHORTEST, SHARE * training.seconds), LONGEST)
            self._due = perf_counter() + apart

    def on_end(self, training: Training) -> None:
        if any(self._rows):
            self._flush(training)
        state = "done" if training.finished else "stopped"
        self.log.write(state, job=self.name, step=training.steps)

    def record(self, step: int, values: Mapping[str, Sequence[float | None]], **more: Any) -> None:
        """Logs numbers of each member by name."""
        self.log.write("record", job=self.name, step=step, **more, values=values)
        self.log.track(self.name, step, values)

    def _flush(self, training: Training) -> None:
        rows, members, ends = Records.joined(self._rows), self._of, self._ends
        step, share = training.steps, training.share_since(self.since)
        parts = math.ceil(PARTS * (share - self._share))
        for some in _parts(np.array(ends, int), parts, max(1, len(self.members))):
            at = step if some.stop == len(rows) else ends[some.stop - 1]
            done = (at - self._step) / max(step - self._step, 1)
            self.record(
                at,
                means(rows[some], members[some], len(self.members)),
                share=round(self._share + (share - self._share) * done, 4),
                rate=round(training.steps_per_second, 1),
                left=round(training.seconds_left, 1),
            )
        self._rows, self._of, self._ends, self._step, self._share = [], [], [], step, share


def _parts(ends: np.ndarray, count: int, members: int) -> list[slice]:
    """The latest rows of each of ``count`` parts of some rows, or fewer.

    A part has a row for each member on average, and rows whose episodes end at the same step stay
    together: they are of several members.
    """
    if not len(ends):
        return [slice(0, 0)]
    count, found, begin = max(1, min(count, len(ends) // members)), [], 0
    last = ends[len(ends) * np.arange(1, count + 1) // count - 1]
    for stop in np.unique(np.searchsorted(ends, last, "right")).tolist():
        recent = int(np.searchsorted(ends, ends[max(stop - max(RECENT, 4 * members), 0)]))
        found.append(slice(max(begin, recent), stop))
        begin = stop
    return found


def means(rows: Records, members: Sequence[int], count: int) -> dict[str, list[float | None]]:
    """The mean of each number over each member's rows; None if a member has no row."""
    of, result = np.asarray(members, int), {}
    for name, column in rows.columns.items():
        if name != "seed":
            known = np.isfinite(column)  # metrics of learning are NaN before it begins
            weights = np.bincount(of[known], minlength=count)
            if name == "episode":  # counted from 1, in order
                mean = np.zeros(count)
                mean[of] = column
            else:
                mean = np.bincount(of[known], column[known], count) / np.maximum(weights, 1)
            result[name] = [
                float(f"{x:.6g}") if yes else None
                for x, yes in zip(mean.tolist(), (weights > 0).tolist(), strict=True)
            ]
    return result


def seed_names(seeds: Iterable[int]) -> list[str]:
    """The names of the members of a population of seeds."""
    return [f"seed {seed}" for seed in seeds]


def add_result(folder: Path | None, values: Mapping[str, Mapping[str, float | None]]) -> None:
    """Appends the measures of trained agents, by name, to a folder's log if it has one.

    Trackers hear of them within ``lasting``; else they have finished by then.
    """
    outer = current()
    if outer is not None and folder in outer.logs:
        outer.logs[folder].result(values)
    elif folder is not None and (folder / EVENTS).exists():
        log = Log(folder)
        with log.appending():
            log.result(values)


def _open(path: Path) -> int:
    """Opens a log for appending; ends an incomplete line that a killed process left."""
    file = os.open(path, os.O_APPEND | os.O_CREAT | os.O_RDWR | getattr(os, "O_BINARY", 0), 0o666)
    if os.fstat(file).st_size:
        os.lseek(file, -1, os.SEEK_END)
        if os.read(file, 1) != b"\n":
            os.write(file, b"\n")
    return file


@contextlib.contextmanager
def _heartbeat(path: Path) -> Iterator[None]:
    stop = threading.Event()

    def beat() -> None:
        while not stop.wait(BEAT):
            with contextlib.suppress(OSError):
                os.utime(path)

    thread = threading.Thread(target=beat, daemon=True, name="qfolio-heartbeat")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
