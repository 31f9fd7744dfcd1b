"""Findings: errors, warnings and notes on a price table, with advice."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from qfolio.core.text import amount, quote

LISTED = 5  # findings of one kind that are listed (errors: the first); the others are counted

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One finding on a table, or ``count`` of a kind.

    An error stops the table from being read, a warning reports something implausible, and a note
    says how the table was read. Rows are counted as users see them: in text files from 1, header
    included, as in spreadsheets and editors; in data frames and Parquet files from 0.

    cells: row, column and date of each of them, if a finding stands for several cells.
    """

    severity: Severity
    message: str
    row: int | None = None
    column: str | None = None
    date: str | None = None
    advice: str = ""
    count: int = 1
    cells: tuple[dict[str, Any], ...] = ()

    def without_rows(self) -> "Finding":
        """The same, for a table that was joined, whose rows are not those of any file."""
        cells = tuple({**cell, "row": None} for cell in self.cells)
        return replace(self, row=None, cells=cells)

    def __str__(self) -> str:
        """Location and message, on one line."""
        row = None if self.row is None else f"row {self.row}"
        date = f"({self.date})" if row and self.date else self.date
        spot = " ".join(part for part in (row, date) if part)
        column = "" if self.column is None else f"column {quote(self.column)}"
        where = ", ".join(part for part in (spot, column) if part)
        return f"{where}: {self.message}" if where else self.message


class Findings(list[Finding]):
    """All findings on a table, in the order in which they were made."""

    def error(self, message: str, **rest: Any) -> None:
        self.append(Finding("error", message, **rest))

    def warn(self, message: str, **rest: Any) -> None:
        self.append(Finding("warning", message, **rest))

    def note(self, message: str, **rest: Any) -> None:
        self.append(Finding("note", message, **rest))

    def rows(
        self, said: Mapping[int, str], spot: Callable[[int], dict[str, Any]], advice: str
    ) -> None:
        """An error for each row in ``said``; ``spot`` tells where it is."""
        for line in list(said)[:LISTED]:
            self.error(said[line], **spot(line), advice=advice)
        if said:
            column = spot(next(iter(said)))["column"]
            self.others("error", len(said), "row", " of this kind", column=column, advice=advice)

    def older(self, cells: Sequence[dict[str, Any]], noun: str, kind: str) -> None:
        """A warning that counts all but the latest of such cells, which are listed.

        It has the date of the latest one that it counts: whoever looks at later rows than a date
        learns of all findings on them.
        """
        if (more := len(cells) - LISTED) > 0:
            date, said = cells[more - 1]["date"], f" {kind}, the latest on this date"
            self.others("warning", len(cells), noun, said, date=date, cells=tuple(cells[:more]))

    def others(self, severity: Severity, total: int, noun: str, said: str, **rest: Any) -> None:
        """Counts the findings of a kind that are not listed; total: of all of its findings."""
        if (more := total - LISTED) > 0:
            message = f"and {amount(more, f'more {noun}')}{said}"
            self.append(Finding(severity, message, count=more, **rest))

    @property
    def bad(self) -> bool:
        """True if there is an error."""
        return any(finding.severity == "error" for finding in self)


def day(moment: Any) -> str:
    """A date, with its time unless that is midnight."""
    text = str(np.datetime64(moment, "s"))
    return text.removesuffix("T00:00:00").replace("T", " ")


def first_of(texts: Iterable[str], few: int = LISTED) -> str:
    """The first few, and how many more there are."""
    every = list(texts)
    rest = len(every) - few
    return ", ".join(every[:few]) + (f" and {rest:,} more" if rest > 0 else "")


def listing(names: Iterable[str]) -> str:
    """The first few names in quotation marks, and how many more there are."""
    return first_of(map(quote, names))
