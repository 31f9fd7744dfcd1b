"""Reads the signals that a text names."""

import re
from collections.abc import Sequence

from qfolio.core.errors import QfolioError
from qfolio.core.registry import SIGNALS, build
from qfolio.portfolio.prices.frequency import TRADING_DAYS
from qfolio.portfolio.signals.base import Column, Signal

COLUMN = "feature:"

LENGTHS = {"d": 1, "w": 5, "m": 21, "y": 252}
"""Rows in a day, a week, a month and a year of a daily table. A slower table has fewer, at least
one; in a faster one, whose prices move on another scale, they are the same numbers of rows."""


def parse(text: str, periods_per_year: float = TRADING_DAYS) -> list[Signal]:
    """The signals that a text names, on a table with some rows a year.

    Raises QfolioError if there is no such signal.
    """
    pace = min(1.0, periods_per_year / TRADING_DAYS)
    return [_named(part, pace) for part in labels(text)]


def names(text: str) -> list[str]:
    """The names in such a text, without rows and without columns of the table."""
    return [_split(part, 1.0)[0] for part in labels(text) if not part.startswith(COLUMN)]


def labels(text: str) -> list[str]:
    """The signals in such a text as they are written there, in order."""
    return [part.strip() for part in text.split(",") if part.strip()]


def lookback(signals: Sequence[Signal]) -> int:
    """Number of rows needed before the first one at which all signals are known."""
    return max((signal.rows for signal in signals), default=0)


def _split(text: str, pace: float) -> tuple[str, dict[str, str]]:
    """A signal's name, and its rows and skip if given; pace: rows for each row of a daily table."""
    match = re.fullmatch(r"(.+?)(?::(\d+[dwmy]?)(?:-(\d+[dwmy]?))?)?", text)
    assert match is not None  # anything is a name
    name, *given = match.groups()
    own, _, length = name.partition(":")
    if own in SIGNALS and length[:1].isdigit():  # no class of a module has such a name
        raise QfolioError(
            f"The signal {text} has no length that can be read; write a number of rows or of d, w, "
            f"m or y, such as {own}:21 or {own}:1m, and rows to skip as in {own}:1y-1m."
        )
    rows = [_rows(length, pace) for length in given if length is not None]
    if len(rows) == 2 and given[0][-1] in LENGTHS and pace < 1:
        rows[0] = max(rows[0], rows[1] + 1)  # 1m-1w would be 1-1 on a monthly table
    return name, dict(zip(("rows", "skip"), map(str, rows), strict=False))


def _rows(length: str, pace: float) -> int:
    """The rows of a length such as 21 or 1m."""
    if length[-1] not in LENGTHS:
        return int(length)
    daily = int(length[:-1]) * LENGTHS[length[-1]]
    return max(min(1, daily), round(pace * daily))


def _named(text: str, pace: float) -> Signal:
    if text.startswith(COLUMN):
        return Column(name=text.removeprefix(COLUMN))
    name, chosen = _split(text, pace)
    return build("signal", name, chosen)
