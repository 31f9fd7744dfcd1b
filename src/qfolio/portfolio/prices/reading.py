"""Tables as people have them (CSV, Parquet, data frames) as named columns of cells.

Nothing here knows what a price is. Nothing that stands in a file is executed or unpickled, and
nothing is guessed in silence: what can be read in two ways is not read.
"""

import csv
import io
import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta, timezone
from decimal import Decimal
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError

TEXT_FILES = (".csv", ".tsv", ".txt", "")
PARQUET_FILES = (".parquet", ".pq")
MISSING = frozenset({"", "-", "--", ".", "na", "n/a", "#n/a", "<na>", "nan", "nat", "none", "null"})
NO_DATE = "the date is missing"
YEARS = range(1678, 2262)  # what pandas can hold in every resolution

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(inf|infinity)", re.I | re.A)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.I | re.A)
_TWO_READINGS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}", re.A)  # 1,234: a thousand, or little over 1
_THOUSANDS = re.compile(r"[-+]?\d{1,3}([,.'’ \u00a0\u202f]\d{3})+([.,]\d*)?", re.A)
_CLOCK = r"(?:[T ]+(\d{1,2}):(\d\d)(?::(\d\d)(?:\.\d+)?)?)?"
_ZONE = r"(?: ?(Z|UTC|[-+]\d\d:?\d\d))?"
_YEAR_FIRST = re.compile(r"(\d{4})[-/.](\d{1,2})(?:[-/.](\d{1,2}))?" + _CLOCK + _ZONE, re.A)
_DIGITS = re.compile(r"(\d{4})(\d\d)(\d\d)", re.A)
_YEAR_LAST = re.compile(r"(\d{1,2})[-/.](\d{1,2})[-/.](\d{4})" + _CLOCK + _ZONE, re.A)


@dataclass(frozen=True)
class Table:
    """Columns of equal length: float64, datetime64 or, where kinds are mixed, objects."""

    names: tuple[str, ...]
    columns: tuple[np.ndarray, ...]
    first_row: int  # the number people give the first row: 2 in a text file, 0 in a data frame
    source: str
    decimal: str = "."


def read(source: Any, texts: Callable[[tuple[str, ...]], set[int]]) -> Table:
    """A file or a data frame as a table.

    Args:
        source: Path of a CSV or Parquet file, or a data frame that narwhals knows.
        texts: Tells from the names of a text file which of its columns must stay text, because
            0700, NA and TRUE may be names of assets.

    Raises:
        QfolioError: There is no table here.
    """
    if not isinstance(source, str | Path):
        return _from_frame(source)
    path = Path(source)
    kind = path.suffix.lower()
    if kind not in TEXT_FILES + PARQUET_FILES:
        raise QfolioError(
            f"{quote(path)} is not read: tables come as CSV (.csv, .tsv, .txt) or Parquet "
            "(.parquet); export it as CSV."
        )
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise QfolioError(f"{quote(path)} cannot be read: {reason}.") from None
    if kind in PARQUET_FILES:
        return _from_parquet(content, path.name)
    return _from_text(content, path.name, texts)


def quote(value: object, limit: int = 60) -> str:
    """Any value in quotation marks on one line."""
    text = str(value)
    text = text if len(text) <= limit else text[: limit - 1] + "…"
    return "'" + "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text) + "'"


# Reading.


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
    columns = tuple(_cells(column) for column in series)
    return Table(tuple(map(_name, names)), columns, 0, "data frame")


def _from_pandas(frame: Any) -> Table:
    import narwhals as nw
    import pandas as pd

    if frame.columns.nlevels > 1:
        raise QfolioError(
            "the data frame has column names on several levels; "
            "select one kind of price first, for example frame['Close']."
        )
    names = list(frame.columns)
    series = [frame.iloc[:, j] for j in range(len(names))]
    if not isinstance(frame.index, pd.RangeIndex):
        levels = range(frame.index.nlevels)
        names = [frame.index.names[i] for i in levels] + names
        series = [frame.index.get_level_values(i).to_series() for i in levels] + series
    columns = tuple(_cells(nw.from_native(column, series_only=True)) for column in series)
    return Table(tuple(map(_name, names)), columns, 0, "data frame")


def _name(name: Any) -> str:
    return "" if name is None or name != name else str(name).strip()


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
            f"{quote(name)} is no Parquet file or is damaged ({quote(error, 100)})."
        ) from None
    names = frame.column_names
    if len(set(names)) < len(names):  # narwhals would not take them; the caller names them
        frame = frame.rename_columns([str(j) for j in range(len(names))])
    table = _from_frame(frame)
    return Table(tuple(map(_name, names)), table.columns, 0, name)


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
    separator = max(",;\t|", key=lambda mark: len(_head(text, mark)[0]))
    header, following, before = _head(text, separator)
    names = tuple(field.strip() for field in header)
    if len(names) < 2:
        raise QfolioError(
            f"{quote(name)} has one column only, {quote(names[0])}; a table needs dates and "
            "prices, separated by commas, semicolons or tabs."
        )
    if any(field.strip() for field in following[len(names) :]):  # pandas would cut this row
        raise _ragged(name, before + 1, len(following), len(names))
    plain = texts(names)
    table = _parse(text, name, names, separator, before, plain, ".")
    if _uses_decimal_commas(table, plain):
        table = _parse(text, name, names, separator, before, plain, ",")
    return table


def _head(text: str, separator: str) -> tuple[list[str], list[str], int]:
    """The first record that is not blank, the one after it, and how many end with the first."""
    records = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        for count, record in enumerate(records, start=1):
            if any(field.strip() for field in record):
                return record, next(records, []), count
    except csv.Error:  # a field of more than 128 kB
        pass
    return [""], [], 1


def _ragged(source: str, row: int | str, fields: int | str, names: int | str) -> QfolioError:
    return QfolioError(
        f"{quote(source)}, row {row}: there are {fields} fields, but {names} column names; numbers "
        "with decimal commas must be in quotation marks, or the columns separated by semicolons."
    )


def _parse(
    text: str, source: str, names: tuple[str, ...], separator: str, before: int, plain: set[int],
    decimal: str,
) -> Table:  # fmt: skip
    import pandas as pd

    count = len(names)
    spellings = sorted({f(word) for word in MISSING for f in (str, str.upper, str.title)} | {"NaN"})
    old = tuple(map(int, pd.__version__.split(".")[:2])) < (3, 1)  # newer ones are exact anyway
    exact = {"float_precision": "round_trip"} if old else {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pd.errors.ParserWarning)  # blanks after the first row
            frame = pd.read_csv(
                io.StringIO(text), sep=separator, header=None, names=list(range(count)),
                index_col=False, skiprows=before, skip_blank_lines=False, skipinitialspace=True,
                keep_default_na=False, dtype={j: str for j in plain}, decimal=decimal,
                na_values={j: spellings for j in range(count) if j not in plain},
                low_memory=False, **exact,
            )  # fmt: skip
    except (ValueError, OverflowError) as error:
        if fields := re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error)):
            raise _ragged(source, fields[2], fields[3], fields[1]) from None
        raise QfolioError(f"{quote(source)} cannot be read as CSV: {quote(error, 100)}.") from None
    columns = []
    for j in range(count):
        column = frame[j]
        numeric = isinstance(column.dtype, np.dtype) and column.dtype.kind in "fiu"
        columns.append(column.to_numpy(np.float64 if numeric else object))
    return Table(names, tuple(columns), before + 1, source, decimal)


def _uses_decimal_commas(table: Table, plain: set[int]) -> bool:
    """True where cells such as 12,5 abound and no point shows that points are meant."""
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
                text = cell.strip()
                commas += bool(_DECIMAL_COMMA.fullmatch(text) and not _TWO_READINGS.fullmatch(text))
                points += bool(_NUMBER.fullmatch(text) and "." in text)
    return commas > points


# Numbers.


def numbers(cells: np.ndarray, decimal: str = ".") -> tuple[np.ndarray, np.ndarray]:
    """Cells as float64 (NaN: missing or no number) and which of them are neither."""
    wrong = np.zeros(len(cells), dtype=bool)
    if cells.dtype.kind == "f":
        return cells.astype(np.float64, copy=False), wrong
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells.tolist()):
        if not is_missing(cell):
            number = _number(cell, decimal)
            values[i], wrong[i] = (math.nan, True) if number is None else (number, False)
    return values, wrong


def is_missing(cell: Any) -> bool:
    if isinstance(cell, str):
        return cell.strip().lower() in MISSING
    if cell is None or type(cell).__name__ in ("NAType", "NaTType"):
        return True
    if isinstance(cell, Decimal):
        return cell.is_nan()
    return isinstance(cell, float | np.floating) and math.isnan(cell)


def _number(cell: Any, decimal: str) -> float | None:
    try:
        if isinstance(cell, str):
            text = cell.strip()
            if decimal == ",":
                text = "no" if "." in text else text.replace(",", ".")
            return float(text) if _NUMBER.fullmatch(text) else None
        if isinstance(cell, Real | Decimal) and not isinstance(cell, bool | np.bool_):
            return float(cell)
    except OverflowError:  # 10**400
        return math.inf
    return None


def no_number(cell: Any, decimal: str) -> str:
    """Says what is wrong with a cell that should hold a number."""
    text = str(cell).strip()
    if _TWO_READINGS.fullmatch(text):
        return f"{quote(text)} may mean {text.replace(',', '')} or {text.replace(',', '.')}"
    if _THOUSANDS.fullmatch(text):
        return f"{quote(text)} has a thousands separator"
    if decimal == "." and _DECIMAL_COMMA.fullmatch(text):
        return f"{quote(text)} has a decimal comma, other numbers have points"
    if decimal == "," and _NUMBER.fullmatch(text):
        return f"{quote(text)} has a point, other numbers have decimal commas"
    return f"{quote(text)} is not a number"


# Dates.


def dates(cells: np.ndarray) -> tuple[np.ndarray, dict[int, str]]:
    """Cells as datetime64[s] (NaT: missing or unreadable), and by row what is wrong with them.

    Read are dates and times themselves, ISO 8601 and its kin (2020-01-31, 2020/1/31, 20200131,
    2020-01-31 16:00+01:00), and 31/01/2020 or 01/31/2020 where at least one cell of the column
    shows which number is the day. Times with a zone lose it: dates at midnight of their own zone
    stay the date they name, all others become UTC.
    """
    import pandas as pd

    if cells.dtype.kind == "M":
        cells = cells.astype("datetime64[us]")  # tolist() gives integers for nanoseconds
    cells = np.fromiter(cells.tolist(), dtype=object, count=len(cells))
    try:
        codes, unique = pd.factorize(cells)
    except TypeError:  # lists and the like
        codes, unique = pd.factorize(np.array([str(cell) for cell in cells], dtype=object))
    firsts = [int(m[1]) for m in map(_year_last, unique) if m]
    seconds = [int(m[2]) for m in map(_year_last, unique) if m]
    day_first, month_first = max(firsts, default=0) > 12, max(seconds, default=0) > 12
    order = None if day_first == month_first else "day" if day_first else "month"
    moments = [_moment(cell, order) for cell in unique]
    aware = [m for m in moments if isinstance(m, datetime) and m.tzinfo]
    midnight = all(not (m.hour or m.minute or m.second) for m in aware)
    good = np.full(len(moments) + 1, np.datetime64("NaT", "s"))
    bad: list[str | None] = [None] * len(moments) + [NO_DATE]
    for k, moment in enumerate(moments):
        if isinstance(moment, str):
            bad[k] = moment
        elif aware and not midnight and not moment.tzinfo:
            bad[k] = f"{quote(unique[k])} has no time zone, other dates have one"
        else:
            moment = moment if midnight else moment.astimezone(UTC)
            good[k] = np.datetime64(moment.replace(tzinfo=None), "s")
    faulty = np.array([complaint is not None for complaint in bad])
    return good[codes], {int(i): str(bad[codes[i]]) for i in np.flatnonzero(faulty[codes])}


def readable_date(text: str) -> bool:
    """True for text that is a date, whichever number may be the day."""
    return isinstance(_moment(text, "day"), datetime) or bool(_year_last(text))


def _year_last(cell: Any) -> re.Match[str] | None:
    return _YEAR_LAST.fullmatch(cell.strip()) if isinstance(cell, str) else None


def _moment(cell: Any, order: str | None) -> datetime | str:
    """A date, with its zone if it has one, or what is wrong with it."""
    if is_missing(cell):
        return NO_DATE
    try:
        moment = _read_moment(cell, order)
    except (ValueError, OverflowError):  # 30 February
        return f"{quote(cell)} is not a date of the calendar"
    if isinstance(moment, datetime) and moment.year not in YEARS:
        return f"{quote(cell)} lies outside the years {YEARS[0]} to {YEARS[-1]}"
    return moment or f"{quote(cell)} is not a date that can be read"


def _read_moment(cell: Any, order: str | None) -> datetime | str | None:
    if isinstance(cell, datetime):
        return cell.replace(microsecond=0)
    if isinstance(cell, date):
        return datetime(cell.year, cell.month, cell.day)
    if isinstance(cell, bool):
        return None
    if isinstance(cell, Real):
        number = float(cell)
        cell = f"{number:.0f}" if number.is_integer() else str(number)
    text = str(cell).strip()
    if match := _DIGITS.fullmatch(text):
        return datetime(int(match[1]), int(match[2]), int(match[3]))
    if match := _YEAR_FIRST.fullmatch(text):
        year, month, day, *clock = match.groups()
    elif match := _YEAR_LAST.fullmatch(text):
        day, month, year, *clock = match.groups()
        if order is None:
            return f"in {quote(text)} no other row tells surely which number is the day"
        if order == "month":
            day, month = month, day
    else:
        return None
    hour, minute, second, zone = clock
    return datetime(
        int(year), int(month), int(day or 1), int(hour or 0), int(minute or 0), int(second or 0),
        tzinfo=_zone(zone),
    )  # fmt: skip


def _zone(text: str | None) -> timezone | None:
    if text is None or text in ("Z", "UTC"):
        return UTC if text else None
    offset = timedelta(hours=int(text[1:3]), minutes=int(text[-2:]))
    return timezone(-offset if text[0] == "-" else offset)
