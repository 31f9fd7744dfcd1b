"""All experiments below a folder, searched and read again at the page's requests."""

import hashlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

from qfolio.experiments.events import CONTRAST, EVENTS
from qfolio.report.board.experiment import REPORT, Experiment

DEPTH = 4
"""How deep folders are searched; what lies within an experiment is its own, except a contrast."""

FRESH = 0.3
"""Seconds for which further requests are answered without reading again."""

READING = 1.0
"""Seconds after which an answer has what has been read of long logs so far."""


class Shelf:
    """The experiments below a folder by key; keys reveal nothing about paths.

    Each answer has a version; a page that sends the last version it saw gets the changes since.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self._experiments: dict[str, Experiment] = {}
        self._version, self._read = 0, -FRESH
        self._lock = threading.Lock()

    def runs(self, since: int) -> dict[str, Any]:
        """The summaries of experiments that have changed, and the keys of all.

        Those whose logs are still being read for the first time are only counted.
        """
        with self._lock:
            self._refresh()
            known = {key: each for key, each in self._experiments.items() if each.known}
            return {
                "version": self._version,
                "root": _readable(self.root.name),
                "reading": len(self._experiments) - len(known),
                "keys": list(known),
                "runs": [
                    experiment.summary(key)
                    for key, experiment in known.items()
                    if experiment.version > since
                ],
            }

    def run(self, key: str, since: int) -> dict[str, Any] | None:
        """The changed jobs of an experiment; None if no experiment has this key."""
        with self._lock:
            self._refresh()
            experiment = self._experiments.get(key)
            if experiment is None:
                return None
            return {"version": self._version, **experiment.detail(since)}

    def report(self, key: str, name: str) -> bytes | None:
        """A report in an experiment's folder: its own, or that of one of its parts.

        ``name`` is compared with the names of existing reports and never becomes a path.
        """
        with self._lock:
            experiment = self._experiments.get(key)
        if experiment is None:
            return None
        folder = experiment.log.parent
        there = [folder / REPORT, *folder.glob(f"tables/*/*/{REPORT}")]
        for path in there:
            if path.relative_to(folder).as_posix() == name and _is_plain(path, self.root):
                return path.read_bytes()
        return None

    def _refresh(self) -> None:
        if perf_counter() - self._read < FRESH:
            return
        self._version += 1
        found = {}
        for log in _logs(str(self.root), DEPTH):
            path = Path(log)
            name = path.parent.relative_to(self.root).as_posix()
            name = self.root.name if name == "." else name
            key = hashlib.sha256(log.encode(errors="surrogateescape")).hexdigest()[:16]
            found[key] = self._experiments.get(key) or Experiment(_readable(name), path)
        self._experiments = found
        until = perf_counter() + READING
        for experiment in found.values():
            experiment.refresh(self._version, until)
        self._read = perf_counter()


def _readable(name: str) -> str:
    """The name of a file, whose bytes need not be UTF-8."""
    return name.encode(errors="surrogateescape").decode(errors="replace")


def _logs(folder: str, depth: int) -> Iterator[str]:
    """Paths of the logs below a folder; links are not followed."""
    try:
        with os.scandir(folder) as entries:
            inside = [entry for entry in entries if not entry.name.startswith(".")]
            folders = [entry.path for entry in inside if entry.is_dir(follow_symlinks=False)]
            if any(e.name == EVENTS and e.is_file(follow_symlinks=False) for e in inside):
                yield os.path.join(folder, EVENTS)
                folders, depth = [path for path in folders if Path(path).name == CONTRAST], 1
    except OSError:
        return
    if depth:
        for path in folders:
            yield from _logs(path, depth - 1)


def _is_plain(path: Path, root: Path) -> bool:
    """Whether a path is a file that lies where it seems to, and no link leads elsewhere."""
    try:
        return path.is_file() and path.resolve() == path and path.is_relative_to(root)
    except OSError:
        return False
