"""Calendars: at which rows an account may trade, and how far it drifts before it does."""

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError

PERIODS = {
    "daily": "day",
    "weekly": "week",
    "monthly": "month",
    "quarterly": "quarter",
    "yearly": "year",
}
"""Calendars that are named after their periods, and the periods."""

DRIFT = "drift:"
"""Prefix of a calendar that trades only when a weight has drifted beyond a band: drift:0.05."""


def decision_rows(calendar: str, dates: NDArray[np.datetime64]) -> Bools:
    """Whether a decision is due at each row, of shape (row,).

    Args:
        calendar: "daily", "weekly", "monthly", "quarterly" or "yearly" for the first row of each
            period, which is known without later rows; a number k for every k-th row; "" or
            "drift:BAND" for every row.
        dates: Dates of the rows; days begin at midnight of their clock.

    Raises:
        QfolioError: There is no such calendar.
    """
    rows = np.arange(len(dates))
    if not calendar or band(calendar):
        return rows >= 0
    if calendar in PERIODS:
        days = dates.astype("datetime64[D]").astype(int)
        months = dates.astype("datetime64[M]").astype(int)
        weeks = (days + 3) // 7  # 1970-01-01 was a Thursday; weeks begin on Monday
        numbers = days, weeks, months, months // 3, months // 12
        period = dict(zip(PERIODS, numbers, strict=True))[calendar]
        return np.diff(period, prepend=period[:1] - 1) > 0
    if calendar.isdecimal() and len(calendar) <= 9 and int(calendar) > 0:
        return rows % int(calendar) == 0
    raise QfolioError(
        f"calendar is {calendar!r}; it must be {', '.join(PERIODS)}, a number of rows, or "
        f"{DRIFT} and a band between 0 and 1, such as {DRIFT}0.05; leave it out to trade at every "
        "row."
    )


def elapsed(dates: NDArray[np.datetime64]) -> Floats:
    """The share of its calendar year that has passed at each row, of shape (row,)."""
    begin = dates.astype("datetime64[Y]")
    end = begin + np.timedelta64(1, "Y")
    length = end.astype("datetime64[D]") - begin.astype("datetime64[D]")
    return np.asarray((dates - begin) / length)


def calendar_years(dates: NDArray[np.datetime64]) -> Floats:
    """Years since the first row's calendar year began, of shape (row,).

    The whole part is another one in each calendar year, in single precision, too: the last hour of
    a year is not rounded up into the next.
    """
    years = dates.astype("datetime64[Y]").astype(int)
    return np.asarray(years - years[0] + np.minimum(elapsed(dates), 0.9999))


def band(calendar: str) -> float:
    """How far some weight, cash included, must be from its target before there is an order.

    0 for calendars without a band, for which any difference is ordered.
    """
    try:
        found = float(calendar.removeprefix(DRIFT)) if calendar.startswith(DRIFT) else 0.0
    except ValueError:
        return 0.0
    return found if 0 < found < 1 else 0.0
