"""Reads one cell of a table: a number, a date, or nothing.

Ambiguous cells are errors.
"""

import math
import re
from datetime import UTC, date, datetime, timedelta, timezone
from decimal import Decimal
from numbers import Real
from typing import Any

import numpy as np

from qfolio.core.text import quote

MISSING = frozenset({"", "-", "--", ".", "na", "n/a", "#n/a", "<na>", "nan", "nat", "none", "null"})
CURRENCIES = frozenset("$€£¥₹₽₩₪₺₫₱₦₴₿฿")
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


def is_missing(cell: Any) -> bool:
    if isinstance(cell, str):
        return cell.strip().lower() in MISSING
    if cell is None or type(cell).__name__ in ("NAType", "NaTType"):
        return True
    if isinstance(cell, Decimal):
        return cell.is_nan()
    return isinstance(cell, float | np.floating) and math.isnan(cell)


def label(cell: Any) -> str:
    """An asset's name; text is kept as it is, because NA and NULL are names of assets, too."""
    if isinstance(cell, str):
        return cell.strip()
    if is_missing(cell):
        return ""
    return f"{cell:.0f}" if isinstance(cell, float) and cell.is_integer() else str(cell)


# Numbers.


def numbers(cells: np.ndarray, decimal: str = ".") -> tuple[np.ndarray, np.ndarray]:
    """Cells as float64 (NaN: missing or not a number), and a mask of those that are not numbers.

    A currency sign may stand before or after a number.
    """
    wrong = np.zeros(len(cells), dtype=bool)
    if cells.dtype.kind == "f":
        return cells.astype(np.float64, copy=False), wrong
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells.tolist()):
        if not is_missing(cell):
            number = _number(cell, decimal)
            values[i], wrong[i] = (math.nan, True) if number is None else (number, False)
    return values, wrong


def currencies(cells: np.ndarray) -> set[str]:
    """The currency signs beside numbers."""
    if cells.dtype.kind == "f":
        return set()
    return {_bare(cell)[1] for cell in cells.tolist() if isinstance(cell, str)} - {""}


def not_a_number(cell: Any, decimal: str) -> str:
    """Why a cell is not a number, for a message."""
    said = str(cell).strip()
    text, _ = _bare(said)
    if _TWO_READINGS.fullmatch(text):
        point = text.replace(",", ".")
        return f"{quote(said)} may mean {text.replace(',', '')} or {point}"
    if _THOUSANDS.fullmatch(text):
        return f"{quote(said)} has a thousands separator"
    if decimal == "." and _DECIMAL_COMMA.fullmatch(text):
        return f"{quote(said)} has a decimal comma, other numbers have points"
    if decimal == "," and _NUMBER.fullmatch(text):
        return f"{quote(said)} has a point, other numbers have decimal commas"
    return f"{quote(said)} is not a number"


def is_number(cell: str, decimal: str = ".") -> bool:
    return _number(cell, decimal) is not None


def has_decimal_comma(cell: str) -> bool:
    """True for 12,5 but not for 1,234, which may be a thousand."""
    text, _ = _bare(cell)
    return bool(_DECIMAL_COMMA.fullmatch(text) and not _TWO_READINGS.fullmatch(text))


def has_decimal_point(cell: str) -> bool:
    text, _ = _bare(cell)
    return bool(_NUMBER.fullmatch(text) and "." in text)


def _number(cell: Any, decimal: str) -> float | None:
    try:
        if isinstance(cell, str):
            text, _ = _bare(cell)
            if decimal == ",":
                text = "no" if "." in text else text.replace(",", ".")
            return float(text) if _NUMBER.fullmatch(text) else None
        if isinstance(cell, Real | Decimal) and not isinstance(cell, bool | np.bool_):
            return float(cell)
    except OverflowError:  # 10**400
        return math.inf
    return None


def _bare(cell: str) -> tuple[str, str]:
    """The text without its currency sign, and the sign: -$5, $-5, $5 and 5 $."""
    text = cell.strip()
    sign = text[:1] if text[:1] in ("+", "-") else ""
    rest = text.removeprefix(sign)
    if rest and rest[0] in CURRENCIES:
        return sign + rest[1:].lstrip(), rest[0]
    if rest and rest[-1] in CURRENCIES:
        return sign + rest[:-1].rstrip(), rest[-1]
    return text, ""


# Dates.


def dates(cells: np.ndarray) -> tuple[np.ndarray, dict[int, str]]:
    """Cells as datetime64[s] (NaT: missing or unreadable), and complaints by row.

    Accepts dates and times, ISO 8601 and similar texts (2020-01-31, 2020/1/31, 20200131,
    2020-01-31 16:00+01:00), and 31/01/2020 or 01/31/2020 if at least one cell of the column shows
    which number is the day. Time zones are dropped: if all times are midnight in their own zones,
    the dates stay; otherwise times become UTC.
    """
    import pandas as pd

    if cells.dtype.kind == "M":
        cells = cells.astype("datetime64[us]")  # tolist() gives integers for nanoseconds
    cells = np.fromiter(cells.tolist(), dtype=object, count=len(cells))
    try:
        codes, unique = pd.factorize(cells)
    except TypeError:  # lists and the like
        codes, unique = pd.factorize(np.array([str(cell) for cell in cells], dtype=object))
    ends = [match for match in map(_year_last, unique) if match]
    day_first, month_first = (any(int(match[k]) > 12 for match in ends) for k in (1, 2))
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
    """True for text that is a date, whichever number is the day."""
    return isinstance(_moment(text, "day"), datetime) or bool(_year_last(text))


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
