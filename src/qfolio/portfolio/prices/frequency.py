"""The frequency of a table's rows."""

import numpy as np

from qfolio.core.errors import QfolioError

SEVERAL = 10
"""Rows from which on a table shows its frequency."""

TRADING_DAYS = 252.0  # a year
INTRADAY = 366.0  # rows a year beyond which there are several a day
YEARLY = ((6, 8, 52.0), (27, 32, 12.0), (88, 93, 4.0), (360, 370, 1.0))
"""Days between rows, from and to, and the rows of a year: weeks, months, quarters, years."""


def spacing(dates: np.ndarray) -> tuple[np.ndarray, float]:
    """The days from each of two or more rows to the next, and their (lower) median."""
    steps = np.diff(dates).astype(np.int64) / 86400.0
    return steps, float(np.sort(steps)[(len(steps) - 1) // 2])


def one_a_day(dates: np.ndarray) -> bool:
    """Whether no two rows are of the same day."""
    days = dates.astype("datetime64[D]")
    return bool((days[1:] > days[:-1]).all())


def days_a_week(dates: np.ndarray) -> int:
    """On how many days of the week a market is open: 5, 6 or 7.

    It is 5 without rows on weekends, but also from Sunday to Thursday; it was 6 in New York, which
    traded on Saturdays until 1952.
    """
    if not len(dates):
        return 5
    weekday = (dates.astype("datetime64[D]").astype(np.int64) + 3) % 7  # 1970-01-01: Thursday
    shares = np.bincount(weekday, minlength=7) / len(dates)
    if shares[5:].sum() <= 0.1:
        return 5
    return max(5, int((shares > 0.05).sum()))


def every_day(dates: np.ndarray) -> bool:
    """True if there are rows on all days of the week."""
    return days_a_week(dates) == 7


def periods_per_year(dates: np.ndarray) -> float:
    """Rows per year: 252 for five days a week, 365 for seven, 52, 12, 4 or 1 for longer periods.

    For six days a week it is the table's mean number of days per year. For intraday rows it is the
    median number of bars per day times the days per year, and for any other spacing the mean number
    of rows per year.
    """
    if len(dates) < 2:
        return TRADING_DAYS
    _, usual = spacing(dates)
    if usual <= 1.1:
        open_on, bars = np.unique(dates.astype("datetime64[D]"), return_counts=True)
        days = {5: TRADING_DAYS, 7: 365.0}.get(days_a_week(dates)) or round(_a_year(open_on))
        return days * (float(np.median(bars)) if usual < 0.9 else 1.0)
    for low, high, periods in YEARLY:
        if low <= usual <= high:
            return periods
    return _a_year(dates)


def dated(rows: np.ndarray, per_year: float) -> np.ndarray:
    """Made-up dates for numbered rows, of which ``periods_per_year`` finds about so many a year."""
    if per_year == TRADING_DAYS:
        weeks, day = np.divmod(rows, 5)
        return (7 * weeks + day + 4).astype("datetime64[D]").astype("datetime64[s]")  # a Monday
    if per_year in (12.0, 4.0, 1.0):
        return rows.astype(f"datetime64[{round(12 / per_year)}M]").astype("datetime64[s]")
    days = 7 if per_year == 52.0 else 365 / per_year
    return (rows * round(86400 * days)).astype("datetime64[s]")


def alike(one: float, other: float) -> bool:
    """Whether two numbers of rows a year are of one frequency.

    All intraday bars are: a table that holds parts of days does not tell how many a day has.
    """
    if max(one, other) > INTRADAY:
        return min(one, other) > INTRADAY
    return max(one, other) <= 2 * min(one, other)


def require_alike(dates: np.ndarray, usual: float, known: str) -> None:
    """Raises QfolioError if a table's rows are of another frequency than usual, if it shows one.

    usual: rows a year; 0 if unknown. known: what is known to have them, for the message.
    """
    found = periods_per_year(dates)
    if usual and len(dates) >= SEVERAL and not alike(usual, found):
        raise QfolioError(
            f"The price table has about {found:.0f} rows a year, and {known} {usual:.0f}; give "
            "prices of the same frequency."
        )


def _a_year(dates: np.ndarray) -> float:
    """The mean number of dates per year."""
    steps, _ = spacing(dates.astype("datetime64[s]"))
    return float(365.25 * len(steps) / steps.sum())
