"""What is wrong with a price table, cell by cell, and what is left of it by the user's choices.

A table is first arranged by date and asset, whichever form it has. All checks work on this grid,
and each remembers the row and the column of the table that a cell comes from.
"""

import difflib
from dataclasses import dataclass
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices import reading as tables
from qfolio.portfolio.prices.reading import Table, quote

MISSING = ("error", "drop-asset", "forward-fill")
LATE = ("error", "drop-asset", "trim", "join")

DATE_NAMES = ("date", "datetime", "timestamp", "time")
ASSET_NAMES = ("asset", "ticker", "symbol", "name")
ADJUSTED_NAMES = ("adjusted close", "adj close", "adjclose", "adjusted price", "adj price")
PRICE_NAMES = ("close", "price", "value")

LISTED = 5  # faults of one kind that are named one by one; the rest is counted
FEWEST_ROWS, FEW_ROWS = 3, 60
LEAST_JUMP = 0.3  # in log; the smallest split, 3/2, is 0.41
LARGEST_MOVE = 1e6  # within one row; beyond it relatives and their products leave float32
MOST_CELLS, SPARSEST = 100_000_000, 0.05  # a long table that would be this large and this empty
SPLITS = (1.5, 2, 3, 4, 5, 6, 7, 8, 10, 15, 20, 25, 30, 50, 100, 1000)


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a table, or ``count`` of a kind.

    ``row`` is counted as people see it: in text files from 1, the header included, as spreadsheets
    and editors do; in data frames and Parquet files from 0.
    """

    severity: str  # "error" or "warning"
    message: str
    row: int | None = None
    column: str | None = None
    date: str | None = None
    advice: str = ""
    count: int = 1

    def __str__(self) -> str:
        """Where and what, on one line."""
        row = None if self.row is None else f"row {self.row}"
        date = f"({self.date})" if row and self.date else self.date
        spot = " ".join(part for part in (row, date) if part)
        column = "" if self.column is None else f"column {quote(self.column)}"
        where = ", ".join(part for part in (spot, column) if part)
        return f"{where}: {self.message}" if where else self.message


# The way from cells to prices.


@dataclass(frozen=True)
class _Block:
    """One kind of number, prices or a feature, by date and asset (or by date alone)."""

    values: np.ndarray  # (rows, assets or 1), NaN where missing or wrong
    wrong: np.ndarray  # where something stands that is no number
    columns: tuple[int, ...]  # the table's column that each column here comes from
    name: str  # "price", or "feature"


@dataclass(frozen=True)
class _Grid:
    """The table's cells by date and asset, before anything is dropped or filled."""

    table: Table
    long: bool
    dates: np.ndarray  # (rows,)
    assets: tuple[str, ...]
    lines: np.ndarray  # (rows, assets): the row of the table; -1 where a long table has none
    prices: _Block
    features: tuple[_Block, ...]

    def spot(self, block: _Block, i: int, j: int) -> dict[str, Any]:
        """Where a cell stands, for a finding."""
        line = int(self.lines[i, j])
        return {
            "row": self.table.first_row + line if line >= 0 else None,
            "column": self.table.names[block.columns[j]],
            "date": None if np.isnat(self.dates[i]) else day(self.dates[i]),
        }

    def subject(self, block: _Block, j: int) -> str:
        return f"the {block.name}" + (f" of {quote(self.assets[j])}" if self.long else "")


class _Findings(list[Finding]):
    def error(self, message: str, **rest: Any) -> None:
        self.append(Finding("error", message, **rest))

    def warn(self, message: str, **rest: Any) -> None:
        self.append(Finding("warning", message, **rest))

    def cells(self, grid: _Grid, block: _Block, mask: np.ndarray, what: Any, advice: str) -> None:
        """An error for each cell of the mask; ``what`` is a text or a function of (i, j)."""
        spots = np.argwhere(mask)
        for i, j in spots[:LISTED].tolist():
            said = f": {what(i, j)}" if callable(what) else f" {what}"
            self.error(grid.subject(block, j) + said, **grid.spot(block, i, j), advice=advice)
        if (rest := len(spots) - LISTED) > 0:
            kind = "is no number" if callable(what) else what
            more = amount(rest, f"more {block.name}")
            self.error(f"and {more}: the {block.name} {kind}", advice=advice, count=rest)

    def rows(self, table: Table, column: str, said: dict[int, str], advice: str) -> None:
        """An error for each row of the table in ``said``."""
        for line in list(said)[:LISTED]:
            row = table.first_row + line
            self.error(said[line], row=row, column=column, advice=advice)
        if (rest := len(said) - LISTED) > 0:
            self.error(
                f"and {amount(rest, 'more row')} of this kind",
                column=column,
                advice=advice,
                count=rest,
            )

    @property
    def bad(self) -> bool:
        return any(finding.severity == "error" for finding in self)


def examine(
    table: Table, missing: str, late: str, features: tuple[str, ...], date: str | None
) -> tuple[dict[str, Any], list[Finding]]:
    """What ``Prices`` are made of (nothing where the table has errors), and all findings.

    Raises:
        QfolioError: A choice is not known.
    """
    for name, value, known in (("missing", missing, MISSING), ("late", late, LATE)):
        if value not in known:
            raise QfolioError(f"{name} is {quote(value)}; it must be one of {', '.join(known)}.")
    findings = _Findings()
    grid = _arrange(table, features, date, findings)
    if grid is None:
        return {}, findings
    ordered = not findings.bad
    _check_cells(grid, findings)
    if not ordered or not grid.assets or len(grid.dates) < FEWEST_ROWS:
        return {}, findings
    rest = _complete(grid, missing, late, findings)
    if not len(rest.assets):
        return {}, findings
    _check_moves(grid, rest, findings)
    _check_size(grid, rest, findings)
    if findings.bad:
        return {}, findings
    content = {
        "dates": grid.dates[rest.head :],
        "assets": tuple(grid.assets[j] for j in rest.assets),
        "values": rest.values,
        "features": rest.features,
        "feature_names": features,
    }
    return content, findings


def text_columns(names: tuple[str, ...], date: str | None) -> set[int]:
    """Columns of a text file that hold dates or names, though they may look like numbers."""
    known = DATE_NAMES + ASSET_NAMES
    return {0, *(j for j, name in enumerate(names) if _plain(name) in known or name == date)}


def _plain(name: str) -> str:
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


# From columns to a grid of dates and assets.


def _arrange(
    table: Table, features: tuple[str, ...], date: str | None, findings: _Findings
) -> _Grid | None:
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
    table: Table, features: tuple[str, ...], date: str | None, findings: _Findings
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
    table: Table, columns: list[int], moments: np.ndarray, findings: _Findings
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


def _check_wide(table: Table, columns: list[int], findings: _Findings) -> None:
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
    channels: list[int], findings: _Findings,
) -> _Grid | None:  # fmt: skip
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
        _Block(values[:, part], wrong[:, part], tuple((assets + channels)[part]), name)
        for part, name in [(slice(0, count), "price")]
        + [(slice(count + k, count + k + 1), "feature") for k in range(len(channels))]
    ]
    return _Grid(
        table, False, moments, tuple(table.names[j] for j in assets),
        np.broadcast_to(lines[:, None], (len(lines), max(count, 1))), blocks[0], tuple(blocks[1:]),
    )  # fmt: skip


def _check_order(
    table: Table, column: str, moments: np.ndarray, lines: np.ndarray, findings: _Findings
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
    price: int, channels: list[int], findings: _Findings,
) -> _Grid | None:  # fmt: skip
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
        _Block(pivot(values[lines, k], np.nan), pivot(wrong[lines, k], False), (c,) * len(names), n)
        for k, (c, n) in enumerate([(price, "price")] + [(c, "feature") for c in channels])
    ]
    where = pivot(lines, -1)
    return _Grid(table, True, days, tuple(names), where, blocks[0], tuple(blocks[1:]))


# Checks and choices on the grid.


def _check_cells(grid: _Grid, findings: _Findings) -> None:
    table = grid.table
    if not grid.assets:
        findings.error("there is no asset", advice="Give a column of prices for each asset.")
    for name in grid.assets:
        if name.strip().lower() == "cash":
            findings.error(
                f"the asset {quote(name)} has the name of the money that is not invested",
                advice="Rename or remove its column." if not grid.long else "Rename or remove it.",
            )
    if len(grid.dates) < FEWEST_ROWS:
        findings.error(
            f"the table has {amount(len(grid.dates), 'row')}; at least {FEWEST_ROWS} are needed",
            advice="Give a longer history.",
        )
    advice = "Write numbers as 1234.5, and leave a cell empty where there is none."
    for block in (grid.prices, *grid.features):
        texts = block.wrong.any(axis=0) & (block.wrong | np.isnan(block.values)).all(axis=0)
        texts &= not grid.long
        for j in np.flatnonzero(texts)[:LISTED].tolist():
            said = _complaint(grid, block, int(block.wrong[:, j].argmax()), j)
            findings.error(
                f"there are no numbers: {said}", column=table.names[block.columns[j]],
                advice="Remove the column.",
            )  # fmt: skip
        if (rest := int(texts.sum()) - LISTED) > 0:
            findings.error(f"and {amount(rest, 'more column')} without numbers", count=rest)

        def said_of(i: int, j: int, block: _Block = block) -> str:
            return _complaint(grid, block, i, j)

        findings.cells(grid, block, block.wrong & ~texts, said_of, advice)
        findings.cells(grid, block, np.isinf(block.values), "is infinite", advice)
    values = grid.prices.values
    findings.cells(
        grid, grid.prices, values == 0, "is zero",
        "Leave the cell empty where there was no trade; a worthless asset must be dropped.",
    )  # fmt: skip
    findings.cells(
        grid, grid.prices, np.isfinite(values) & (values < 0), "is negative",
        "Give prices, not returns.",
    )  # fmt: skip


def _complaint(grid: _Grid, block: _Block, i: int, j: int) -> str:
    cell = grid.table.columns[block.columns[j]][int(grid.lines[i, j])]
    return tables.no_number(cell, grid.table.decimal)


@dataclass(frozen=True)
class _Rest:
    """What remains of a grid after the user's choices: rows from ``head`` on, and these assets."""

    head: int
    assets: np.ndarray  # places in the grid
    values: np.ndarray
    features: np.ndarray


def _complete(grid: _Grid, missing: str, late: str, findings: _Findings) -> _Rest:
    """Closes gaps or drops assets as the user chose: first ``missing``, then ``late``."""
    values, names = grid.prices.values, grid.assets
    present = ~np.isnan(values) | grid.prices.wrong
    rows = np.arange(len(values))[:, None]
    begun = np.flatnonzero(present.any(axis=1))
    head = int(begun[0]) if len(begun) else 0
    if head:
        findings.warn(f"left out at the start: {amount(head, 'row')} without prices")
    start = np.where(present.any(axis=0), present.argmax(axis=0), len(values))
    end = np.where(present.any(axis=0), len(values) - present[::-1].argmax(axis=0), 0)
    empty = ~present.any(axis=0)
    gaps = ~present & (rows >= start)
    drop = np.zeros(len(names), dtype=bool)
    # Features start with their asset; those of the market with the table.
    unknown = [np.isnan(b.values) & ~b.wrong & ((rows >= start) if grid.long else (rows >= head))
               for b in grid.features]  # fmt: skip
    filled = [block.values for block in grid.features]

    if missing == "drop-asset":
        drop = empty | gaps.any(axis=0)
        if grid.long:
            for holes in unknown:
                drop |= holes.any(axis=0)
            unknown = [holes & ~drop for holes in unknown]
        _report_dropped(names, drop, "prices are missing", findings)
    else:
        for j in np.flatnonzero(empty)[:LISTED].tolist():
            _of_asset(grid, j, "there are no prices at all", "Remove the asset.", findings)
        if (rest := int(empty.sum()) - LISTED) > 0:
            findings.error(f"and {amount(rest, 'more asset')} without prices", count=rest)
    if missing == "forward-fill":
        if gaps.any():
            _report_filled(grid, gaps, findings)
        values = _fill_forward(values)
        filled = [_fill_forward(channel) for channel in filled]
        unknown = [holes & np.isnan(c) for holes, c in zip(unknown, filled, strict=True)]
    if missing == "error":
        advice = (
            "Fill the cells, or choose what becomes of gaps: missing='forward-fill' or "
            "'drop-asset' (--missing)."
        )
        findings.cells(grid, grid.prices, gaps & (rows < end), "is missing", advice)
        stops = np.flatnonzero((start < end) & (end < len(values)))
        for j in stops[:LISTED].tolist():
            last = day(grid.dates[end[j] - 1])
            _of_asset(grid, j, f"there are no prices after {last}", advice, findings)
        if (rest := len(stops) - LISTED) > 0:
            findings.error(f"and {amount(rest, 'more asset')} whose prices end early", count=rest)
    for block, holes in zip(grid.features, unknown, strict=True):
        findings.cells(
            grid, block, holes, "is missing",
            "Fill the cells, start the table where the features do, or choose "
            "missing='forward-fill' (--missing).",
        )  # fmt: skip

    keep = ~drop & ~empty
    behind = keep & (start > head)
    if behind.any():
        advice = "Choose what becomes of it: late='drop-asset', 'trim' or 'join' (--late)."
        if late == "error":
            for j in np.flatnonzero(behind)[:LISTED].tolist():
                said = f"the first price is that of {day(grid.dates[start[j]])}"
                _of_asset(grid, j, f"{said}, the table's {day(grid.dates[head])}", advice, findings)
            if (rest := int(behind.sum()) - LISTED) > 0:
                findings.error(
                    f"and {amount(rest, 'more asset')} with a late start", advice=advice, count=rest
                )
        elif late == "drop-asset":
            _report_dropped(names, behind, "they start late", findings)
            keep &= ~behind
        elif late == "trim":
            head = int(start[behind].max())
            findings.warn(
                f"the table starts on {day(grid.dates[head])}, with the last asset to start",
            )
        else:
            findings.warn(f"joining later than the first row: {amount(int(behind.sum()), 'asset')}")
    if grid.assets and not keep.any():
        findings.error("no asset is left", advice="Look at the gaps of the table first.")
    shape = (len(values), len(names))
    channels = [np.broadcast_to(channel, shape) for channel in filled]
    features = np.stack(channels, axis=-1) if channels else np.empty((*shape, 0))
    return _Rest(head, np.flatnonzero(keep), values[head:, keep], features[head:, keep])


def _fill_forward(values: np.ndarray) -> np.ndarray:
    rows = np.where(np.isnan(values), 0, np.arange(len(values))[:, None])
    return np.take_along_axis(values, np.maximum.accumulate(rows, axis=0), axis=0)


def _of_asset(grid: _Grid, j: int, said: str, advice: str, findings: _Findings) -> None:
    if grid.long:
        said = f"{quote(grid.assets[j])}: {said}"
    column = grid.table.names[grid.prices.columns[j]]
    findings.error(said, column=column, advice=advice)


def _report_dropped(
    names: tuple[str, ...], drop: np.ndarray, reason: str, findings: _Findings
) -> None:
    if dropped := [quote(names[j]) for j in np.flatnonzero(drop)]:
        more = " and others" if len(dropped) > LISTED else ""
        listed = ", ".join(dropped[:LISTED])
        findings.warn(
            f"left out, because {reason}: {listed}{more} ({amount(len(dropped), 'asset')})"
        )


def _report_filled(grid: _Grid, gaps: np.ndarray, findings: _Findings) -> None:
    """Says how much is filled, and where the longest stretch lies."""
    run = np.zeros(gaps.shape[1], dtype=np.int64)
    longest = np.zeros_like(run)
    for row in gaps:
        run = (run + 1) * row
        longest = np.maximum(longest, run)
    j = int(longest.argmax())
    findings.warn(
        f"filled forward: {amount(int(gaps.sum()), 'missing price')}; "
        f"the longest gap is of {quote(grid.assets[j])}, {amount(int(longest[j]), 'row')}",
    )


def _check_moves(grid: _Grid, rest: _Rest, findings: _Findings) -> None:
    """Moves that no market makes, and moves that look like a split which was not adjusted."""
    values = np.where(np.isfinite(rest.values) & (rest.values > 0), rest.values, np.nan)
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        relatives = values[1:] / values[:-1]
        moves = np.log(relatives)
    sizes = np.abs(moves)

    def spot(i: int, j: int) -> dict[str, Any]:
        return grid.spot(grid.prices, rest.head + i + 1, int(rest.assets[j]))

    wild = np.argwhere(sizes > np.log(LARGEST_MOVE))  # NaN compares false
    for i, j in wild[:LISTED].tolist():
        findings.error(
            f"{grid.subject(grid.prices, int(rest.assets[j]))} goes from {values[i, j]:.6g} to "
            f"{values[i + 1, j]:.6g} in one row",
            advice="Check the units of both prices.", **spot(i, j),
        )  # fmt: skip
    if (more := len(wild) - LISTED) > 0:
        findings.error(f"and {amount(more, 'more price')} that change by such factors", count=more)
    ratios = np.log(np.array(SPLITS))
    splits = []
    for j in np.flatnonzero((sizes > LEAST_JUMP).any(axis=0)).tolist():
        # The usual move: a median is not misled by the jumps that are looked for.
        usual = float(np.median(sizes[:, j][sizes[:, j] > 0])) / 0.6745
        for i in np.flatnonzero(sizes[:, j] > max(LEAST_JUMP, 6 * usual)).tolist():
            distances = np.abs(ratios - sizes[i, j])
            if distances.min() < min(0.1, max(0.02, 2 * usual)):
                splits.append((i, j, _ratio(SPLITS[distances.argmin()], moves[i, j] > 0)))
    for i, j, ratio in sorted(splits)[:LISTED]:
        findings.warn(
            f"{grid.subject(grid.prices, int(rest.assets[j]))} is {relatives[i, j]:.4g} times the "
            f"one before, close to {ratio}: a split that is not adjusted?",
            advice="Use adjusted prices.", **spot(i, j),
        )  # fmt: skip
    if (more := len(splits) - LISTED) > 0:
        findings.warn(
            f"and {amount(more, 'more move')} like splits that are not adjusted", count=more
        )


def _ratio(split: float, up: bool) -> str:
    over, under = (3, 2) if split == 1.5 else (int(split), 1)
    over, under = (over, under) if up else (under, over)
    return str(over) if under == 1 else f"{over}/{under}"


def _check_size(grid: _Grid, rest: _Rest, findings: _Findings) -> None:
    dates = grid.dates[rest.head :]
    if len(dates) < FEWEST_ROWS:
        findings.error(
            f"the table keeps {amount(len(dates), 'row')}; at least {FEWEST_ROWS} are needed",
            advice="Choose another late= (--late), or give a longer history.",
        )
        return
    if len(dates) < FEW_ROWS:
        findings.warn(f"the table has {amount(len(dates), 'row')} only, too few to learn from")
    if len(rest.assets) == 1:
        findings.warn(f"there is one asset only, {quote(grid.assets[rest.assets[0]])}")
    steps, usual = spacing(dates)
    closed = 0.0 if every_day(dates) else 7.0  # markets with weekends have holidays, too
    long = np.flatnonzero(steps > 3 * usual + closed)
    for k in long[:LISTED].tolist():
        findings.warn(
            f"the row before is that of {day(dates[k])}, {steps[k]:.4g} days earlier "
            f"(usual: {usual:.4g})",
            row=None if grid.long else grid.spot(grid.prices, rest.head + int(k) + 1, 0)["row"],
            date=day(dates[k + 1]),
        )
    if (more := len(long) - LISTED) > 0:
        findings.warn(f"and {amount(more, 'more gap')} between dates", count=more)


# Dates and names.


def spacing(dates: np.ndarray) -> tuple[np.ndarray, float]:
    """The days from each of two or more rows to the next, and their (lower) median."""
    steps = np.diff(dates).astype(np.int64) / 86400.0
    return steps, float(np.sort(steps)[(len(steps) - 1) // 2])


def every_day(dates: np.ndarray) -> bool:
    """True where weekends have rows as other days have."""
    weekday = (dates.astype("datetime64[D]").astype(np.int64) + 3) % 7  # 1970-01-01: Thursday
    return float((weekday >= 5).mean()) > 0.1 if len(dates) else False


def day(moment: Any) -> str:
    text = str(np.datetime64(moment, "s"))
    return text.removesuffix("T00:00:00").replace("T", " ")


def amount(count: int, noun: str) -> str:
    """1 row, 2 rows."""
    return f"{count:,} {noun}" + "s" * (count != 1)


def hint(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, [k for k in known if k], n=1)
    return f"; did you mean {quote(close[0])}?" if close else ""
