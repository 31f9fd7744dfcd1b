"""All experiments below a folder, searched and read again at the page's requests."""

import hashlib
import os
import threading
from collections import deque
from pathlib import Path
from time import perf_counter
from typing import Any

from qfolio.experiments.events import CONTRAST, EVENTS
from qfolio.report.board.experiment import REPORT, Experiment

FOLDERS = 10_000
"""Maximum number of folders searched, the nearest first."""

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
        self._next = 0.0  # when to search for logs again, by perf_counter
        self._searched = True
        self._lock = threading.Lock()

    def runs(self, since: int) -> dict[str, Any]:
        """The summaries of experiments that have changed, and the keys of all.

        Those whose logs are still being read for the first time are only counted. ``searched``:
        how many folders were searched if there are more.
        """
        with self._lock:
            self._refresh()
            known = {key: each for key, each in self._experiments.items() if each.known}
            return {
                "version": self._version,
                "root": _readable(self.root.name),
                "reading": len(self._experiments) - len(known),
                "searched": None if self._searched else FOLDERS,
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
        begun = perf_counter()
        if begun >= self._next:
            self._search()
            # A large tree is searched for a twentieth of the time, a small one at each answer.
            self._next = perf_counter() + 20 * max(0.0, perf_counter() - begun - 0.01)
        until = perf_counter() + READING
        for experiment in self._experiments.values():
            experiment.refresh(self._version, until)
        self._read = perf_counter()

    def _search(self) -> None:
        found = {}
        logs, self._searched = _logs(str(self.root), FOLDERS)
        for log in logs:
            path = Path(log)
            name = path.parent.relative_to(self.root).as_posix()
            name = self.root.name if name == "." else name
            key = hashlib.sha256(log.encode(errors="surrogateescape")).hexdigest()[:16]
            found[key] = self._experiments.get(key) or Experiment(_readable(name), path)
        self._experiments = found


def _readable(name: str) -> str:
    """The name of a file, whose bytes need not be UTF-8."""
    return name.encode(errors="surrogateescape").decode(errors="replace")


def _logs(root: str, most: int) -> tuple[list[str], bool]:
    """Paths of the logs below a folder, and whether all its folders were searched.

    What lies within an experiment is its own, except a contrast. Links are not followed.
    """
    logs, folders = [], deque([root])
    for _ in range(most):
        if not folders:
            break
        folder = folders.popleft()
        try:
            with os.scandir(folder) as entries:
                inside = [entry for entry in entries if not entry.name.startswith(".")]
                below = [entry.path for entry in inside if entry.is_dir(follow_symlinks=False)]
                if any(e.name == EVENTS and e.is_file(follow_symlinks=False) for e in inside):
                    logs.append(os.path.join(folder, EVENTS))
                    below = [path for path in below if os.path.basename(path) == CONTRAST]
        except OSError:
            continue
        folders.extend(below)
    return logs, not folders


def _is_plain(path: Path, root: Path) -> bool:
    """Whether a path is a file that lies where it seems to, and no link leads elsewhere."""
    try:
        return path.is_file() and path.resolve() == path and path.is_relative_to(root)
    except OSError:
        return False
