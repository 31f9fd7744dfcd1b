"""Walk-forward folds: train on a window, test on the rows after it, move on."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from qfolio.core.errors import QfolioError, TooFewRowsError
from qfolio.core.text import amount
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.frequency import one_a_day
from qfolio.portfolio.prices.table import Prices


class Fold(NamedTuple):
    """The training window of a policy, and the rows at which it then decides."""

    name: str  # date of its first return, with the time if rows are intraday
    train: slice
    decisions: slice
    recent: slice  # the final ``train``-length window

    @property
    def days(self) -> int:
        """Number of its decisions."""
        return int(self.decisions.stop - self.decisions.start)

    def tradable(self, values: np.ndarray) -> np.ndarray:
        """Assets with a price in every row of the recent window, shape (asset,)."""
        return ~np.isnan(values[self.recent]).any(0)

    def complete(self, values: np.ndarray) -> "Fold":
        """The fold, with a training window in which all of its tradable assets have prices."""
        gaps = np.isnan(values[self.train][:, self.tradable(values)]).any(1)
        begin = self.train.start + int(gaps.sum())  # prices are missing only before a first one
        return self._replace(train=slice(begin, self.train.stop))


def tested(folds: Sequence[Fold]) -> slice:
    """The rows at which folds that follow one another decide."""
    return slice(folds[0].decisions.start, folds[-1].decisions.stop)


def days_of(folds: Sequence[Fold]) -> list[slice]:
    """The days on which each fold decides, counted from the first decision of all."""
    first = folds[0].decisions.start
    return [slice(fold.decisions.start - first, fold.decisions.stop - first) for fold in folds]


def walk_forward(
    dates: np.ndarray, train: str, test: str, lag: int, expanding: bool = False
) -> list[Fold]:
    """Consecutive folds, without gaps between their returns.

    Training ends at the row of the first decision. A decision at row t earns the return to row
    t + lag + 1, so the last lag + 1 decisions are purged, and training earns no later reward.
    Windows of observations lie within the training window. The first fold trains on the first rows
    of the table; with ``expanding``, later folds keep that start.

    Args:
        dates: Shape (row,), ascending.
        train, test: Lengths such as "5y", "6m", "8w" or "500d"; d counts rows.
        lag: Rows between a decision and its execution.
        expanding: Training windows keep the first row of the table (default: they roll).

    Raises:
        QfolioError: A length cannot be read, or the table is too short for one fold.
    """
    folds: list[Fold] = []
    # Row of the first return of the first fold.
    start = _after(dates, 0, train)
    while start < len(dates):
        end = min(_after(dates, start, test), len(dates))  # the row after its last return
        first = start - lag - 1
        recent = _before(dates, first, train) if folds else 0
        begin = 0 if expanding else recent
        if first - begin < 1:
            raise TooFewRowsError(
                f"train={train} leaves fewer than two rows up to the first decision with a lag of "
                f"{lag}; make it longer."
            )
        decisions = slice(first, end - lag - 1)
        name = spell(dates[start], dates).replace(" ", "-").replace(":", "")  # of a folder
        folds.append(Fold(name, slice(begin, first + 1), decisions, slice(recent, first + 1)))
        start = end
    if not folds:
        raise TooFewRowsError(
            f"{len(dates)} rows, {day(dates[0])} to {day(dates[-1])}, leave nothing to "
            f"test after train={train}; shorten it (--train), or give more rows."
        )
    return folds


def fewest(folds: Sequence[Fold], prices: Prices) -> int:
    """The smallest number of rows that agents learn from in a fold."""
    if prices.tradable is None:
        folds = [fold.complete(prices.values) for fold in folds]
    return min(fold.train.stop - fold.train.start for fold in folds)


def require_fold(dates: np.ndarray, train: str, test: str, lag: int) -> None:
    """Raises QfolioError unless a table has rows for training and one whole fold.

    The last row may be a holiday, a weekend or one period early.
    """
    start = walk_forward(dates, train, test, lag)[0].decisions.start + lag + 1
    count, unit = parse_length(test)
    if unit == "d":
        whole = start + count <= len(dates)
    else:
        counted = _counted(dates, unit)
        gap, week = np.median(np.diff(counted)), np.timedelta64(7, "D")
        # Months are not equally long.
        grace = gap + np.timedelta64(3, "D") if gap > week else week
        whole = counted[-1] + grace >= _shift(counted[start], count, unit)
    if not whole:
        raise TooFewRowsError(
            f"{len(dates)} rows, {day(dates[0])} to {day(dates[-1])}, are fewer than "
            f"train={train} and one fold of test={test}; shorten them, or give more rows."
        )


def require_tested(dates: np.ndarray, train: str, least: int) -> None:
    """Raises QfolioError if fewer than some number of rows follow those for training."""
    count = len(dates) - _after(dates, 0, train)
    if count < least:
        raise TooFewRowsError(
            f"{len(dates)} rows, {day(dates[0])} to {day(dates[-1])}, leave {amount(count, 'row')} "
            f"to test after train={train}, fewer than {least}; shorten it (--train), or give more "
            "rows."
        )


def latest(name: str, dates: np.ndarray, train: str, expanding: bool = False) -> Fold:
    """The training window of tomorrow's policy: the last ``train`` of the table, or all of it."""
    end = len(dates)
    recent = _before(dates, end - 1, train)
    begin = 0 if expanding else recent
    return Fold(name, slice(begin, end), slice(end, end), slice(recent, end))


def overdue(learned: np.datetime64, test: str, dates: np.ndarray) -> bool:
    """Whether a table has rows for a whole test, or longer, after the last row learned."""
    row = max(int(np.searchsorted(dates, learned, side="right")) - 1, 0)
    return _after(dates, row, test) < len(dates)


def spell(date: np.datetime64, dates: np.ndarray) -> str:
    """A date as text, with the time if rows are less than a day apart."""
    return spell_all(np.array([date]), dates)[0]


def spell_all(some: np.ndarray, dates: np.ndarray) -> list[str]:
    """Some dates of a table as text, with times if rows are less than a day apart."""
    if one_a_day(dates):
        return list(map(str, some.astype("datetime64[D]")))
    texts = map(str, some.astype("datetime64[s]"))
    return [text.replace("T", " ") for text in texts]


def parse_length(text: str) -> tuple[int, str]:
    """Number and unit (y, m, w or d) of a length such as "5y"; raises QfolioError for others."""
    known = isinstance(text, str)  # a call from Python may give a number
    match = re.fullmatch(r"\s*([0-9]{1,9})\s*([ymwd])\s*", text) if known else None
    if match is None or int(match[1]) == 0:
        raise QfolioError(f"A length is {text!r}; it must be like 5y, 6m, 8w or 500d (rows).")
    return int(match[1]), match[2]


def _after(dates: np.ndarray, row: int, length: str) -> int:
    """The first row that is ``length`` or more after ``row``; len(dates) if there is none."""
    count, unit = parse_length(length)
    if unit == "d":
        return min(row + count, len(dates))
    dates = _counted(dates, unit)
    return int(np.searchsorted(dates, _shift(dates[row], count, unit)))


def _before(dates: np.ndarray, row: int, length: str) -> int:
    """The first row that is at most ``length`` before ``row``."""
    count, unit = parse_length(length)
    if unit == "d":
        return max(row - count, 0)
    dates = _counted(dates, unit)
    return int(np.searchsorted(dates, _shift(dates[row], -count, unit)))


def _counted(dates: np.ndarray, unit: str) -> np.ndarray:
    """Dates from which lengths are counted: the months, if each has at most one row.

    So a year has twelve rows of months that are dated by their last day of trading.
    """
    months = dates.astype("datetime64[M]")
    monthly = unit in "ym" and bool((months[1:] > months[:-1]).all())
    return months.astype(dates.dtype) if monthly else dates


def _shift(date: np.datetime64, count: int, unit: str) -> np.datetime64:
    """A calendar date some months or weeks away; clipped to the end of its month."""
    day = date.astype("datetime64[D]")
    if unit == "w":
        return day + np.timedelta64(7 * count, "D")
    month = day.astype("datetime64[M]") + np.timedelta64(count * (12 if unit == "y" else 1), "M")
    last = (month + np.timedelta64(1, "M")).astype("datetime64[D]") - np.timedelta64(1, "D")
    return min(month.astype("datetime64[D]") + (day - day.astype("datetime64[M]")), last)
