"""From a table's columns to a grid of dates and assets, wide or long."""

from typing import Any

import numpy as np

from qfolio.portfolio.prices import reading as tables
from qfolio.portfolio.prices.findings import LISTED, Block, Findings, Grid, day, hint
from qfolio.portfolio.prices.reading import Table, quote

DATE_NAMES = ("date", "datetime", "timestamp", "time")
ASSET_NAMES = ("asset", "ticker", "symbol", "name")
ADJUSTED_NAMES = ("adjusted close", "adj close", "adjclose", "adjusted price", "adj price")
PRICE_NAMES = ("close", "price", "value")
MOST_CELLS, SPARSEST = 100_000_000, 0.05  # a long table that would be this large and this empty


def text_columns(names: tuple[str, ...], date: str | None) -> set[int]:
    """Columns of a text file that hold dates or names, though they may look like numbers."""
    known = DATE_NAMES + ASSET_NAMES
    return {0, *(j for j, name in enumerate(names) if _plain(name) in known or name == date)}


def _plain(name: str) -> str:
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


# From columns to a grid of dates and assets.


def arrange(
    table: Table, features: tuple[str, ...], date: str | None, findings: Findings
) -> Grid | None:
    columns = _check_names(table, features, date, findings)
    if findings.bad:
        return None
    names = table.names
    when = _date_column(table, columns, date)
    if when is None:
        findings.error(
            "there is no column of dates",
            advice="Name it 'date', or say which column it is (date=…).",
        )
        return None
    counted = (j for j in columns if j != when and _counts_rows(table, j))
    columns = [j for j in columns if j not in {when, *counted}]
    channels = [columns[[names[j] for j in columns].index(name)] for name in features]
    others = [j for j in columns if j not in channels]
    moments, complaints = tables.dates(table.columns[when])
    asset, price = _long_columns(table, others, moments, findings)
    if findings.bad:
        return None
    if price is None or asset is None:
        _check_wide(table, others, findings)
        return None if findings.bad else _wide(
            table, when, moments, complaints, others, channels, findings
        )  # fmt: skip
    return _long(table, when, moments, complaints, asset, price, channels, findings)


def _check_names(
    table: Table, features: tuple[str, ...], date: str | None, findings: Findings
) -> list[int]:
    """The columns that count: all but those without name and content."""
    names = table.names
    columns = [j for j, name in enumerate(names) if name or not _is_blank(table.columns[j])]
    places: dict[str, list[int]] = {}
    for j in columns:
        places.setdefault(names[j], []).append(j)
    for name, where in places.items():
        if len(where) > 1:
            numbers = " and ".join(str(j + 1) for j in where[:LISTED])
            more = " and others" if len(where) > LISTED else ""
            findings.error(
                f"the columns {numbers}{more} have the same name", column=name,
                advice="Give every column a name of its own.",
            )  # fmt: skip
    if table.first_row and not findings.bad and tables.readable_date(names[0]):
        findings.error(
            "the first line holds values instead of column names", row=table.first_row - 1,
            advice="Put a line of names on top, such as date,AAPL,MSFT.",
        )  # fmt: skip
    for name in dict.fromkeys((*features, *([] if date is None else [date]))):
        if name not in places:
            findings.error(f"there is no column {quote(name)}{hint(name, names)}")
    if len(set(features)) < len(features) or date in features:
        findings.error("a column is named twice among the features and the dates")
    return columns


def _is_blank(cells: np.ndarray) -> bool:
    if cells.dtype.kind == "f":
        return bool(np.isnan(cells).all())
    return cells.dtype.kind != "M" and all(map(tables.is_missing, cells.tolist()))


def _counts_rows(table: Table, j: int) -> bool:
    """True for the row numbers that many programs write as a column of their own."""
    if table.names[j] not in ("", "Unnamed: 0", "index", "__index_level_0__"):
        return False
    values, _ = tables.numbers(table.columns[j])
    return bool(np.array_equal(values, np.arange(len(values))))


def _date_column(table: Table, columns: list[int], date: str | None) -> int | None:
    if date is not None:
        return table.names.index(date)
    for name in (*DATE_NAMES, "index level 0"):  # the latter is written by pandas to Parquet
        for j in columns:
            if _plain(table.names[j]) == name:
                return j
    if not columns or _plain(table.names[columns[0]]) in ASSET_NAMES:
        return None
    cells = table.columns[columns[0]][:1000]
    moments, _ = tables.dates(cells)
    likely = (~np.isnat(moments)).any() or tables.numbers(cells)[1].any()
    return columns[0] if likely else None


def _long_columns(
    table: Table, columns: list[int], moments: np.ndarray, findings: Findings
) -> tuple[int | None, int | None]:
    """The columns of assets and of prices in a long table; (None, None) in a wide one.

    NAME and VALUE may be two assets of a wide table: it is long where the assets are not numbers,
    or where dates repeat.
    """
    plain = {j: _plain(table.names[j]) for j in columns}
    assets = [j for j in columns if plain[j] in ASSET_NAMES]
    prices = [j for j in columns if plain[j] in ADJUSTED_NAMES] or [
        j for j in columns if plain[j] in PRICE_NAMES
    ]
    if not assets or not prices:
        return None, None
    texts = [j for j in assets if tables.numbers(table.columns[j][:1000])[1].any()]
    known = moments[~np.isnat(moments)]
    if not texts and len(np.unique(known)) == len(known):
        return None, None
    for kind, found in (("assets", texts or assets), ("prices", prices)):
        if len(found) > 1:
            listed = " and ".join(quote(table.names[j]) for j in found)
            findings.error(f"the columns {listed} could all be the {kind}", advice="Keep one.")
    return (texts or assets)[0], prices[0]


def _check_wide(table: Table, columns: list[int], findings: Findings) -> None:
    plain = {_plain(table.names[j]): table.names[j] for j in columns}
    if {"open", "high", "low", "close"} <= plain.keys():
        findings.error(
            "these are open, high, low and close of one asset, not prices of several",
            advice="Give one column for each asset, or one table with a column 'ticker'.",
        )
        return
    for j in columns:
        if not table.names[j]:
            findings.error(f"column {j + 1} has no name", advice="Name it or remove it.")
    for name in ASSET_NAMES:
        if name in plain:
            cells = table.columns[table.names.index(plain[name])][:1000]
            if np.isnan(tables.numbers(cells)[0]).all() and not _is_blank(cells):
                findings.error(
                    "holds names of assets, but no column is called price or close",
                    column=plain[name], advice="Name the column of prices 'price'.",
                )  # fmt: skip


def _read_numbers(table: Table, columns: list[int], keep: Any) -> tuple[np.ndarray, np.ndarray]:
    """The columns' numbers and wrong cells, each of shape (rows, columns)."""
    count = int(np.count_nonzero(keep))
    values, wrong = np.empty((count, len(columns))), np.empty((count, len(columns)), dtype=bool)
    for k, j in enumerate(columns):
        values[:, k], wrong[:, k] = tables.numbers(table.columns[j][keep], table.decimal)
    return values, wrong


def _wide(
    table: Table, when: int, moments: np.ndarray, complaints: dict[int, str], assets: list[int],
    channels: list[int], findings: Findings,
) -> Grid | None:  # fmt: skip
    everything = np.ones(len(moments), dtype=bool)
    values, wrong = _read_numbers(table, assets + channels, everything)
    undated = np.array([complaints.get(i) == tables.NO_DATE for i in range(len(moments))], bool)
    keep = ~(undated & np.isnan(values).all(axis=1) & ~wrong.any(axis=1))  # not: blank lines
    lines = np.flatnonzero(keep)
    values, wrong, moments = values[keep], wrong[keep], moments[keep]
    column = table.names[when]
    kept = {line: said for line, said in complaints.items() if keep[line]}
    findings.rows(table, column, kept, "Write dates as 2020-01-31.")
    _check_order(table, column, moments, lines, findings)
    count = len(assets)
    blocks = [
        Block(values[:, part], wrong[:, part], tuple((assets + channels)[part]), name)
        for part, name in [(slice(0, count), "price")]
        + [(slice(count + k, count + k + 1), "feature") for k in range(len(channels))]
    ]
    return Grid(
        table, False, moments, tuple(table.names[j] for j in assets),
        np.broadcast_to(lines[:, None], (len(lines), max(count, 1))), blocks[0], tuple(blocks[1:]),
    )  # fmt: skip


def _check_order(
    table: Table, column: str, moments: np.ndarray, lines: np.ndarray, findings: Findings
) -> None:
    known = np.flatnonzero(~np.isnat(moments))
    steps = np.diff(moments[known]).astype(np.int64)
    if (steps > 0).all():
        return
    if len(steps) > 1 and (steps < 0).all():
        findings.error(
            "the newest row comes first", column=column,
            advice="Sort the rows so that the oldest comes first.",
        )  # fmt: skip
        return
    first: dict[Any, int] = {}
    repeated, unsorted = {}, {}
    for k in known.tolist():
        before = first.setdefault(moments[k], k)
        if before != k:
            row = table.first_row + int(lines[before])
            repeated[int(lines[k])] = f"the date {day(moments[k])} stands in row {row} already"
    for k in known[1:][steps < 0].tolist():
        if int(lines[k]) not in repeated:
            unsorted[int(lines[k])] = f"the date {day(moments[k])} comes after a later one"
    findings.rows(table, column, repeated, "Remove one of the two rows.")
    findings.rows(table, column, unsorted, "Sort the rows so that the oldest comes first.")


def _label(cell: Any) -> str:
    """An asset's name; text stays as it is, for NA and NULL are names of assets, too."""
    if isinstance(cell, str):
        return cell.strip()
    if tables.is_missing(cell):
        return ""
    return f"{cell:.0f}" if isinstance(cell, float) and cell.is_integer() else str(cell)


def _long(
    table: Table, when: int, moments: np.ndarray, complaints: dict[int, str], asset: int,
    price: int, channels: list[int], findings: Findings,
) -> Grid | None:  # fmt: skip
    import pandas as pd

    labels = np.array([_label(cell) for cell in table.columns[asset].tolist()], dtype=object)
    nameless = labels == ""
    undated = np.array([complaints.get(i) == tables.NO_DATE for i in range(len(moments))], bool)
    values, wrong = _read_numbers(table, [price, *channels], np.ones(len(labels), dtype=bool))
    blank = nameless & undated & np.isnan(values).all(axis=1) & ~wrong.any(axis=1)
    complaints = {line: said for line, said in complaints.items() if not blank[line]}
    findings.rows(table, table.names[when], complaints, "Write dates as 2020-01-31.")
    unnamed = {int(i): "the asset has no name" for i in np.flatnonzero(nameless & ~blank)}
    findings.rows(table, table.names[asset], unnamed, "Name the asset in every row.")

    lines = np.flatnonzero(~nameless & ~np.isnat(moments))
    days, i = np.unique(moments[lines], return_inverse=True)
    j, names = pd.factorize(labels[lines])  # assets in order of appearance
    size = len(days) * len(names)
    if size > MOST_CELLS and len(lines) < SPARSEST * size:
        findings.error(
            f"{len(names):,} assets on {len(days):,} dates have {len(lines):,} prices only, "
            "so that nearly all are missing",
            advice="Check the columns of dates and assets, or keep the assets that matter.",
        )
        return None
    place = i * len(names) + j
    _, first, back = np.unique(place, return_index=True, return_inverse=True)
    repeated = {
        int(lines[k]): f"{quote(names[j[k]])} on {day(days[i[k]])} stands in row "
        f"{table.first_row + int(lines[first[back[k]]])} already"
        for k in np.flatnonzero(first[back] != np.arange(len(place))).tolist()
    }
    findings.rows(table, table.names[asset], repeated, "Remove one of the two rows.")

    def pivot(column: np.ndarray, empty: Any) -> np.ndarray:
        grid = np.full(size, empty, dtype=column.dtype)
        grid[place[::-1]] = column[::-1]  # the first of repeated rows stands
        return grid.reshape(len(days), len(names))

    blocks = [
        Block(pivot(values[lines, k], np.nan), pivot(wrong[lines, k], False), (c,) * len(names), n)
        for k, (c, n) in enumerate([(price, "price")] + [(c, "feature") for c in channels])
    ]
    where = pivot(lines, -1)
    return Grid(table, True, days, tuple(names), where, blocks[0], tuple(blocks[1:]))
