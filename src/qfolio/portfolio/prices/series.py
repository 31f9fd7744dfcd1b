"""A number for the whole market in a file of its own, such as the rate of treasury bills."""

from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.findings import Findings, day, listing
from qfolio.portfolio.prices.frequency import spacing
from qfolio.portfolio.prices.reading import read
from qfolio.portfolio.prices.records import date_column, dates_of, in_order, numbers_of

LATE, MISSED = 7.0, 3.0
"""How old the last number may be: a week, or three times the days that are usual between two."""


def series(source: Any, name: str, dates: np.ndarray, findings: Findings) -> np.ndarray:
    """The latest number known at each date, float64 of shape (rows,).

    A warning says so if the numbers end long before the last date.

    Args:
        source: A file or a data frame, with a column of dates and one of numbers. Of several, that
            called ``name`` is read. A number holds from its date until the next one.
        name: Name of the series.
        dates: Dates of the price table, ascending, of shape (rows,).
        findings: Where notes and warnings go.

    Raises:
        QfolioError: The source cannot be read, lacks the column, or begins after the prices.
    """
    table = read(source, lambda names: {date_column(names)})
    try:
        when = date_column(table.names)
        others = [j for j in range(len(table.names)) if j != when]
        column = next((j for j in others if len(others) == 1 or table.names[j] == name), None)
        if column is None:
            raise QfolioError(
                f"it has the columns {listing(table.names)}; keep dates and one of numbers, or "
                f"call a column {quote(name)}."
            )
        since = dates_of(table, when)
        values = numbers_of(table, column, since)
        order = in_order(since, table)
        latest = np.searchsorted(since[order], dates, side="right") - 1
        if latest[0] < 0:
            raise QfolioError(
                f"it begins on {day(since[order[0]])}, after the prices ({day(dates[0])}); give "
                "earlier rows."
            )
    except QfolioError as error:
        raise QfolioError(f"The column {quote(name)} from {quote(table.source)}: {error}") from None
    if table.left_out:
        findings.note(f"of {quote(table.source)}, {table.left_out}")
    known = since[order]
    age = (dates[-1] - known[-1]).astype("m8[s]").astype(np.int64) / 86400.0
    if len(known) > 1 and age > max(LATE, MISSED * spacing(known)[1]):
        findings.warn(
            f"{quote(name)} is still that of {day(known[-1])}, the last in {quote(table.source)}",
            date=day(dates[-1]),
            advice="Give the numbers since then, too.",
        )
    return np.asarray(values[order][latest])
