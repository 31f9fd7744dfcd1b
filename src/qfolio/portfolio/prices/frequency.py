"""The frequency of a table's rows."""

import numpy as np

TRADING_DAYS = 252.0  # a year
YEARLY = ((6, 8, 52.0), (27, 32, 12.0), (88, 93, 4.0), (360, 370, 1.0))
"""Days between rows, from and to, and the rows of a year: weeks, months, quarters, years."""


def spacing(dates: np.ndarray) -> tuple[np.ndarray, float]:
    """The days from each of two or more rows to the next, and their (lower) median."""
    steps = np.diff(dates).astype(np.int64) / 86400.0
    return steps, float(np.sort(steps)[(len(steps) - 1) // 2])


def every_day(dates: np.ndarray) -> bool:
    """True if weekends have rows, too."""
    weekday = (dates.astype("datetime64[D]").astype(np.int64) + 3) % 7  # 1970-01-01: Thursday
    return float((weekday >= 5).mean()) > 0.1 if len(dates) else False


def periods_per_year(dates: np.ndarray) -> float:
    """Rows per year: 252 for business days, 365 for all days, 52, 12, 4 or 1 for longer periods.

    For intraday rows it is the median number of bars per day times the days per year, and for any
    other spacing the mean number of rows per year.
    """
    if len(dates) < 2:
        return TRADING_DAYS
    steps, usual = spacing(dates)
    if usual <= 1.1:
        _, bars = np.unique(dates.astype("datetime64[D]"), return_counts=True)
        days = 365.0 if every_day(dates) else TRADING_DAYS
        return days * (float(np.median(bars)) if usual < 0.9 else 1.0)
    for low, high, periods in YEARLY:
        if low <= usual <= high:
            return periods
    return float(365.25 * len(steps) / steps.sum())
