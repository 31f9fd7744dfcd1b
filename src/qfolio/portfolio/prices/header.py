"""Names of columns, on one level or, as yfinance's downloads have them, on two."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

from qfolio.portfolio.prices.cells import is_missing, is_number, readable_date
from qfolio.portfolio.prices.vocabulary import ASSET_NAMES, DATE_NAMES, is_price, plain

_PAIR = re.compile(r"""\((["'])(.*?)\1, (["'])(.*?)\3\)""")  # how pandas writes a pair of names


class Header(NamedTuple):
    """The header of a table."""

    names: tuple[str, ...]  # of the columns; of two levels, both with a space between
    levels: dict[int, tuple[str, str]]  # both levels, by column, if there are two
    lines: int = 1  # its length in the file


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
    on a third line.
    """
    first, second, third = ([cell.strip() for cell in r] for r in (*records, [], [])[:3])
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
        return name_columns(first)
    alone = bool(third) and bool(third[0]) and not any(third[1:]) and not _is_value(third[0])
    if alone:
        pairs[0] = third[0]
    elif second[0]:  # the names of the two levels, unless it is that of the column
        pairs[0] = second[0] if plain(second[0]) in DATE_NAMES else ""
    return name_columns(pairs)._replace(lines=2 + alone)


def _text(name: Any) -> str:
    return "" if name is None or name != name else str(name).strip()


def _is_value(cell: str) -> bool:
    return not is_missing(cell) and (is_number(cell) or readable_date(cell))
