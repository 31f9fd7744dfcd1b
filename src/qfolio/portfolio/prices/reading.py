"""Reads CSV and Parquet files and data frames as tables of named columns.

Nothing in a file is ever executed or unpickled.
"""

import csv
import io
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.cells import (
    MISSING,
    has_decimal_comma,
    has_decimal_point,
)
from qfolio.portfolio.prices.header import Header, name_columns, parse_header

TEXT_FILES = (".csv", ".tsv", ".txt", "")
PARQUET_FILES = (".parquet", ".pq")


@dataclass(frozen=True)
class Table:
    """Columns of equal length: float64, datetime64 or, where kinds are mixed, objects.

    names: one for each column; of a header on two levels, both with a space between.
    first_row: the number of the first row for users: 2 below a header of one line, 0 in a data
        frame.
    decimal: the decimal mark.
    levels: both levels of the header, by column, if there are two.
    """

    names: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    first_row: int
    source: str
    decimal: str = "."
    levels: dict[int, tuple[str, str]] = field(default_factory=dict)


def read(source: Any, texts: Callable[[tuple[str, ...]], set[int]]) -> Table:
    """A file or a data frame as a table.

    Args:
        source: Path of a CSV or Parquet file, or a data frame that narwhals knows.
        texts: Returns, from the column names of a text file, the columns that must stay text,
            because 0700, NA and TRUE may be names of assets.

    Raises:
        QfolioError: The source cannot be read as a table.
    """
    if not isinstance(source, str | Path):
        return _from_frame(source)
    path = Path(source)
    kind = path.suffix.lower()
    if kind not in TEXT_FILES + PARQUET_FILES:
        raise QfolioError(
            f"{quote(path, 300)} is not read: tables come as CSV (.csv, .tsv, .txt) or Parquet "
            "(.parquet); export it as CSV."
        )
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise QfolioError(f"{quote(path, 300)} cannot be read: {reason}.") from None
    if kind in PARQUET_FILES:
        return _from_parquet(content, path.name)
    return _from_text(content, path.name, texts)


# Data frames and Parquet.


def _from_frame(source: Any) -> Table:
    import narwhals as nw
    import pandas as pd

    if isinstance(source, pd.Series):
        source = source.to_frame()
    try:
        if isinstance(source, pd.DataFrame):  # pandas alone has an index and may repeat names
            return _from_pandas(source)
        frame = nw.from_native(source)
        frame = frame.collect() if isinstance(frame, nw.LazyFrame) else frame
        names, series = frame.columns, [frame[name] for name in frame.columns]
    except QfolioError:
        raise
    except TypeError:
        raise QfolioError(
            f"prices come as a path or as a data frame (pandas, polars, pyarrow, …), "
            f"not as {type(source).__name__}."
        ) from None
    except Exception as error:  # each library has exceptions of its own
        raise QfolioError(f"the data frame cannot be read: {quote(error, 200)}.") from None
    return _table(names, [_cells(column) for column in series], "data frame")


def _table(names: Iterable[Any], columns: Iterable[np.ndarray], source: str) -> Table:
    header = name_columns(names)
    return Table(header.names, tuple(columns), 0, source, levels=header.levels)


def _from_pandas(frame: Any) -> Table:
    import narwhals as nw
    import pandas as pd

    if frame.columns.nlevels > 2:
        raise QfolioError(
            f"the data frame has column names on {frame.columns.nlevels} levels; "
            "select one kind of price first, for example frame['Close']."
        )
    names = list(frame.columns)
    series = [frame.iloc[:, j] for j in range(len(names))]
    if not isinstance(frame.index, pd.RangeIndex):
        levels = range(frame.index.nlevels)
        names = [frame.index.names[i] for i in levels] + names
        series = [frame.index.get_level_values(i).to_series() for i in levels] + series
    columns = [_cells(nw.from_native(column, series_only=True)) for column in series]
    return _table(names, columns, "data frame")


def _cells(series: Any) -> np.ndarray:
    zoned = getattr(series.dtype, "time_zone", None) is not None
    array = series.to_numpy()
    if array.dtype.kind in "fiu":
        return np.asarray(array.astype(np.float64))
    if array.dtype.kind == "M" and not zoned:
        return np.asarray(array)
    return np.fromiter(series.to_list(), dtype=object, count=len(series))


def _from_parquet(content: bytes, name: str) -> Table:
    try:
        import pyarrow.parquet
    except ImportError:
        raise QfolioError(
            f'{quote(name)} is a Parquet file; to read it: pip install "qfolio[parquet]"'
        ) from None
    try:
        frame = pyarrow.parquet.ParquetFile(io.BytesIO(content)).read()
    except Exception as error:  # damaged files raise a dozen different kinds
        raise QfolioError(
            f"{quote(name)} is damaged or not a Parquet file ({quote(error, 100)})."
        ) from None
    names = frame.column_names
    if len(set(names)) < len(names):  # narwhals would not take them; the caller names them
        frame = frame.rename_columns([str(j) for j in range(len(names))])
    return _table(names, _from_frame(frame).columns, name)


# Text.


def _from_text(content: bytes, name: str, texts: Callable[[tuple[str, ...]], set[int]]) -> Table:
    try:
        wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise QfolioError(f"{quote(name)} is not UTF-8 text; save the table as CSV (UTF-8).")
    if not text.strip():
        raise QfolioError(f"{quote(name)} is empty.")
    lines = io.StringIO(text, newline="")
    separator = max(",;\t|", key=lambda mark: len(_records(lines, mark, 1)[0][0]))
    records, blank = _records(lines, separator, 4)
    header = parse_header(records)
    if len(header.names) < 2:
        raise QfolioError(
            f"{quote(name)} has only one column, {quote(header.names[0])}; a table needs several, "
            "separated by commas, semicolons or tabs."
        )
    plain = texts(header.names)
    # pandas assumes the first row's width for all rows, and would silently cut longer ones.
    width = max(len(record) for record in (header.names, *records[header.lines :][:1]))
    layout = _Layout(header, separator, blank + header.lines, width)
    table = _parse(text, name, layout, plain, ".")
    if _uses_decimal_commas(table, plain):
        table = _parse(text, name, layout, plain, ",")
    return table


class _Layout(NamedTuple):
    """The layout of a text file."""

    header: Header
    separator: str
    before: int  # records that come before the first row
    width: int  # cells of the widest row


def _records(lines: io.StringIO, separator: str, count: int) -> tuple[list[list[str]], int]:
    """Up to ``count`` records from the first that is not blank, and how many were blank before."""
    lines.seek(0)
    reader = csv.reader(lines, delimiter=separator)
    found: list[list[str]] = []
    blank = 0
    try:
        for record in reader:
            if not found and not any(field.strip() for field in record):
                blank += 1
                continue
            found.append(record)
            if len(found) == count:
                break
    except csv.Error:  # a field of more than 128 kB
        pass
    return found or [[""]], blank


def _ragged(source: str, row: int | str, fields: int | str, names: int | str) -> QfolioError:
    return QfolioError(
        f"{quote(source)}, row {row}: there are {fields} fields, but {names} column names; numbers "
        "with decimal commas must be in quotation marks, or the columns separated by semicolons."
    )


def _parse(text: str, source: str, layout: _Layout, plain: set[int], decimal: str) -> Table:
    import pandas as pd

    header, separator, before, width = layout
    count = len(header.names)
    texts = plain | set(range(count, width))
    spellings = sorted({f(word) for word in MISSING for f in (str, str.upper, str.title)} | {"NaN"})
    old = tuple(map(int, pd.__version__.split(".")[:2])) < (3, 1)  # newer ones are exact anyway
    exact = {"float_precision": "round_trip"} if old else {}
    try:
        frame = pd.read_csv(
            io.StringIO(text), sep=separator, header=None, names=list(range(width)),
            index_col=False, skiprows=before, skip_blank_lines=False, skipinitialspace=True,
            keep_default_na=False, dtype={j: str for j in texts}, decimal=decimal,
            na_values={j: spellings for j in range(width) if j not in texts},
            low_memory=False, **exact,
        )  # fmt: skip
    except (ValueError, OverflowError) as error:
        if fields := re.search(r"in line (\d+), saw (\d+)", str(error)):
            raise _ragged(source, fields[1], fields[2], count) from None
        raise QfolioError(f"{quote(source)} cannot be read as CSV: {quote(error, 100)}.") from None
    for j in range(width - 1, count - 1, -1):
        surplus = [isinstance(cell, str) and bool(cell.strip()) for cell in frame[j].tolist()]
        if any(surplus):
            raise _ragged(source, before + 1 + surplus.index(True), j + 1, count)
    columns = []
    for j in range(count):
        column = frame[j]
        numeric = isinstance(column.dtype, np.dtype) and column.dtype.kind in "fiu"
        columns.append(column.to_numpy(np.float64 if numeric else object))
    return Table(header.names, tuple(columns), before + 1, source, decimal, header.levels)


def _uses_decimal_commas(table: Table, plain: set[int]) -> bool:
    """True if cells such as 12,5 outnumber numbers with a decimal point."""
    commas = points = 0
    for j, cells in enumerate(table.columns):
        if j in plain:
            continue
        if cells.dtype.kind == "f":
            finite = cells[np.isfinite(cells)]
            points += int((finite != np.rint(finite)).sum())
            continue
        for cell in cells.tolist():
            if isinstance(cell, str):
                commas += has_decimal_comma(cell)
                points += has_decimal_point(cell)
    return commas > points
