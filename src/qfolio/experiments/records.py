"""The records of training episodes: a table that is stored by column and read by row."""

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from qfolio.core.errors import QfolioError
from qfolio.core.files import csv_lines

Row = dict[str, float]
"""Numbers by name; those of a training episode are seed, episode (counted from 1), return and the
agent's metrics."""


class Records(Sequence[Row]):
    """Rows with the same names, stored by column: millions of episodes take eight bytes a number.

    columns: arrays of equal length by name.
    """

    def __init__(self, columns: Mapping[str, NDArray] | None = None) -> None:
        self.columns = dict(columns or {})

    @staticmethod
    def of(rows: Iterable[Row]) -> "Records":
        """The records with these rows, of which all have the names of the first."""
        rows = list(rows)
        names = rows[0] if rows else ()
        return Records({name: np.array([row[name] for row in rows]) for name in names})

    @staticmethod
    def read(path: Path, *, cut: bool = False) -> "Records":
        """The records in a file that holds what ``csv`` wrote; none if there is no file.

        cut: whether rows may be damaged, as the last one is after a crash; they are skipped. Raises
        QfolioError if the file is damaged otherwise.
        """
        if not path.exists():
            return Records()
        try:
            return Records._parsed(path.read_text("utf-8", errors="replace").splitlines(), cut)
        except (csv.Error, ValueError) as error:
            raise QfolioError(f"{path} is damaged ({error}); restore or delete it.") from None

    @staticmethod
    def _parsed(lines: Sequence[str], cut: bool) -> "Records":
        names, *_ = [*csv.reader(lines[:2]), []]
        rows = [row for row in lines[1:] if not cut or _is_whole(row, len(names))]
        if not rows:
            return Records()
        columns = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2).T
        counts = lambda x: (abs(x) < 2**53).all() and (x % 1 == 0).all()  # noqa: E731
        return Records(
            {
                name: column.astype(int) if cell.isdecimal() and counts(column) else column
                for name, cell, column in zip(names, rows[0].split(","), columns, strict=True)
            }
        )

    @staticmethod
    def joined(parts: Iterable["Records"]) -> "Records":
        """The rows of all parts, one after another."""
        parts = [part for part in parts if part]
        if len(parts) < 2:
            return parts[0] if parts else Records()
        columns = [part.columns for part in parts]
        return Records({n: np.concatenate([each[n] for each in columns]) for n in columns[0]})

    def csv(self, header: bool) -> bytes:
        """The rows as CSV, with a header if asked for."""
        names = csv_lines([self.columns]) if header else b""
        columns = (column.tolist() for column in self.columns.values())
        return names + csv_lines(zip(*columns, strict=True))

    def column(self, name: str) -> NDArray:
        """The numbers of all rows that have a name."""
        return self.columns[name] if self else np.empty(0)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    @overload
    def __getitem__(self, place: int) -> Row: ...

    @overload
    def __getitem__(self, place: slice | NDArray) -> "Records": ...

    def __getitem__(self, place: int | slice | NDArray) -> "Row | Records":
        """The row at a place; or the records of a slice, of a mask, or at several places."""
        found = {name: column[place] for name, column in self.columns.items()}
        if isinstance(place, int):
            return {name: value.item() for name, value in found.items()}
        return Records(found)

    def __iter__(self) -> Iterator[Row]:
        columns = (column.tolist() for column in self.columns.values())
        return (dict(zip(self.columns, row, strict=True)) for row in zip(*columns, strict=True))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)


def _is_whole(row: str, count: int) -> bool:
    """Whether a row holds so many numbers."""
    try:
        return len([float(cell) for cell in row.split(",")]) == count
    except ValueError:
        return False
