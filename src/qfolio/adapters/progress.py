"""A progress bar for any training, in a notebook or on a terminal: ``qfolio.Progress``."""

import datetime
import math
import sys
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from time import perf_counter
from typing import Any

from qfolio.core.text import printable
from qfolio.experiments.log import Tracker

EVERY = 0.2
"""Minimum number of seconds between two updates of the bar."""

Show = Callable[[float, str], None]
"""Shows the share that is done, and a text beside the bar."""


class Progress(Tracker):
    """Shows how far training has come, and its latest numbers.

    >>> with qfolio.tracked(qfolio.Progress()):
    ...     qfolio.train(qfolio.Pendulum(), qfolio.DQN(), episodes=200)

    Notebooks need no widgets; ``qfolio`` on the command line has a progress display of its own.
    """

    def start(self, folder: Path | None, about: Mapping[str, Any]) -> None:
        agents = ", ".join(map(str, about.get("agents", [])))
        self._name = " on ".join(filter(None, (agents, str(about.get("task", "")))))
        self._jobs: dict[str, float] = {}  # finished share of each
        self._before: dict[str, float] = {}  # the same, when it was resumed
        self._text, self._begun, self._shown, self._state = "", perf_counter(), 0.0, ""
        self._show, self._close = _in_notebook() or _on_terminal()

    def event(self, event: Mapping[str, Any]) -> None:
        kind, job = event["event"], event.get("job", "")
        if kind == "queued":
            self._jobs |= {name: 0.0 for name in event["jobs"] if name not in self._jobs}
        elif kind == "running":
            self._jobs[job] = self._before[job] = event.get("share", 0.0)
        elif kind == "done":
            self._jobs[job] = 1.0
        elif kind == "record":
            self._jobs[job] = event.get("share", self._jobs.get(job, 0.0))
            rate = f"{event['rate']:,.0f} steps/s" if event.get("rate") else ""
            values = event["values"].get("return", [])
            known = [x for x in values if x is not None and math.isfinite(x)]
            mean = f"return {sum(known) / len(known):.4g}" if known else ""
            self._text = "  ".join(filter(None, (mean, rate))) or self._text
        elif kind == "end" and event["state"] != "done":
            self._state = event["state"]
        if kind == "end" or perf_counter() - self._shown > EVERY:
            self._shown = perf_counter()
            self._show(self._done, self._said)

    def finish(self) -> None:
        self._close()

    @property
    def _done(self) -> float:
        return sum(self._jobs.values()) / max(len(self._jobs), 1)

    @property
    def _said(self) -> str:
        spent, done = perf_counter() - self._begun, self._done
        here = done - sum(self._before.values()) / max(len(self._jobs), 1)
        left = datetime.timedelta(seconds=round(spent * (1 - done) / here)) if here > 0 else None
        jobs = f"{sum(x == 1 for x in self._jobs.values())} of {len(self._jobs)} jobs"
        parts = [self._name, f"{done:.0%}", jobs if len(self._jobs) > 1 else "", self._text]
        time = "" if left is None else f"{left} left" if done < 1 else f"{spent:.1f} s"
        parts.append(self._state or time)
        return printable("  ".join(filter(None, parts)))


def _in_notebook() -> tuple[Show, Callable[[], None]] | None:
    """A display in the cell that is being run; None outside notebooks."""
    interactive = sys.modules.get("IPython")
    shell = None if interactive is None else interactive.get_ipython()
    if shell is None or not hasattr(shell, "kernel"):
        return None
    from IPython.display import HTML, display

    handle = display(HTML(""), display_id=True)

    def show(done: float, text: str) -> None:
        bar = f'<progress value="{done:.4f}" max="1" style="width: 16em"></progress>'
        handle.update(HTML(f"<div>{bar}&ensp;{escape(text)}</div>"))

    return show, lambda: None


def _on_terminal() -> tuple[Show, Callable[[], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    console = Console()
    text = TextColumn("{task.description}", markup=False)
    bar = Bar(BarColumn(bar_width=24), text, console=console, disable=not console.is_terminal)
    bar.start()
    task = bar.add_task("", total=1.0)
    return lambda done, said: bar.update(task, completed=done, description=said), bar.stop
