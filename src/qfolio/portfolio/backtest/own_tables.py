"""Reads strategies of the user's own from files, data frames and arrays.

The columns say what a table holds: target weights (a column per asset, and perhaps one for cash; or
the columns date, asset and weight), orders in shares, returns, or the levels of an index.
"""

from typing import Any

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.core.text import hint, quote
from qfolio.portfolio.backtest.own import Own, rows_at
from qfolio.portfolio.prices.cells import is_missing, label
from qfolio.portfolio.prices.columns import text_columns
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.reading import read
from qfolio.portfolio.prices.records import date_column, dates_of, in_order, numbers_of
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.prices.vocabulary import (
    ASSET_NAMES,
    RETURN_NAMES,
    SHARES_NAMES,
    is_cash,
    plain,
)

WEIGHT_NAMES = ("weight", "weights", "target", "target weight")

ROUNDING = 1e-3
"""How far the sum of rounded weights may be from 1; they are then scaled to it."""

FORMS = (
    "A strategy is a table of weights (date, and a column per asset), of orders in shares (date, "
    "asset, shares), of returns (date, return) or of an index (date, level)."
)


def read_own(name: str, source: Any, prices: Prices) -> Own:
    """Read a strategy for a backtest on a table of prices.

    Args:
        name: Name of the strategy, for messages.
        source: Path of a CSV or Parquet file; a data frame that narwhals knows; a pandas Series of
            returns or of an index, by date; or an array with a row for each row of the prices:
            weights of shape (rows, N + 1), cash first, or (rows, N), NaN for no order, or returns
            of shape (rows,).
        prices: The table.

    Raises:
        QfolioError: The source cannot be read, its columns fit no such table, weights do not sum to
            1 with cash, or a cell is missing or cannot be read.
    """
    try:
        if isinstance(source, list | tuple) or type(source).__module__.partition(".")[0] in (
            "numpy",
            "jax",
            "jaxlib",
        ):
            return _from_array(source, prices)
        if type(source).__module__.startswith("pandas") and source.ndim == 1:
            # Whatever its name, such as an asset's. Half of all returns are surely below 30%.
            known = source.dropna()
            source = known.to_frame("return" if abs(known).median() < 0.3 else "level")
        return _from_table(source, prices)
    except QfolioError as error:
        raise QfolioError(f"Strategy {quote(name)}: {error}") from None


def _from_array(source: Any, prices: Prices) -> Own:
    try:
        table = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise QfolioError("the array does not hold numbers.") from None
    rows, assets = prices.values.shape
    if table.shape == (rows,):
        known = ~np.isnan(table)
        return Own("returns", prices.dates[known], table[known])
    if table.shape not in ((rows, assets), (rows, assets + 1)):
        raise QfolioError(
            f"the array has the shape {table.shape}; for this table it must be ({rows}, "
            f"{assets + 1}) for weights, cash first, or ({rows},) for returns."
        )
    given = ~np.isnan(table).all(axis=1)
    table, when = table[given], prices.dates[given]
    cash = table[:, 0] if table.shape[1] > assets else None
    return Own("weights", when, _with_cash(table[:, -assets:], cash, [day(d) for d in when]))


def _from_table(source: Any, prices: Prices) -> Own:
    table = read(source, lambda names: text_columns(names, None))
    names = [plain(name) for name in table.names]
    when = date_column(table.names)
    others = [j for j in range(len(names)) if j != when and names[j]]
    if not others:
        raise QfolioError(f"the table has no column besides its dates. {FORMS}")
    asset = next((j for j in others if names[j] in ASSET_NAMES), None)
    shares = next((j for j in others if names[j] in SHARES_NAMES), None)
    if asset is not None and shares is not None:
        return _share_orders(table, when, asset, shares, prices)
    weight = next((j for j in others if names[j] in WEIGHT_NAMES), None)
    if asset is not None and weight is not None:
        return _long_weights(table, when, asset, weight, prices)
    unknown = [table.names[j] for j in others if _asset(table.names[j], prices) is None]
    if not unknown:
        return _wide_weights(table, when, others, prices)
    if len(others) == 1 and names[others[0]] in RETURN_NAMES:
        rows = dates_of(table, when)
        order = in_order(rows, table)
        return Own("returns", rows[order], numbers_of(table, others[0], rows)[order])
    return _levels(source, others, unknown, prices)


def _levels(source: Any, others: list[int], unknown: list[str], prices: Prices) -> Own:
    """An index, read as a table of prices."""
    try:
        index = load(source)
    except QfolioError as error:
        if len(others) == 1:
            raise QfolioError(f"the column {quote(unknown[0])} is not an index: {error}") from None
        index = None
    if index is None or len(index.assets) > 1:
        raise QfolioError(f"{_unknown(unknown[0], prices)}. {FORMS}")
    return Own("levels", index.dates, index.values[:, 0])


def _wide_weights(table: Table, when: int, others: list[int], prices: Prices) -> Own:
    rows = dates_of(table, when)
    weights, cash = np.zeros((len(rows), len(prices.assets))), None
    seen = dict.fromkeys(table.names[j] for j in others)
    if len(seen) < len(others):
        raise QfolioError("two columns have the same name; give every asset one column.")
    blank = np.all([[is_missing(c) for c in table.columns[j].tolist()] for j in others], axis=0)
    for j in others:
        found = numbers_of(table, j, rows, blank)
        if (place := _asset(table.names[j], prices)) == -1:
            cash = found
        elif place is not None:
            weights[:, place] = found
    order = in_order(rows, table)
    order = order[~blank[order]]
    if not order.size:
        raise QfolioError("the table has no row of weights.")
    weights, rows = weights[order], rows[order]
    cash = None if cash is None else cash[order]
    return Own("weights", rows, _with_cash(weights, cash, [day(row) for row in rows]))


def _long_weights(table: Table, when: int, asset: int, weight: int, prices: Prices) -> Own:
    rows = dates_of(table, when)
    found = numbers_of(table, weight, rows)
    moments, place = np.unique(rows, return_inverse=True)
    weights = np.full((len(moments), len(prices.assets) + 1), np.nan)
    for i, cell in enumerate(table.columns[asset].tolist()):
        known = _asset(name := label(cell), prices)
        where = f"row {table.first_row + i} ({day(rows[i])})"
        if known is None:
            raise QfolioError(f"{where}: {_unknown(name, prices)}.")
        if not np.isnan(weights[place[i], known + 1]):
            raise QfolioError(f"{where}: {quote(name)} appears twice; give one weight per date.")
        weights[place[i], known + 1] = found[i]
    named = ~np.isnan(weights[:, 0])
    if named.any() and not named.all():
        moment = day(moments[int((~named).argmax())])
        raise QfolioError(f"{moment} has no weight of cash, but other dates have one; add it.")
    cash = weights[:, 0] if named.any() else None
    held = np.nan_to_num(weights[:, 1:])
    return Own("weights", moments, _with_cash(held, cash, [day(moment) for moment in moments]))


def _share_orders(table: Table, when: int, asset: int, shares: int, prices: Prices) -> Own:
    """Weights at each date with an order, from cash that is paid in and shares that are traded.

    Shares are valued at the close of the row that decides; the effects of costs and of the lag are
    not known yet.
    """
    if prices.levels:
        raise QfolioError("orders in shares need share prices, not returns; give weights.")
    dates = dates_of(table, when)
    traded = numbers_of(table, shares, dates)
    rows, _ = rows_at("It", dates, prices)
    holding, cash, known = np.zeros(len(prices.assets)), 0.0, prices.known
    moments: list[np.datetime64] = []
    weights: list[np.ndarray] = []
    names = [label(cell) for cell in table.columns[asset].tolist()]
    for row in np.unique(rows[rows < len(prices)]).tolist():
        close = prices.values[row]
        gone = np.isnan(known[row]) & ~np.isnan(close)
        cash += float(holding[gone] @ close[gone])  # what delisted assets paid out
        holding[gone] = 0.0
        for i in np.flatnonzero(rows == row).tolist():
            place = _asset(names[i], prices)
            where = f"row {table.first_row + i} ({day(dates[i])})"
            if place is None:
                raise QfolioError(f"{where}: {_unknown(names[i], prices)}.")
            if place == -1:
                if moments:
                    raise QfolioError(
                        f"{where}: cash is paid in after the first order; give all of it at the "
                        "date of that order."
                    )
                cash += traded[i]
                continue
            if gone[place] or np.isnan(close[place]):
                why = "any more, and was paid out" if gone[place] else "yet"
                raise QfolioError(f"{where}: {names[i]} has no price {why}.")
            holding[place] += traded[i]
            cash -= traded[i] * close[place]
        values = np.append(cash, holding * np.nan_to_num(close))
        if not values.sum() > 0:
            raise QfolioError(
                f"its holding on {day(prices.dates[row])} is worth {values.sum():,.2f}; give the "
                "money that it begins with as shares of cash, in a row of the first date."
            )
        moments.append(prices.dates[row])
        weights.append(values / values.sum())
    if not moments:
        raise QfolioError("no order is within the dates of the prices.")
    return Own("weights", np.array(moments), np.array(weights))


def _asset(name: str, prices: Prices) -> int | None:
    """The index of an asset, −1 for cash, None if it is unknown."""
    if name in prices.assets:
        return prices.assets.index(name)
    return -1 if is_cash(name) else None


def _unknown(name: str, prices: Prices) -> str:
    return f"the prices have no asset {quote(name)}{hint(name, prices.assets)}"


def _with_cash(weights: Floats, cash: Floats | None, spelled: list[str]) -> Floats:
    """Weights of shape (k, N) and cash (default: the rest), as (k, N + 1) with sums of 1."""
    total = weights.sum(axis=1)
    rest = 1 - total if cash is None else cash
    if cash is None:
        rest = np.where((rest < 0) & (rest >= -ROUNDING), 0.0, rest)
    table = np.column_stack([rest, weights])
    sums = table.sum(axis=1)
    wrong = ~(np.abs(sums - 1) <= ROUNDING)
    if wrong.any():
        row = int(wrong.argmax())
        raise QfolioError(
            f"the weights of {spelled[row]} sum to {sums[row]:.6g}; they are fractions that sum to "
            "1 with cash."
        )
    return np.asarray(np.where(np.abs(sums - 1) > 1e-12, table.T / sums, table.T).T)
