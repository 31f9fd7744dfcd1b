"""events.jsonl, the log of an experiment: one JSON object per line, appended as events happen.

One log serves every reader: ``qfolio board`` and trackers such as TensorBoard. Events are

- ``start`` and ``end`` of a process's work in the folder, with what it does and how it ended,
- ``queued``: the jobs that wait; ``running``, ``done``, ``stopped``, ``failed``: the state of a job
  (the only one of a single run is called ""), and the worker that runs it,
- ``record``: means over each member's episodes since the previous record, and the job's progress,
- ``result``: the measures of what has been trained, by name.

A job that restarts, from a checkpoint or on another worker, logs its step; readers drop the records
after that step, so that nothing counts twice. While a process works, it touches the file every
``BEAT`` seconds: if a log without an ``end`` is not touched for ``SILENT`` seconds, the process was
killed.
"""

import contextlib
from pathlib import Path
from typing import Any

import msgspec

EVENTS = "events.jsonl"

CONTRAST = "contrast"
"""The folder of a run's second training, with one setting changed, in the folder of the run."""

BEAT, SILENT = 2.0, 10.0

CHUNK = 2**21
"""Bytes of a log that are read at once, besides the rest of a line."""

Event = dict[str, Any]


def read(path: Path, offset: int = 0) -> tuple[list[Event], int]:
    """Reads the next events from a byte offset; also returns the offset from which to continue.

    An incomplete last line is left for a later call; damaged lines are skipped.
    """
    with path.open("rb") as file:
        file.seek(offset)
        content = file.read(CHUNK) + file.readline()
    whole = content[: content.rfind(b"\n") + 1]
    events = []
    for line in whole.split(b"\n"):
        with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            event = msgspec.json.decode(line)
            if isinstance(event, dict) and isinstance(event.get("event"), str):
                events.append(event)
    return events, offset + len(whole)
