"""Reads the dates of a table: text, dates, or numbers that count days or seconds."""

import math
import re
from datetime import UTC, date, datetime, timedelta, timezone
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from qfolio.core.text import quote
from qfolio.portfolio.prices.cells import is_missing

NO_DATE = "the date is missing"
YEARS = range(1678, 2262)  # what pandas can hold in every resolution

_CLOCK = r"(?:[T ]+(\d{1,2}):(\d\d)(?::(\d\d)(?:\.\d+)?)?)?"
_ZONE = r"(?: ?(Z|UTC|[-+]\d\d:?\d\d))?"
_YEAR_FIRST = re.compile(r"(\d{4})[-/.](\d{1,2})(?:[-/.](\d{1,2}))?" + _CLOCK + _ZONE, re.A)
_DIGITS = re.compile(r"(\d{4})(\d\d)(\d\d)", re.A)
_MONTH = re.compile(r"(\d{4})(0[1-9]|1[0-2])", re.A)
_YEAR_LAST = re.compile(r"(\d{1,2})[-/.](\d{1,2})[-/.](\d{4})" + _CLOCK + _ZONE, re.A)
_NAMED = re.compile(
    r"(?:(\d{1,2})[ -]([A-Z]{3,9})\.?[ -](\d{4})|([A-Z]{3,9})\.? (\d{1,2}),? (\d{4}))"
    + _CLOCK
    + _ZONE,
    re.A | re.I,
)
_SHORT_YEAR = re.compile(r"\d{1,2}([-/.])\d{1,2}\1\d{1,2}" + _CLOCK + _ZONE, re.A)
_MONTHS = (
    "january", "february", "march", "april", "may", "june", "july", "august", "september",
    "october", "november", "december",
)  # fmt: skip
_TIME = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d)(?:\.\d+)?)?|(\d\d)(\d\d)(\d\d)", re.A)
_COUNT = re.compile(r"-?\d+(\.\d+)?", re.A)


class Unit(NamedTuple):
    """What a number counts, if it stands for a date."""

    name: str
    seconds: float
    origin: float  # seconds from 1970 to zero
    largest: tuple[float, float]  # where the largest number of a column lies


_DAY = 86400.0
_EXCEL = Unit("Excel's serial numbers", _DAY, -25569 * _DAY, (25569, 80000))  # 1970 to 2119
UNITS = (
    _EXCEL,
    *(
        Unit(f"Unix {name}", 10.0**-k, 0.0, (10.0 ** (8 + k), 9.2 * 10.0 ** (9 + k)))
        for name, k in (
            ("seconds", 0),
            ("milliseconds", 3),
            ("microseconds", 6),
            ("nanoseconds", 9),
        )
    ),
)
"""Days since 1970 are not among them: today's count is also a day of 1956 in Excel."""
MOST = 1e19  # more than any unit's
LONGEST_STEP = 10 * 366 * _DAY  # between dates in one unit; two units mixed are further apart


class Dates(NamedTuple):
    """A column of dates."""

    moments: np.ndarray  # datetime64[s]; NaT: missing or unreadable
    complaints: dict[int, str]  # by row
    unit: Unit | None  # what the column counts, if it holds numbers


def read_dates(cells: np.ndarray, *, by_day: bool = False) -> Dates:
    """A column of cells as dates.

    Accepts dates and times, ISO 8601 and similar texts (2020-01-31, 2020/1/31, 20200131,
    2020-01-31 16:00+01:00), 31-Jan-2020, Jan 31, 2020 and 31.01.2020, and 31/01/2020 or 01/31/2020
    if at least one cell of the column shows which number is the day. A column of more than a year
    may hold months (202001). Time zones are dropped: if all times are midnight in their own zones,
    the dates are kept; otherwise times are converted to UTC. A column that holds only numbers may
    count one of ``UNITS``.

    by_day: whether dates are also kept if each is of another day in its zone. Only for prices:
    what is known beside several prices a day must not be dated earlier than it was known.
    """
    import pandas as pd

    cells = _objects(cells)
    try:
        codes, unique = pd.factorize(cells)
    except TypeError:  # lists and the like
        codes, unique = pd.factorize(np.array([str(cell) for cell in cells], dtype=object))
    good = np.full(len(unique) + 1, np.datetime64("NaT", "s"))
    bad: list[str | None] = [None] * len(unique) + [NO_DATE]
    unit = _unit(counts := _counts(unique))
    moments = _of_unit(counts, unit) if unit else _of_months(counts) or _of_calendar(unique, by_day)
    for k, moment in enumerate(moments):
        if isinstance(moment, str):
            bad[k] = moment
        else:
            good[k] = np.datetime64(moment, "s")
    faulty = np.array([complaint is not None for complaint in bad])
    complaints = {int(i): str(bad[codes[i]]) for i in np.flatnonzero(faulty[codes])}
    return Dates(good[codes], complaints, unit)


def with_times(cells: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Dates as text, with the times of day beside them (153000 or 15:30)."""
    joined = []
    for day, time in zip(_objects(cells), _objects(times), strict=True):
        text = "" if is_missing(day) else str(day).strip().removesuffix(" 00:00:00")
        if match := _DIGITS.fullmatch(text.removesuffix(".0")):
            text = "-".join(match.groups())
        clock = _time(time)
        if match := _TIME.fullmatch(clock):
            clock = ":".join(part for part in match.groups() if part)
        joined.append(f"{text} {clock}" if text else "")
    return np.array(joined, dtype=object)


def are_times(cells: np.ndarray) -> bool:
    """True for a column of times of day."""
    return len(cells) > 0 and all(_TIME.fullmatch(_time(cell)) for cell in _objects(cells))


def _time(cell: Any) -> str:
    if isinstance(cell, float) and cell.is_integer():
        return f"{cell:06.0f}"  # 93000, of a data frame
    return str(cell).strip()


def _objects(cells: np.ndarray) -> np.ndarray:
    if cells.dtype.kind == "M":
        cells = cells.astype("datetime64[us]")  # tolist() gives integers for nanoseconds
    return np.fromiter(cells.tolist(), dtype=object, count=len(cells))


# Numbers.


def _counts(cells: np.ndarray) -> np.ndarray:
    """The numbers of a column, NaN where a cell is missing; empty if a cell is something else."""
    counts = np.full(len(cells), np.nan)
    for k, cell in enumerate(cells):
        if is_missing(cell):
            continue
        text = isinstance(cell, str) and _COUNT.fullmatch(cell.strip())
        if not text and (isinstance(cell, str | bool | datetime) or not isinstance(cell, Real)):
            return np.empty(0)
        counts[k] = _number(cell)
    return counts


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except OverflowError:
        return math.inf


def _unit(counts: np.ndarray) -> Unit | None:
    """What the numbers of a column count, if they can count only one thing."""
    known = np.unique(counts[~np.isnan(counts)])
    if not len(known) or np.abs(known).max() > MOST:
        return None
    for unit in UNITS:
        low, high = unit.largest
        if low <= known[-1] < high and (np.diff(known) <= LONGEST_STEP / unit.seconds).all():
            return None if unit is _EXCEL and known[0] < 61 else unit  # Excel has a 1900-02-29
    return None


def _of_unit(counts: np.ndarray, unit: Unit) -> list[datetime | str]:
    start = datetime(1970, 1, 1)
    return [
        NO_DATE if math.isnan(count) else start + timedelta(seconds=_seconds(count, unit))
        for count in counts.tolist()
    ]


def _seconds(count: float, unit: Unit) -> int:
    seconds = count * unit.seconds + unit.origin
    return round(seconds) if unit is _EXCEL else math.floor(seconds)


def _of_months(counts: np.ndarray) -> list[datetime | str]:
    """The first days of months such as 202001; empty if a column holds anything else.

    It must have more rows than a year has months, most of them at most a quarter apart: 200112 may
    be a day of 2020.
    """
    known = counts[~np.isnan(counts)]
    years, months = np.divmod(known, 100)
    if (
        len(known) <= 12
        or not np.isin(years, YEARS).all()
        or not np.isin(months, range(1, 13)).all()
        or np.median(np.diff(np.sort(12 * years + months))) > 3
    ):
        return []
    return [
        NO_DATE if math.isnan(count) else datetime(int(count) // 100, int(count) % 100, 1)
        for count in counts.tolist()
    ]


# Text and dates.


def _of_calendar(cells: np.ndarray, by_day: bool) -> list[datetime | str]:
    """Dates without time zones, or complaints."""
    ends = [match for match in map(_year_last, cells) if match]
    day_first, month_first = (any(int(match[k]) > 12 for match in ends) for k in (1, 2))
    order = None if day_first == month_first else "day" if day_first else "month"
    if ends and not (day_first or month_first) and all("." in match[0][1:3] for match in ends):
        order = "day"  # wherever dates are written with points
    moments = [_moment(cell, order) for cell in cells]
    aware = [m for m in moments if isinstance(m, datetime) and m.tzinfo]
    midnight = all(not (m.hour or m.minute or m.second) for m in aware)
    # The last of daily rows often has the time of the download.
    local = midnight or (by_day and len({m.date() for m in aware}) == len(aware))
    read: list[datetime | str] = []
    for cell, moment in zip(cells, moments, strict=True):
        if isinstance(moment, str):
            read.append(moment)
        elif aware and not midnight and not moment.tzinfo:
            read.append(f"{quote(cell)} has no time zone, other dates have one")
        else:
            read.append((moment if local else moment.astimezone(UTC)).replace(tzinfo=None))
    return read


def readable_date(text: str) -> bool:
    """True for text that is a date, whichever number is the day."""
    return isinstance(_moment(text, "day"), datetime) or bool(_year_last(text))


def begins_row(text: str) -> bool:
    """True for text that is a date or a month such as 202001, as the first cell of a row."""
    return readable_date(text) or bool(_MONTH.fullmatch(text))


def _year_last(cell: Any) -> re.Match[str] | None:
    return _YEAR_LAST.fullmatch(cell.strip()) if isinstance(cell, str) else None


def _moment(cell: Any, order: str | None) -> datetime | str:
    """A date, with its zone if it has one, or a complaint."""
    if is_missing(cell):
        return NO_DATE
    try:
        moment = _read_moment(cell, order)
    except (ValueError, OverflowError):  # 30 February
        return f"{quote(cell)} is not a date of the calendar"
    if isinstance(moment, datetime) and moment.year not in YEARS:
        return f"{quote(cell)} lies outside the years {YEARS[0]} to {YEARS[-1]}"
    if moment is None and isinstance(cell, str) and _SHORT_YEAR.fullmatch(cell.strip()):
        return f"{quote(cell)} may have a year of two digits, which can be read in several ways"
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
            return f"in {quote(text)} no other row shows which number is the day"
        if order == "month":
            day, month = month, day
    elif match := _NAMED.fullmatch(text):
        *either, hour, minute, second, zone = match.groups()
        day, name, year = either[:3] if either[0] else (either[4], either[3], either[5])
        named = [k for k, month in enumerate(_MONTHS, 1) if month.startswith(name.lower())]
        if len(named) != 1:
            return None
        month, clock = named[0], [hour, minute, second, zone]
    else:
        return None
    hour, minute, second, zone = clock
    return datetime(
        int(year), int(month), int(day or 1), int(hour or 0), int(minute or 0), int(second or 0),
        tzinfo=_zone(zone),
    )  # fmt: skip


def _zone(text: str | None) -> timezone | None:
    if text is None or text.upper() in ("Z", "UTC"):
        return UTC if text else None
    offset = timedelta(hours=int(text[1:3]), minutes=int(text[-2:]))
    return timezone(-offset if text[0] == "-" else offset)
