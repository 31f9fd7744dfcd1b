"""Dates and numbers of a small table beside the prices, such as weights, returns or a rate.

Each function raises a QfolioError that names the row.
"""

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.cells import not_a_number, numbers
from qfolio.portfolio.prices.dates import read_dates
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.vocabulary import DATE_NAMES, plain


def date_column(names: tuple[str, ...]) -> int:
    """The column of dates: one called date, else the first.

    If the first has no name, such as row numbers, it is one that is called like a time.
    """
    known = [plain(name) for name in names]
    names_of_dates = DATE_NAMES if names and not known[0] else DATE_NAMES[:3]
    return next((known.index(name) for name in names_of_dates if name in known), 0)


def dates_of(table: Table, column: int) -> np.ndarray:
    """The dates of a column, none of which may be missing."""
    moments, complaints, _ = read_dates(table.columns[column])
    for row, complaint in complaints.items():
        raise QfolioError(f"row {table.first_row + row}: {complaint}; write dates as 2020-01-31.")
    if not len(moments):
        raise QfolioError("the table has no rows.")
    return moments


def numbers_of(
    table: Table, column: int, rows: np.ndarray, blank: np.ndarray | None = None
) -> np.ndarray:
    """The numbers of a column; none may be missing, except where a whole row is blank."""
    cells = table.columns[column]
    values, wrong = numbers(cells, table.decimal)
    missing = np.isnan(values) & ~wrong
    bad = wrong | (missing if blank is None else missing & ~blank)
    if bad.any():
        row = int(bad.argmax())
        reason = not_a_number(cells[row], table.decimal) if wrong[row] else "it is missing"
        raise QfolioError(
            f"row {table.first_row + row} ({day(rows[row])}), column {quote(table.names[column])}: "
            f"{reason}; give a number, 0 for nothing."
        )
    return values


def in_order(rows: np.ndarray, table: Table) -> np.ndarray:
    """The order of rows by date; raises QfolioError if a date appears twice."""
    order = np.argsort(rows, kind="stable")
    again = np.flatnonzero(rows[order][1:] == rows[order][:-1])
    if again.size:
        row = int(order[again[0] + 1])
        raise QfolioError(
            f"row {table.first_row + row}: {day(rows[row])} appears twice; keep one row per date."
        )
    return order
