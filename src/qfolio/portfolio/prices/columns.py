"""Finds the columns of a table that hold dates, assets, prices and features."""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from qfolio.core.text import hint, quote
from qfolio.portfolio.prices.bars import columns_of_kind, pick_prices
from qfolio.portfolio.prices.cells import has_numbers, is_missing, is_number, numbers
from qfolio.portfolio.prices.dates import are_times, read_dates, readable_date, with_times
from qfolio.portfolio.prices.findings import LISTED, Findings, listing
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.vocabulary import (
    ADJUSTED_NAMES,
    ASSET_NAMES,
    DATE_NAMES,
    NAV_NAMES,
    PRICE_NAMES,
    RETURN_NAMES,
    kind,
    plain,
)

LOOKED_AT = 1000  # cells of a column that are examined to tell its content


class Feature(NamedTuple):
    """Where a feature is: in one column, or in one for each asset of a wide table.

    by_asset: whether it is a number of each asset, not one of the whole market.
    """

    columns: tuple[int, ...]
    by_asset: bool


@dataclass(frozen=True)
class Columns:
    """The columns of a table by content, as their indices.

    date: the column of dates.
    time: the column of times of day beside it; None if there is none.
    asset: the column of assets' names in a long table; None in a wide one.
    assets: names of the assets of a wide table; empty in a long one.
    prices: one for each asset of a wide table; a single one in a long table.
    """

    date: int
    time: int | None
    asset: int | None
    assets: tuple[str, ...]
    prices: tuple[int, ...]
    features: tuple[Feature, ...]


def text_columns(names: tuple[str, ...], date: str | None) -> set[int]:
    """Columns of a text file that hold dates or names, even if they look like numbers."""
    known = DATE_NAMES + ASSET_NAMES
    return {0, *(j for j, name in enumerate(names) if plain(name) in known or name == date)}


def find_columns(
    table: Table,
    features: tuple[str, ...],
    shared: tuple[str, ...],
    date: str | None,
    findings: Findings,
    *,
    returns: bool = False,
) -> Columns | None:
    """The columns that matter; None after an error.

    shared: columns of the whole market, which come after the features. returns: whether the table
    holds returns in place of prices.
    """
    columns = _check_names(table, features, shared, date, findings)
    features += shared
    if findings.bad:
        return None
    when = _date_column(table, columns, date)
    if when is None:
        findings.error(
            "there is no column of dates",
            advice="Name it 'date', or give its name with date= (--date).",
        )
        return None
    counted = (j for j in columns if j != when and _counts_rows(table, j))
    time = _time_column(table, columns, when)
    columns = [j for j in columns if j not in {when, time, *counted}]
    single = {table.names[j]: j for j in columns}
    by_asset = {name: columns_of_kind(table, name) for name in features}
    for name in features:
        if name not in single and not by_asset[name]:
            findings.error(f"the column {quote(name)} holds dates or row numbers, not a feature")
            return None
    channels = {j for name in features for j in by_asset[name].values()}
    channels |= {single[name] for name in features if name in single}
    others = [j for j in columns if j not in channels]
    label, price = _long_columns(table, others, when, findings, returns=returns)
    if findings.bad:
        return None
    if label is not None and price is not None:
        own = tuple(Feature((single[name],), name not in shared) for name in features)
        return Columns(when, time, label, (), (price,), own)
    _check_wide(table, others, when, time, findings)
    if findings.bad:
        return None
    assets, prices = pick_prices(table, others, findings)
    wanted = []
    for name in features:
        if name in single:
            wanted.append(Feature((single[name],), by_asset=False))
        elif lacking := [asset for asset in assets if asset not in by_asset[name]]:
            findings.error(
                f"there is no {quote(name)} of {listing(lacking)}", advice="Add its column."
            )
        else:
            each = tuple(by_asset[name][asset] for asset in assets)
            wanted.append(Feature(each, name not in shared))
    return None if findings.bad else Columns(when, time, None, assets, prices, tuple(wanted))


def _check_names(
    table: Table,
    features: tuple[str, ...],
    shared: tuple[str, ...],
    date: str | None,
    findings: Findings,
) -> list[int]:
    """The columns that matter: all but those that have neither a name nor content."""
    names = table.names
    columns = [j for j, name in enumerate(names) if name or not _is_blank(table.columns[j])]
    if table.first_row and (readable_date(names[0]) or all(map(is_number, names))):
        findings.error(
            "the first line holds values instead of column names", row=table.first_row - 1,
            advice="Put a line of names on top, such as date,AAPL,MSFT.",
        )  # fmt: skip
        return columns
    places: dict[str, list[int]] = {}
    for j in columns:
        places.setdefault(names[j], []).append(j)
    for name, where in places.items():
        if len(where) > 1:
            listed = " and ".join(str(j + 1) for j in where[:LISTED])
            more = " and others" if len(where) > LISTED else ""
            advice = "Give every column a name of its own."
            if plain(name) in DATE_NAMES:
                advice = "Give one column of dates for all assets, or one file for each asset."
            findings.error(
                f"the columns {listed}{more} have the same name", column=name, advice=advice
            )
    wanted = features + shared
    for name in dict.fromkeys((*wanted, *([] if date is None else [date]))):
        if name not in places and not columns_of_kind(table, name):
            # A cash rate, say, may come from another file, which has to be named each time.
            other = f"; for another file, write --columns {name}=FILE" if name in shared else ""
            findings.error(
                f"there is no column {quote(name)}{hint(name, names)}",
                advice=f"The columns are {listing(names)}{other}.",
            )
    if len(set(wanted)) < len(wanted) or date in wanted:
        findings.error("a column is named twice among the features and the dates")
    return columns


def _is_blank(cells: np.ndarray) -> bool:
    if cells.dtype.kind == "f":
        return bool(np.isnan(cells).all())
    return cells.dtype.kind != "M" and all(map(is_missing, cells.tolist()))


def _counts_rows(table: Table, j: int) -> bool:
    """Whether a column holds the row numbers that many programs write."""
    if table.names[j] not in ("", "Unnamed: 0", "index", "__index_level_0__"):
        return False
    values, _ = numbers(table.columns[j])
    return bool(np.array_equal(values, np.arange(len(values))))


def _date_column(table: Table, columns: list[int], date: str | None) -> int | None:
    if date is not None:
        return table.names.index(date)
    for name in (*DATE_NAMES, "index level 0"):  # the latter is written by pandas to Parquet
        for j in columns:
            if plain(table.names[j]) == name:
                return j
    if not columns or plain(table.names[columns[0]]) in ASSET_NAMES:
        return None
    cells = table.columns[columns[0]][:LOOKED_AT]
    moments, _, unit = read_dates(cells)
    likely = (~np.isnat(moments) & (unit is None)).any() or numbers(cells)[1].any()
    return columns[0] if likely else None


def _time_column(table: Table, columns: list[int], when: int) -> int | None:
    """The column of times of day beside the dates, as Stooq and MetaTrader write it."""
    for j in columns:
        if j != when and plain(table.names[j]) == "time" and are_times(table.columns[j]):
            return j
    return None


def _long_columns(
    table: Table, columns: list[int], when: int, findings: Findings, *, returns: bool
) -> tuple[int | None, int | None]:
    """The columns of assets and of prices in a long table; (None, None) in a wide one.

    NAME and VALUE may also be two assets of a wide table.
    """
    names = {j: plain(table.names[j]) for j in columns}
    assets = [j for j in columns if names[j] in ASSET_NAMES]
    order = [ADJUSTED_NAMES, PRICE_NAMES, NAV_NAMES]
    order.insert(0 if returns else 3, RETURN_NAMES)
    prices = next(filter(None, ([j for j in columns if names[j] in each] for each in order)), [])
    if not assets or not prices:
        return None, None
    labels = [j for j in assets if _are_labels(table.columns[j])]
    if not labels and not _repeats(table.columns[when]):
        return None, None
    if names[prices[0]] in RETURN_NAMES and not returns:
        findings.error(
            "holds returns, but no column is called price or close",
            column=table.names[prices[0]],
            advice="Choose returns='percent' or 'fraction' (--returns), or name the column of "
            "prices 'price'.",
        )
    for what, found in (("assets", labels or assets), ("prices", prices)):
        if len(found) > 1:
            listed = " and ".join(quote(table.names[j]) for j in found)
            findings.error(f"the columns {listed} could all be the {what}", advice="Keep one.")
    return (labels or assets)[0], prices[0]


def _repeats(dates: np.ndarray) -> bool:
    """Whether a date appears twice in a column."""
    moments = read_dates(dates).moments
    known = moments[~np.isnat(moments)]
    return len(np.unique(known)) < len(known)


def _are_labels(cells: np.ndarray) -> bool:
    """True for cells that are text, or few different whole numbers: prices are neither."""
    values, wrong = numbers(cells)
    if wrong[:LOOKED_AT].any():
        return True
    values = values[np.isfinite(values)]
    different = len(np.unique(values))
    return bool((values == np.rint(values)).all()) and 0 < different <= max(1, len(values) // 10)


def _check_wide(
    table: Table, columns: list[int], when: int, time: int | None, findings: Findings
) -> None:
    """Finds columns without a name, and names of assets, which only a long table has."""

    @cache
    def repeats() -> bool:
        dates = table.columns[when]
        return _repeats(dates if time is None else with_times(dates, table.columns[time]))

    for j in columns:
        if not table.names[j]:
            findings.error(f"column {j + 1} has no name", advice="Name it or remove it.")
        if not _holds_words(table.columns[j][:LOOKED_AT]):
            continue
        if plain(table.names[j]) in ASSET_NAMES:
            findings.error(
                "holds names of assets, but no column is called price or close",
                column=table.names[j],
                advice="Name the column of prices 'price'.",
            )
        elif kind(table.names[j]) is None and repeats():  # a volume of 1.2M is no name
            findings.error(
                "holds names, and dates repeat, as in a table with a row for each date and asset",
                column=table.names[j],
                advice="Name the column of assets 'asset' and that of prices 'price'.",
            )


def _holds_words(cells: np.ndarray) -> bool:
    """Whether a column has cells, and none is a number with either decimal mark."""
    if cells.dtype.kind == "f":
        return False
    known = [cell for cell in cells.tolist() if not is_missing(cell)]
    words = bool(known) and all(isinstance(cell, str) for cell in known)
    return words and not has_numbers(known)
