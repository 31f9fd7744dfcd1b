"""What is wrong with a price table: sentences with their row, column and advice."""

import difflib
from dataclasses import dataclass
from typing import Any

import numpy as np

from qfolio.portfolio.prices.reading import Table, quote

LISTED = 5  # faults of one kind that are named one by one; the rest is counted


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a table, or ``count`` of a kind.

    ``row`` is counted as people see it: in text files from 1, the header included, as spreadsheets
    and editors do; in data frames and Parquet files from 0.
    """

    severity: str  # "error" or "warning"
    message: str
    row: int | None = None
    column: str | None = None
    date: str | None = None
    advice: str = ""
    count: int = 1

    def __str__(self) -> str:
        """Where and what, on one line."""
        row = None if self.row is None else f"row {self.row}"
        date = f"({self.date})" if row and self.date else self.date
        spot = " ".join(part for part in (row, date) if part)
        column = "" if self.column is None else f"column {quote(self.column)}"
        where = ", ".join(part for part in (spot, column) if part)
        return f"{where}: {self.message}" if where else self.message


# The way from cells to prices.


@dataclass(frozen=True)
class Block:
    """One kind of number, prices or a feature, by date and asset (or by date alone)."""

    values: np.ndarray  # (rows, assets or 1), NaN where missing or wrong
    wrong: np.ndarray  # where something stands that is no number
    columns: tuple[int, ...]  # the table's column that each column here comes from
    name: str  # "price", or "feature"


@dataclass(frozen=True)
class Grid:
    """The table's cells by date and asset, before anything is dropped or filled."""

    table: Table
    long: bool
    dates: np.ndarray  # (rows,)
    assets: tuple[str, ...]
    lines: np.ndarray  # (rows, assets): the row of the table; -1 where a long table has none
    prices: Block
    features: tuple[Block, ...]

    def spot(self, block: Block, i: int, j: int) -> dict[str, Any]:
        """Where a cell stands, for a finding."""
        line = int(self.lines[i, j])
        return {
            "row": self.table.first_row + line if line >= 0 else None,
            "column": self.table.names[block.columns[j]],
            "date": None if np.isnat(self.dates[i]) else day(self.dates[i]),
        }

    def subject(self, block: Block, j: int) -> str:
        return f"the {block.name}" + (f" of {quote(self.assets[j])}" if self.long else "")


class Findings(list[Finding]):
    def error(self, message: str, **rest: Any) -> None:
        self.append(Finding("error", message, **rest))

    def warn(self, message: str, **rest: Any) -> None:
        self.append(Finding("warning", message, **rest))

    def cells(self, grid: Grid, block: Block, mask: np.ndarray, what: Any, advice: str) -> None:
        """An error for each cell of the mask; ``what`` is a text or a function of (i, j)."""
        spots = np.argwhere(mask)
        for i, j in spots[:LISTED].tolist():
            said = f": {what(i, j)}" if callable(what) else f" {what}"
            self.error(grid.subject(block, j) + said, **grid.spot(block, i, j), advice=advice)
        if (rest := len(spots) - LISTED) > 0:
            kind = "is no number" if callable(what) else what
            more = amount(rest, f"more {block.name}")
            self.error(f"and {more}: the {block.name} {kind}", advice=advice, count=rest)

    def rows(self, table: Table, column: str, said: dict[int, str], advice: str) -> None:
        """An error for each row of the table in ``said``."""
        for line in list(said)[:LISTED]:
            row = table.first_row + line
            self.error(said[line], row=row, column=column, advice=advice)
        if (rest := len(said) - LISTED) > 0:
            self.error(
                f"and {amount(rest, 'more row')} of this kind",
                column=column,
                advice=advice,
                count=rest,
            )

    @property
    def bad(self) -> bool:
        return any(finding.severity == "error" for finding in self)


def day(moment: Any) -> str:
    text = str(np.datetime64(moment, "s"))
    return text.removesuffix("T00:00:00").replace("T", " ")


def amount(count: int, noun: str) -> str:
    """1 row, 2 rows."""
    return f"{count:,} {noun}" + "s" * (count != 1)


def hint(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, [k for k in known if k], n=1)
    return f"; did you mean {quote(close[0])}?" if close else ""
