"""A table as it is read, and the turning of tables with their dates across the first row."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.cells import label
from qfolio.portfolio.prices.dates import readable_date

FEWEST_DATES = 3  # across the first row


@dataclass(frozen=True)
class Table:
    """Columns of equal length: float64, datetime64 or, where kinds are mixed, objects.

    names: one for each column; the two levels of a header are joined by a space.
    first_row: the number of the first row for users: 2 below a header of one line, 0 in a data
        frame.
    decimal: the decimal mark.
    levels: both levels of the header, by column, if there are two.
    turned: whether rows and columns were exchanged; users still see the file or frame as it is.
    left_out: what of the file is not in the table, for a note.
    """

    names: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    first_row: int
    source: str
    decimal: str = "."
    levels: dict[int, tuple[str, str]] = field(default_factory=dict)
    turned: bool = False
    left_out: str = ""

    def spot(self, line: int, j: int) -> dict[str, Any]:
        """Row and column of a cell as users see them."""
        if self.turned:
            return {"row": self.first_row + j - 1 if j else None, "column": self.columns[0][line]}
        return {"row": self.first_row + line, "column": self.names[j]}


def upright(table: Table) -> Table:
    """The table with a row per date, if its dates stand across the first row.

    Raises:
        QfolioError: There is more than one column besides the dates.
    """
    names = table.names[1:]
    if len(names) < FEWEST_DATES or not readable_date(names[-1]) or readable_date(table.names[0]):
        return table
    if others := [name for name in names if not readable_date(name)]:
        raise QfolioError(
            f"{quote(table.source)} has dates across its first row, but also the column "
            f"{quote(others[0])}; keep one column of assets and those of the dates."
        )
    columns = table.columns[1:]
    kind = np.float64 if all(column.dtype.kind == "f" for column in columns) else object
    cells = np.empty((len(table.columns[0]), len(columns)), dtype=kind)
    for j, column in enumerate(columns):
        cells[:, j] = column
    days = np.array(names, dtype=object)
    assets = tuple(label(cell) for cell in table.columns[0].tolist())
    return Table(
        ("date", *assets), (days, *cells), table.first_row, table.source, table.decimal,
        turned=True,
    )  # fmt: skip
