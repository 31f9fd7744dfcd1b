"""A table's cells by date and asset, for wide and long tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qfolio.core.text import amount, listed, quote
from qfolio.portfolio.prices.cells import currencies, label, numbers
from qfolio.portfolio.prices.columns import Columns, Feature
from qfolio.portfolio.prices.dates import NO_DATE, read_dates, with_times
from qfolio.portfolio.prices.findings import LISTED, Findings, day
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.vocabulary import plain

MOST_CELLS, SPARSEST = 100_000_000, 0.05  # a long table that would be this large and this empty
WRITE_DATES = "Write dates as 2020-01-31, with a year of four digits."
ONE_CURRENCY = "Convert all prices to one currency."


@dataclass(frozen=True)
class Block:
    """One kind of number, prices or a feature, by date and asset (or by date alone)."""

    values: np.ndarray  # (rows, assets or 1), NaN where missing or wrong
    wrong: np.ndarray  # of the same shape: cells with content that is not a number
    columns: tuple[int, ...]  # the table's column of each column here
    name: str  # "price" or "feature"
    by_asset: bool  # False for a feature of the whole market


@dataclass(frozen=True)
class Grid:
    """The table's cells by date and asset, before anything is dropped or filled."""

    table: Table
    long: bool
    dates: np.ndarray  # (rows,)
    assets: tuple[str, ...]
    lines: np.ndarray  # (rows, assets): the row of the table; -1 where a long table has none
    prices: Block
    features: tuple[Block, ...]

    def spot(self, block: Block, i: int, j: int) -> dict[str, Any]:
        """Row, column and date of a cell, for a finding."""
        line = int(self.lines[i, j])
        spot = self.table.spot(line, block.columns[j])
        if line < 0:
            spot["row"] = None
        return {**spot, "date": None if np.isnat(self.dates[i]) else day(self.dates[i])}

    def subject(self, block: Block, j: int) -> str:
        """The subject of a finding: the price, or in a long table the price of an asset."""
        return f"the {block.name}" + (f" of {quote(self.assets[j])}" if self.long else "")


def report_cells(
    grid: Grid,
    block: Block,
    mask: np.ndarray,
    what: str | Callable[[int, int], str],
    advice: str,
    findings: Findings,
) -> None:
    """An error for each cell of the mask; ``what`` is the message, or gives it by row and asset."""
    spots = np.argwhere(mask)
    for i, j in spots[:LISTED].tolist():
        said = f" {what}" if isinstance(what, str) else f": {what(i, j)}"
        findings.error(grid.subject(block, j) + said, **grid.spot(block, i, j), advice=advice)
    kind = what if isinstance(what, str) else "is not a number"
    more = f": the {block.name} {kind}"
    findings.others("error", len(spots), block.name, more, advice=advice)


def check_currencies(tables: Sequence[tuple[Table, Sequence[int]]], findings: Findings) -> None:
    """Reports currencies that differ; each table comes with the numbers of its price columns."""
    signs = set[str]().union(*(currencies(t.columns[j]) for t, prices in tables for j in prices))
    if len(signs) > 1:
        findings.error(
            f"prices are in several currencies: {' and '.join(sorted(signs))}",
            advice=ONE_CURRENCY,
        )
    said = [
        (name, table.columns[j])
        for table, _ in tables
        for j, name in enumerate(table.names)
        if plain(name) == "currency"
    ]
    codes = sorted({label(cell) for _, cells in said for cell in cells} - {""})
    if len(codes) > 1:
        findings.warn(
            f"there are several currencies: {listed(codes[:LISTED])}",
            column=said[0][0],
            advice=ONE_CURRENCY,
        )


def arrange(
    table: Table, columns: Columns, findings: Findings, *, percent: bool = False
) -> Grid | None:
    """The grid of a table, whose numbers may be percentages; None if it would be far too large."""
    prices = columns.prices
    if table.left_out:
        findings.note(table.left_out)
    check_currencies([(table, prices)], findings)
    cells = table.columns[columns.date]
    if columns.time is not None:
        cells = with_times(cells, table.columns[columns.time])
    moments, complaints, unit = read_dates(cells, by_day=True)
    if unit:
        findings.note(f"dates are read as {unit.name}", column=table.names[columns.date])
    used = [*prices, *(j for feature in columns.features for j in feature.columns)]
    values, wrong = _read_numbers(table, used, percent)
    undated = np.array([complaints.get(i) == NO_DATE for i in range(len(moments))], dtype=bool)
    blank = undated & np.isnan(values).all(axis=1) & ~wrong.any(axis=1)
    form = _wide if columns.asset is None else _long
    return form(table, columns, moments, complaints, values, wrong, blank, findings)


def _read_numbers(
    table: Table, columns: Sequence[int], percent: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The columns' numbers and wrong cells, each of shape (rows, columns)."""
    count = len(table.columns[0])
    values, wrong = np.empty((count, len(columns))), np.empty((count, len(columns)), dtype=bool)
    for k, j in enumerate(columns):
        values[:, k], wrong[:, k] = numbers(table.columns[j], table.decimal, percent=percent)
    return values, wrong


def _wide(
    table: Table, columns: Columns, moments: np.ndarray, complaints: dict[int, str],
    values: np.ndarray, wrong: np.ndarray, blank: np.ndarray, findings: Findings,
) -> Grid:  # fmt: skip
    empty = _empty_rows(moments, values, wrong, findings)
    lines = np.flatnonzero(~blank & ~empty)
    complaints = {line: said for line, said in complaints.items() if not blank[line]}
    findings.rows(complaints, lambda line: table.spot(line, columns.date), WRITE_DATES)
    lines = _in_order(table, columns.date, moments, lines, findings)
    values, wrong, moments = values[lines], wrong[lines], moments[lines]
    blocks: list[Block] = []
    start = 0
    for feature in (Feature(columns.prices, True), *columns.features):
        part = slice(start, start + len(feature.columns))
        kind = "feature" if blocks else "price"
        block = Block(values[:, part], wrong[:, part], feature.columns, kind, by_asset=True)
        blocks.append(block if feature.by_asset else _shared(table, block, moments, findings))
        start = part.stop
    rows = np.broadcast_to(lines[:, None], (len(lines), max(len(columns.assets), 1)))
    return Grid(table, False, moments, columns.assets, rows, blocks[0], tuple(blocks[1:]))


def _shared(table: Table, block: Block, dates: np.ndarray, findings: Findings) -> Block:
    """A block of numbers that all assets have in common, which some rows may lack of some."""
    values = np.fmax.reduce(block.values, axis=1, keepdims=True)
    differs = ((block.values != values) & ~np.isnan(block.values)).any(axis=1)
    if differs.any():
        findings.error(
            "has several numbers on one date", column=table.names[block.columns[0]],
            date=day(dates[int(differs.argmax())]),
            advice="Give one for all assets, or name the column as a feature.",
        )  # fmt: skip
    wrong = np.asarray(block.wrong.any(axis=1, keepdims=True))
    return Block(values, wrong, block.columns[:1], block.name, by_asset=False)


def _empty_rows(
    moments: np.ndarray, values: np.ndarray, wrong: np.ndarray, findings: Findings
) -> np.ndarray:
    """Dates without any number after the first with one, such as holidays, of shape (rows,).

    A column alone has gaps instead.
    """
    filled = ~np.isnan(values) | wrong
    dated, some = ~np.isnat(moments), filled.any(axis=1)
    if filled.any(axis=0).sum() < 2 or not (dated & some).any():
        return np.zeros_like(some)
    empty = dated & ~some & (moments > moments[dated & some].min())
    if count := int(empty.sum()):
        first, last = day(moments[empty].min()), day(moments[empty].max())
        when = "" if count == 1 else f", from {first} to this date"
        findings.warn(f"left out: {amount(count, 'row')} without any number{when}", date=last)
    return empty


def _in_order(
    table: Table, date: int, moments: np.ndarray, lines: np.ndarray, findings: Findings
) -> np.ndarray:
    """The rows, reversed if the newest comes first; reports errors if they are not in order."""

    def spot(line: int) -> dict[str, Any]:
        return table.spot(line, date)

    name, one = table.names[date], "column" if table.turned else "row"
    known = lines[~np.isnat(moments[lines])]
    steps = np.diff(moments[known]).astype(np.int64)
    if (steps > 0).all():
        return lines
    if len(steps) > 1 and (steps <= 0).all() and (steps < 0).any():
        said = f"the newest {one} comes first; the {one}s are read in reverse order"
        findings.note(said, column=name)
        lines, known, steps = lines[::-1], known[::-1], -steps[::-1]
    first: dict[Any, int] = {}
    repeated, unsorted = {}, {}
    for line in known.tolist():
        before = first.setdefault(moments[line], line)
        if before != line:
            where = quote(spot(before)["column"]) if table.turned else spot(before)["row"]
            repeated[line] = f"the date {day(moments[line])} is already in {one} {where}"
    for line in known[1:][steps < 0].tolist():
        if line not in repeated:
            unsorted[line] = f"the date {day(moments[line])} comes after a later one"
    set_back = any(moments[line] != moments[line].astype("M8[D]") for line in repeated)
    utc = ", or write times in UTC if the clocks were set back" if set_back else ""
    findings.rows(repeated, spot, f"Remove one of the two {one}s{utc}.")
    findings.rows(unsorted, spot, f"Sort the {one}s, oldest first.")
    return lines


def _long(
    table: Table, columns: Columns, moments: np.ndarray, complaints: dict[int, str],
    values: np.ndarray, wrong: np.ndarray, blank: np.ndarray, findings: Findings,
) -> Grid | None:  # fmt: skip
    import pandas as pd

    asset = columns.asset
    assert asset is not None

    def spot(line: int) -> dict[str, Any]:
        return table.spot(line, asset)

    labels = np.array([label(c) for c in table.columns[asset].tolist()], dtype=object)
    nameless = labels == ""
    blank = blank & nameless
    complaints = {line: said for line, said in complaints.items() if not blank[line]}
    findings.rows(complaints, lambda line: table.spot(line, columns.date), WRITE_DATES)
    unnamed = {int(i): "the asset has no name" for i in np.flatnonzero(nameless & ~blank)}
    findings.rows(unnamed, spot, "Name the asset in every row.")

    lines = np.flatnonzero(~nameless & ~np.isnat(moments))
    days, i = np.unique(moments[lines], return_inverse=True)
    j, assets = pd.factorize(labels[lines])  # in order of appearance
    size = len(days) * len(assets)
    if size > MOST_CELLS and len(lines) < SPARSEST * size:
        findings.error(
            f"{len(assets):,} assets on {len(days):,} dates have only {len(lines):,} prices, "
            "so that nearly all are missing",
            advice="Check the columns of dates and assets, or keep the assets that matter.",
        )
        return None
    place = i * len(assets) + j
    _, first, back = np.unique(place, return_index=True, return_inverse=True)
    repeated = {
        int(lines[k]): f"{quote(assets[j[k]])} on {day(days[i[k]])} is already in row "
        f"{spot(int(lines[first[back[k]]]))['row']}"
        for k in np.flatnonzero(first[back] != np.arange(len(place))).tolist()
    }
    findings.rows(repeated, spot, "Remove one of the two rows.")

    def pivot(column: np.ndarray, empty: Any) -> np.ndarray:
        grid = np.full(size, empty, dtype=column.dtype)
        grid[place[::-1]] = column[::-1]  # the first of repeated rows is kept
        return grid.reshape(len(days), len(assets))

    blocks: list[Block] = []
    for k, feature in enumerate((Feature(columns.prices, True), *columns.features)):
        cells, faults = pivot(values[lines, k], np.nan), pivot(wrong[lines, k], False)
        kind, own = "feature" if blocks else "price", feature.columns * len(assets)
        block = Block(cells, faults, own, kind, by_asset=True)
        blocks.append(block if feature.by_asset else _shared(table, block, days, findings))
    where = pivot(lines, -1)
    return Grid(table, True, days, tuple(assets), where, blocks[0], tuple(blocks[1:]))
