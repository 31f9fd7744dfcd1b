"""Reads one cell of a table: a number, a name, or nothing.

Ambiguous cells are errors.
"""

import math
import re
from collections.abc import Iterable
from decimal import Decimal
from numbers import Real
from typing import Any

import numpy as np

from qfolio.core.text import quote

MISSING = frozenset(
    {"", "-", "--", ".", "na", "n/a", "#n/a", "#n/a n/a", "<na>", "nan", "nat", "none", "null"}
)
CURRENCIES = frozenset("$€£¥₹₽₩₪₺₫₱₦₴₿฿")
PERCENT = "%"
SIGNS = CURRENCIES | {PERCENT}

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(inf|infinity)", re.I | re.A)
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}([,'’ \u00a0\u202f])\d{3}(\1\d{3})*(\.\d*)?", re.A)
_SWAP = str.maketrans(",.", ".,")


def is_missing(cell: Any) -> bool:
    """Whether a cell is empty, or says that there is no value."""
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


def numbers(
    cells: np.ndarray, decimal: str = ".", *, percent: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Cells as float64 (NaN: missing or not a number), and a mask of those that are not numbers.

    A currency sign may stand before or after a number. Groups of thousands are read where they
    cannot be anything else (1,234.50), and so is 1,234 in a column that has such numbers.
    percent: whether a percent sign may stand there, too; 1.2% is then 1.2.
    """
    wrong = np.zeros(len(cells), dtype=bool)
    if cells.dtype.kind == "f":
        return cells.astype(np.float64, copy=False), wrong
    values = np.full(len(cells), np.nan)
    content = cells.tolist()
    for i, cell in enumerate(content):
        if not is_missing(cell):
            number = _number(cell, decimal, percent=percent)
            values[i], wrong[i] = (math.nan, True) if number is None else (number, False)
    if wrong.any() and any(isinstance(cell, str) and groups(cell, decimal) for cell in content):
        for i in np.flatnonzero(wrong).tolist():
            number = _number(content[i], decimal, grouped=True, percent=percent)
            values[i], wrong[i] = (math.nan, True) if number is None else (number, False)
    return values, wrong


def currencies(cells: np.ndarray) -> set[str]:
    """The currency signs beside numbers."""
    if cells.dtype.kind == "f":
        return set()
    return {_bare(cell)[1] for cell in cells.tolist() if isinstance(cell, str)} - {"", PERCENT}


def not_a_number(cell: Any, decimal: str) -> str:
    """Why a cell is not a number, for a message."""
    said = str(cell).strip()
    text, _ = _bare(said)
    other = "," if decimal == "." else "."
    if has_two_readings(said, decimal):
        point = text.replace(",", ".")
        return f"{quote(said)} may mean {text.replace(other, '')} or {point}"
    if other in text and is_number(said, other):
        has, have = ("comma", "points") if other == "," else ("point", "decimal commas")
        return f"{quote(said)} has a decimal {has}, other numbers have {have}"
    if is_percentage(said, decimal):
        return f"{quote(said)} has a percent sign"
    return f"{quote(said)} is not a number"


def is_number(cell: str, decimal: str = ".") -> bool:
    """Whether a cell is a number with this decimal mark."""
    return _number(cell, decimal, percent=True) is not None


def has_numbers(cells: Iterable[str]) -> bool:
    """Whether one of some cells is a number, with either decimal mark."""
    return any(is_number(cell) or is_number(cell, ",") for cell in cells)


def is_percentage(cell: str, decimal: str) -> bool:
    """Whether a cell is a number with a percent sign."""
    return _bare(cell)[1] == PERCENT and is_number(cell, decimal)


def has_decimal(cell: str, decimal: str) -> bool:
    """True if only this can be the number's decimal mark: 12,5 and 1.234,5 but not 1,234."""
    other = "," if decimal == "." else "."
    text, _ = _bare(cell)
    certain = decimal in text or groups(cell, decimal)
    return certain and is_number(cell, decimal) and not has_two_readings(cell, other)


def has_two_readings(cell: str, decimal: str) -> bool:
    """True for 1,234 where the decimal mark is a point: over a thousand, or a little over 1."""
    match = _GROUPED.fullmatch(_plain(cell, decimal))
    return bool(match) and not groups(cell, decimal)


def groups(cell: str, decimal: str) -> bool:
    """True for a number in groups of thousands that can be nothing else."""
    text = _plain(cell, decimal)
    match = _GROUPED.fullmatch(text)
    return bool(match and (match[1] != "," or match[2] or match[3]))


def _plain(cell: str, decimal: str) -> str:
    """The text without such a sign, and with a point as its decimal mark."""
    text, _ = _bare(cell)
    return text.translate(_SWAP) if decimal == "," else text


def _number(
    cell: Any, decimal: str, *, grouped: bool = False, percent: bool = False
) -> float | None:
    try:
        if isinstance(cell, str):
            if _bare(cell)[1] == PERCENT and not percent:
                return None
            text = _plain(cell, decimal)
            if _NUMBER.fullmatch(text):
                return float(text)
            if (match := _GROUPED.fullmatch(text)) and (grouped or groups(cell, decimal)):
                return float(text.replace(match[1], ""))
            return None
        if isinstance(cell, Real | Decimal) and not isinstance(cell, bool | np.bool_):
            return float(cell)
    except OverflowError:  # 10**400
        return math.inf
    return None


def _bare(cell: str) -> tuple[str, str]:
    """The text without its currency or percent sign, and the sign: -$5, $-5, $5, 5 $ and 5%."""
    text = cell.strip()
    sign = text[:1] if text[:1] in ("+", "-") else ""
    rest = text.removeprefix(sign)
    if rest and rest[0] in SIGNS:
        return sign + rest[1:].lstrip(), rest[0]
    if rest and rest[-1] in SIGNS:
        return sign + rest[:-1].rstrip(), rest[-1]
    return text, ""
