"""The state of one experiment, read from its log and kept small however long the log grows.

Logs are untrusted: events that do not have the form that ``log.py`` writes are skipped.
"""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from qfolio.experiments.events import SILENT, Event, read

POINTS = 400
"""Maximum number of points of a curve; beyond it, every other point and record is dropped."""

SHOWN = 100_000
"""Maximum number of points that a page gets of all curves of an experiment, if two of each fit."""

FIRST = 500
"""Bytes of the first line by which a log is told from an earlier one of the same name."""

JOBS = 20_000
"""Maximum number of jobs kept of an experiment."""

REPORT = "report.html"

SHARED = "search"
"""The kind of experiment that several processes may work on at once."""

DEAD = 600.0
"""Seconds without an event after which the processes of such an experiment were killed, although
the log has no end; longer than a chunk or a compilation takes."""

Point = tuple[float, float, float, float]
"""A step, and the mean, lowest and highest value there."""

State = Literal["queued", "running", "done", "stopped", "failed"]


class Start(msgspec.Struct):
    time: float
    kind: str = ""
    task: str = ""
    agents: list[str] = []
    seeds: int | None = None
    pid: int | None = None
    host: str = ""


class End(msgspec.Struct):
    time: float
    state: State
    error: str = ""
    pid: int | None = None
    host: str = ""


class Queued(msgspec.Struct):
    jobs: list[str]


class JobEvent(msgspec.Struct):
    event: State
    time: float
    job: str
    step: float | None = None
    worker: str = ""
    members: list[str] = []
    share: float | None = None
    error: str = ""


class Record(msgspec.Struct):
    time: float
    job: str
    step: float
    values: dict[str, list[float | None]]
    share: float | None = None
    rate: float | None = None
    left: float | None = None


class Result(msgspec.Struct):
    values: dict[str, dict[str, float | None]]


KINDS: dict[str, type[msgspec.Struct]] = {
    "start": Start, "end": End, "queued": Queued, "record": Record, "result": Result,
    **dict.fromkeys(("running", "done", "stopped", "failed"), JobEvent),
}  # fmt: skip


class Curve:
    """A metric over a job's steps: the mean, lowest and highest value over its members."""

    def __init__(self) -> None:
        self.points: list[Point] = []
        self._every, self._since = 1, 0  # a point is kept of so many, and those since the last

    def add(self, step: float, values: Sequence[float | None]) -> None:
        """Adds what the members have at a step; a long curve keeps some points, and the latest."""
        known = [x for x in values if x is not None and math.isfinite(x)]
        if not known:
            return
        if self._since:
            self.points.pop()
        self.points.append((step, sum(known) / len(known), min(known), max(known)))
        self._since = (self._since + 1) % self._every
        if len(self.points) > POINTS and not self._since:
            self.points, self._every = self.points[::2], 2 * self._every

    def cut(self, step: float) -> None:
        """Drops the points beyond a step."""
        self.points = [point for point in self.points if point[0] <= step]
        self._since = 0


class Job:
    """A job's state and curves. version: the board's version when the job last changed."""

    def __init__(self) -> None:
        self.state: State = "queued"
        self.worker = ""
        self.members: list[str] = []
        self.step, self.share = 0.0, 0.0
        self.rate: float | None = None
        self.left: float | None = None
        self.begun: float | None = None
        self.ended: float | None = None
        self.curves: dict[str, Curve] = {}
        self.version = 0

    def change(self, said: JobEvent) -> None:
        self.state = said.event
        if said.event == "running":
            self.worker, self.members, self.begun = said.worker, said.members, said.time
            self.ended, self.step = None, said.step or 0.0
            self.share, self.rate, self.left = _share(said.share or 0.0), None, None
            for curve in self.curves.values():
                curve.cut(self.step)
        else:
            self.ended, self.left = said.time, None
            if said.event == "done":
                self.share = 1.0

    def record(self, said: Record) -> None:
        self.step = max(self.step, said.step)
        if said.share is not None:
            self.share, self.rate, self.left = _share(said.share), said.rate, said.left
        for name, values in said.values.items():
            if name != "episode":
                self.curves.setdefault(name, Curve()).add(said.step, values)

    def to_json(self, name: str, most: int = POINTS) -> dict[str, Any]:
        """What a page shows of it; most: the maximum number of points of a curve."""
        return {
            "name": name, "state": self.state, "worker": self.worker, "share": self.share,
            "members": len(self.members), "rate": self.rate, "left": self.left, "step": self.step,
            "begun": self.begun, "ended": self.ended,
            "curves": {name: thinned(curve.points, most) for name, curve in self.curves.items()},
        }  # fmt: skip


class Experiment:
    """A folder with a log. version: the board's version when anything last changed.

    known: whether the log has been read to its end once; until then, the state says nothing.
    """

    def __init__(self, name: str, log: Path) -> None:
        self.name, self.log, self.version = name, log, 0
        self.known = False
        self._forget()

    def _forget(self) -> None:
        self._offset, self._first, self._touched = 0, b"", 0.0
        self._moved = -math.inf  # when the touch was seen to change, by perf_counter
        self.about = Start(0.0)
        self.begun: float | None = None  # the first time
        self.paused = 0.0  # seconds without work between that and the last event
        self.last = 0.0  # time of the last event
        self.end: End | None = None  # of the work that ended last
        self._working: set[tuple[int | None, str]] = set()  # processes that have not ended
        self.jobs: dict[str, Job] = {}
        self.results: dict[str, dict[str, float | None]] = {}
        self._seen: tuple[Any, ...] = ()

    def refresh(self, version: int, until: float = math.inf) -> None:
        """Reads the new events of the log; what they change gets this version.

        until: when to go on at the next call, by ``perf_counter``.
        """
        try:
            status = self.log.stat()
            first = _first_line(self.log) if status.st_size != self._offset else self._first
            if status.st_size < self._offset or first != self._first:
                self._forget()
                self._first, self.version = first, version
            if self._touched and self._touched != status.st_mtime:
                self._moved = time.perf_counter()
            self._touched = status.st_mtime
            behind = self._offset < status.st_size
            while behind and time.perf_counter() < until:
                events, offset = read(self.log, self._offset)
                behind = self._offset < offset < status.st_size
                self._offset = offset
                for event in events:
                    self._take(event, version)
            self.known = self.known or not behind
        except OSError:  # deleted, or on a disk that is gone
            self.known = True
            return
        seen = (self.known, self.state, self._has_report)
        if seen != self._seen:
            self._seen, self.version = seen, version

    @property
    def state(self) -> State:
        if self._working and self._alive:
            return "running"
        return "stopped" if self.end is None else self.end.state

    @property
    def _has_report(self) -> bool:
        """Whether its report can be opened; a link is not followed."""
        report = self.log.parent / REPORT
        return report.is_file() and not report.is_symlink()

    @property
    def _alive(self) -> bool:
        """Whether the log was touched lately, by this clock or by that of a file server."""
        if abs(time.time() - self._touched) < SILENT:
            return True
        return time.perf_counter() - self._moved < SILENT

    def _take(self, event: Event, version: int) -> None:
        try:
            said = msgspec.convert(event, KINDS[event["event"]])
        except (msgspec.ValidationError, KeyError, RecursionError):
            return
        self.version = version
        if isinstance(said, Start):
            pause = max(said.time - self.last, 0.0)
            if said.kind != SHARED or pause > DEAD:
                self._working.clear()
            if self.begun is None:
                self.begun = said.time
            elif not self._working:
                self.paused += pause
            self.about, self.last = said, said.time
            if said.kind != SHARED:
                self.end = None
            self._working.add((said.pid, said.host))
        elif isinstance(said, End):
            self.end, self.last = said, said.time
            self._working.discard((said.pid, said.host))
            if said.state == "done" and not self._working:
                # Work that was stopped may have been divided into other jobs.
                ended = ("done", "failed")
                self.jobs = {name: job for name, job in self.jobs.items() if job.state in ended}
        elif isinstance(said, Result):
            self.results.update(said.values)
        elif isinstance(said, Queued):
            for name in said.jobs:
                self._job(name, version).state = "queued"
        elif isinstance(said, JobEvent):
            self.last = said.time
            self._job(said.job, version).change(said)
        elif isinstance(said, Record):
            self.last = said.time
            self._job(said.job, version).record(said)

    def _job(self, name: str, version: int) -> Job:
        job = self.jobs.get(name)
        if job is None:
            job = Job()
            if len(self.jobs) < JOBS:
                self.jobs[name] = job
        job.version = version
        return job

    @property
    def share(self) -> float:
        """The finished share of all known jobs."""
        return sum(job.share for job in self.jobs.values()) / max(len(self.jobs), 1)

    def summary(self, key: str) -> dict[str, Any]:
        """The entry in the list of experiments, with None where its log says nothing.

        key: the page's key for the experiment.
        """
        states = [job.state for job in self.jobs.values()]
        jobs = self.jobs.values() if self.state == "running" else ()
        running = [job for job in jobs if job.state == "running"]
        first = next((job for job in self.jobs.values() if job.curves), None)
        spark = _spark(first) if first else []
        return {
            "key": key, "name": self.name, "state": self.state, "kind": self.about.kind,
            "task": self.about.task, "agents": self.about.agents, "seeds": self.about.seeds,
            "share": self.share if self.jobs else None,
            "begun": self.begun, "last": self.last or None, "paused": self.paused,
            "rate": sum(job.rate or 0.0 for job in running) or None,
            "jobs": {state: states.count(state) for state in sorted(set(states))},
            "workers": len({job.worker for job in running if job.worker}),
            "host": self.about.host, "error": self.end.error if self.end else "",
            "report": self._has_report, "spark": spark,
        }  # fmt: skip

    def detail(self, since: int) -> dict[str, Any]:
        """All results, the names of all jobs, and those that have changed after a version."""
        curves = sum(len(job.curves) for job in self.jobs.values())
        most = min(POINTS, max(2, SHOWN // max(curves, 1)))
        changed = {name: job for name, job in self.jobs.items() if job.version > since}
        return {
            "results": self.results,
            "names": list(self.jobs),
            "jobs": [job.to_json(name, most) for name, job in changed.items()],
        }


def thinned(points: list[Point], most: int) -> list[Point]:
    """At most about so many of the points, evenly spaced, the last one among them."""
    return points[:: -max(1, -(-len(points) // most))][::-1]


def _share(said: float) -> float:
    return min(max(said, 0.0), 1.0)


def _first_line(log: Path) -> bytes:
    with log.open("rb") as file:
        return file.readline(FIRST)


def _spark(job: Job) -> list[float]:
    """About 40 means of the most informative curve."""
    curve = job.curves.get("return") or next(iter(job.curves.values()))
    return [point[1] for point in thinned(curve.points, 40)]
