"""Work that lasts longer than its training: its grades come before the end of its log."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from qfolio.experiments.log import Log


class Lasting(contextlib.ExitStack):
    """Logs that stay open, by folder."""

    def __init__(self) -> None:
        super().__init__()
        self.logs: dict[Path, Log] = {}


_now: ContextVar[Lasting | None] = ContextVar("lasting", default=None)


@contextlib.contextmanager
def lasting() -> Iterator[None]:
    """Keeps logs of folders that are opened in this block open until the block ends.

    So trackers hear of the grades, and an error while grading is one of the work.
    """
    with Lasting() as logs:
        token = _now.set(logs)
        try:
            yield
        finally:
            _now.reset(token)


def current() -> Lasting | None:
    """The logs of the innermost block around this call."""
    return _now.get()
