"""Reads text files of separated values, whatever separates them and marks their decimals."""

import csv
import io
import itertools
import re
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.cells import MISSING, has_decimal, has_numbers
from qfolio.portfolio.prices.dates import begins_row
from qfolio.portfolio.prices.header import Header, parse_header
from qfolio.portfolio.prices.layout import Table

SEPARATORS = ",;\t|"
LOOKED_AT = 30  # records in which the header is looked for

_DECLARED = re.compile(r'\s*"?sep=([,;\t|])"?[,;\t| ]*\r?\n', re.I)
_BEFORE, _AFTER = r'[;\t|] *"?[-+]?', r' *"? *(?=[;\t|\r\n]|$)'
_POINT = re.compile(
    rf"{_BEFORE}(?:\d*\.(?:\d{{1,2}}|\d{{4,}})|(?:0\d*|\d{{4,}})?\.\d+){_AFTER}", re.A
)
_TWO_READINGS = re.compile(rf"{_BEFORE}([1-9]\d{{0,2}}\.\d{{3}}){_AFTER}", re.A)


def from_text(content: bytes, name: str, texts: Callable[[tuple[str, ...]], set[int]]) -> Table:
    """The table in the bytes of a file of this name; texts: see ``reading.read``.

    Raises:
        QfolioError: The file is not text, or its rows and columns cannot be made out.
    """
    try:
        wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise QfolioError(f"{quote(name)} is not UTF-8 text; save the table as CSV (UTF-8).")
    if not text.strip():
        raise QfolioError(f"{quote(name)} is empty; a table has a header and rows below it.")
    separator = ""
    if declared := _DECLARED.match(text):  # by Excel, in a line of its own
        separator, text = declared[1], "\n" + text[declared.end() :]
    lines = io.StringIO(text, newline="")
    opened = {mark: _records(lines, mark, LOOKED_AT) for mark in separator or SEPARATORS}
    headers = {mark: parse_header(records) for mark, (records, _) in opened.items()}
    widest = max(opened, key=lambda mark: len(opened[mark][0][0]))
    separator = next((mark for mark, header in headers.items() if header.below_text), widest)
    (records, blank), header = opened[separator], headers[separator]
    if len(header.names) < 2:
        above = any(len(record) > 1 for found, _ in opened.values() for record in found[:9])
        advice = (
            "remove the lines above the names of the columns."
            if above
            else "a table needs several, separated by commas, semicolons or tabs."
        )
        raise QfolioError(f"{quote(name)} has only one column, {quote(header.names[0])}; {advice}")
    # pandas assumes the first row's width for all rows, and would silently cut longer ones.
    width = max(len(record) for record in (header.names, *records[header.lines :][:1]))
    layout = _Layout(header, separator, blank + header.lines, width)
    if not header.below_text:
        return _with_decimals(text, name, layout, texts(header.names))
    text, left_out = _first_table(text, layout)
    return replace(_with_decimals(text, name, layout, texts(header.names)), left_out=left_out)


def _with_decimals(text: str, name: str, layout: "_Layout", plain: set[int]) -> Table:
    """The table of a text, with the decimal mark that its numbers show."""
    table = _parse(text, name, layout, plain, ".")
    unclear = None if layout.separator == "," else _unclear_points(text)
    commas, points = _decimals(table, plain)
    if commas > (0 if unclear else points):
        return _parse(text, name, layout, plain, ",")
    if unclear:
        raise QfolioError(
            f"{quote(name)}: {quote(unclear)} may mean {unclear.replace('.', '')} or {unclear}, "
            "and no other number tells which; leave such points out if they mark thousands, or "
            "separate the columns by commas if they mark decimals."
        )
    return table


def _first_table(text: str, layout: "_Layout") -> tuple[str, str]:
    """The text up to a blank line with words below, and what is left out."""
    lines = list(io.StringIO(text, newline=""))
    filled = [k for k, line in enumerate(lines) if line.strip(f"{layout.separator} \t\r\n")]
    left_out = f"the lines above row {layout.before} are left out"
    for last, after in itertools.pairwise(filled):
        if last < layout.before or after == last + 1:
            continue
        (cells,) = csv.reader([lines[after]], delimiter=layout.separator)
        if not begins_row(cells[0].strip()) and not has_numbers(cells[1:]):
            rest = quote(lines[after].strip(), 60)
            left_out += f", and so is what follows the blank row {last + 2}: {rest} …"
            return "".join(lines[: last + 1]), left_out
    return text, left_out


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


def _decimals(table: Table, plain: set[int]) -> tuple[int, int]:
    """How many numbers have a decimal comma, and how many a decimal point."""
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
                commas += has_decimal(cell, ",")
                points += has_decimal(cell, ".")
    return commas, points


def _unclear_points(text: str) -> str | None:
    """A number such as 1.234 if no point between separators can only be a decimal mark."""
    if _POINT.search(text):
        return None
    found = _TWO_READINGS.search(text)
    return found[1] if found else None
