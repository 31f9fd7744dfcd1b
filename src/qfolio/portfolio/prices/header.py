"""Names of columns, on one level or, as yfinance's downloads have them, on two."""

import itertools
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from qfolio.portfolio.prices.cells import has_numbers, is_missing, is_number
from qfolio.portfolio.prices.dates import begins_row, readable_date
from qfolio.portfolio.prices.vocabulary import (
    ASSET_NAMES,
    DATE_NAMES,
    SETTINGS,
    is_price,
    kind,
    plain,
)

_PAIR = re.compile(r"""\((["'])(.*?)\1, (["'])(.*?)\3\)""")  # how pandas writes a pair of names


class Header(NamedTuple):
    """The header of a table."""

    names: tuple[str, ...]  # of the columns; two levels are joined by a space
    levels: dict[int, tuple[str, str]]  # both levels, by column, if there are two
    lines: int = 1  # number of lines in the file
    below_text: bool = False  # whether sentences precede it, as in a report


def name_columns(names: Iterable[Any]) -> Header:
    """The header of columns with these names: text, pairs of names, or such pairs as text."""
    texts, levels = [], {}
    for j, name in enumerate(names):
        if isinstance(name, str) and (match := _PAIR.fullmatch(name.strip())):
            name = (match[2], match[4])
        parts = [_text(part) for part in name] if isinstance(name, tuple) else [_text(name)]
        if len(parts) == 2 and all(parts):
            levels[j] = (parts[0], parts[1])
        texts.append(" ".join(filter(None, parts)))
    return Header(tuple(texts), levels)


def parse_header(records: list[list[str]]) -> Header:
    """The header at the start of a file's records, of which the first is not blank.

    pandas writes columns with two levels as two lines, with the levels' names in the first column
    (Price, Close, High, … above Ticker, AAPL, AAPL, …); if the index has a name, it stands alone
    on a third line. Bloomberg's exports have settings above, and then tickers above fields; Kenneth
    French's tables have sentences above.
    """
    records = [[cell.strip() for cell in record] or [""] for record in records]
    if header := _below_settings(records):
        return header
    first, second, third = (*records, [], [])[:3]
    pairs: list[Any] = list(first)
    above = ""
    for j in range(1, min(len(first), len(second))):
        above = first[j] or above  # spreadsheets write it once for several columns
        pairs[j] = (above, second[j]) if second[j] else first[j]
    two = [pair for pair in pairs if isinstance(pair, tuple)]
    if (
        len(second) != len(first)
        or not any(is_price(part) for pair in two for part in pair)
        or (any(map(_is_value, second)) and plain(second[0]) not in ASSET_NAMES)
    ):
        return _below_text(records) or name_columns(first)
    alone = bool(third) and bool(third[0]) and not any(third[1:]) and not _is_value(third[0])
    if alone:
        pairs[0] = third[0]
    elif second[0]:  # the names of the two levels, unless it is that of the column
        pairs[0] = second[0] if plain(second[0]) in DATE_NAMES else ""
    return name_columns(pairs)._replace(lines=2 + alone)


def _below_settings(records: list[list[str]]) -> Header | None:
    """The header below lines such as Start Date,2024-01-02; None if there are no such lines."""
    if _setting(records[0]) not in SETTINGS:
        return None
    begins = (
        k
        for k, (record, below) in enumerate(itertools.pairwise(records))
        if readable_date(below[0]) or plain(record[0]) in DATE_NAMES
    )
    if not (k := next(begins, 0)):
        return None
    above = [
        r
        for r in records[:k]
        if _setting(r) in ("", "security", "securities")
        and any(r[1:])
        and not any(map(kind, r[1:]))
    ]
    names: list[Any] = list(records[k])
    if above:
        tickers, ticker = above[-1], ""
        for j in range(1, len(names)):
            ticker = (tickers[j] if j < len(tickers) else "") or ticker
            names[j] = (ticker, names[j]) if names[j] else ""
    names[0] = names[0] or "date"
    return name_columns(names)._replace(lines=k + 1)


def _below_text(records: list[list[str]]) -> Header | None:
    """The header below lines of text; None if it is the first record, or cannot be told.

    It is a record of words above the first row of numbers. The record above it has another number
    of cells, or only the first of them, as spreadsheets write a title; else either could hold the
    names.
    """
    filled = [(k, record) for k, record in enumerate(records) if any(record)]
    for (_, above), (k, record), (_, below) in zip(filled, filled[1:], filled[2:], strict=False):
        if _is_row(above):
            return None
        last = max((j for j, name in enumerate(record) if name), default=0)
        if (
            (len(above) != len(record) or not any(above[1:]))
            and len(record) == len(below)
            and last > 0
            and all(record[1:last])
            and not any(map(_is_value, record))
            and (not record[0] or not is_missing(record[0]))
            and _is_row(below)
        ):
            names = record[0] or "date", *record[1:]
            return name_columns(names)._replace(lines=k + 1, below_text=True)
    return None


def _is_row(record: list[str]) -> bool:
    """Whether a record begins with a date, and has a number."""
    return begins_row(record[0]) and has_numbers(record[1:])


def _setting(record: list[str]) -> str:
    return plain(record[0]).rstrip(": ")


def _text(name: Any) -> str:
    return "" if name is None or name != name else str(name).strip()


def _is_value(cell: str) -> bool:
    return not is_missing(cell) and (is_number(cell) or readable_date(cell))
