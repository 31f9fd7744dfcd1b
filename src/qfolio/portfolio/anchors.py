"""Anchors: weights at each row of a table that a policy may depart from.

An anchor is a baseline, followed on the whole table, or a column of the table with a benchmark's
weights, or the mean of several, joined by +. The benchmark of tracking error may also be a single
asset.
"""

import warnings

import numpy as np

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError
from qfolio.core.registry import exists
from qfolio.portfolio.backtest.baselines import History, baseline
from qfolio.portfolio.backtest.baselines.equal_weight import EqualWeight
from qfolio.portfolio.backtest.orders import checked
from qfolio.portfolio.costs import drift
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.signals import COLUMN

MONTHS = 60
"""Months of prices up to a decision that a baseline estimates from."""


def baselines(anchor: str) -> list[str]:
    """The baselines that an anchor names; none without an anchor."""
    named = _names(anchor) if anchor else []
    return [name for name in named if not name.startswith(COLUMN)]


def path(anchor: str, prices: Prices, buyable: Bools | None = None) -> Floats:
    """The weights of an anchor at each row, of shape (row, asset); the rest is cash.

    buyable: the assets among which a baseline may divide the wealth, of shape (asset,), as a
    mandate allows (default: all). Columns and single assets are taken as they are.

    The weights at a row depend on no later price. A baseline decides every month, or at every row
    if that is its calendar; between decisions its holding drifts, unless its target is to be held
    at every row (the calendar "fold"). It may hold the assets that have had prices for a year;
    until there are any, all that have a price. Where assets also leave the table, one that does
    not estimate holds an asset from its first price on.

    Raises QfolioError if there is no such baseline or column, if a baseline gives invalid weights,
    or if a column's weights are not at least 0, with a sum of at most 1.
    """
    if anchor in prices.assets:
        return np.where(np.isnan(prices.known), 0.0, np.array(prices.assets) == anchor)
    each = [
        _column(name.removeprefix(COLUMN), prices)
        if name.startswith(COLUMN)
        else _followed(name, prices, buyable)
        for name in _names(anchor)
    ]
    return np.asarray(np.mean(each, axis=0))


def _names(anchor: str) -> list[str]:
    """What an anchor is the mean of. A column that comes first may have a + in its name.

    Raises QfolioError for a module that does not exist.
    """
    if anchor.startswith(COLUMN):
        return [anchor]
    names = anchor.split("+")
    for name in names:
        module, colon, _ = name.partition(":")
        package = module.partition(".")[0]  # which is found without running its code
        if colon and not name.startswith(COLUMN) and not exists(package):
            raise QfolioError(
                f"there is no anchor {name!r}, because there is no module {package}; name a "
                "baseline, such as equal-weight, your own as module:Name, or a column of weights "
                f"as {COLUMN}NAME."
            )
    return names


def _followed(name: str, prices: Prices, buyable: Bools | None) -> Floats:
    """The weights of a baseline at each row."""
    chosen = baseline(name)
    month, values = prices.month, prices.values
    # A target that is held at every row is decided again at each one if assets come and go.
    anew = prices.tradable is not None and chosen.calendar == "fold"
    held = np.eye(values.shape[1] + 1)[0]
    rows = np.empty(values.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a table's first rows are too few for any estimate
        for row in range(len(values)):
            # Two rows are too few for a baseline, which in a backtest has a whole training window.
            if row % month == 0 or row == 2 or chosen.calendar == "row" or anew:
                rule = chosen if row >= 2 else EqualWeight()
                history = _history(prices, row, month, rule.estimates, buyable)
                nothing = np.eye(len(held))[0]
                wanted = rule.decide(history, held) if history.tradable.any() else nothing
                held = held if wanted is None else checked(name, wanted, history)
            rows[row] = held[1:]
            if row + 1 < len(values) and chosen.calendar != "fold":
                held = drift(held, np.nan_to_num(values[row + 1] / values[row], nan=1.0))
    return rows


def _history(
    prices: Prices, row: int, month: int, estimates: bool, buyable: Bools | None
) -> History:
    """What a baseline knows at a row: five years of prices, or one if any asset starts later."""
    known = ~np.isnan(prices.values[: row + 1])
    tradable = known[max(0, row - 12 * month) :].all(0)
    if not tradable.any():
        tradable = known[row]
    if prices.tradable is not None:
        tradable = prices.tradable[row] & (tradable | (not estimates))
    if buyable is not None:
        tradable = tradable & buyable
    first = max(0, row - MONTHS * month)
    if not known[first:, tradable].all():
        first = max(0, row - 12 * month)
    past = slice(0, row + 1)
    train = slice(first, row + 1)
    return History(prices.dates[past], prices.values[past], train, tradable, 1.0, month)


def _column(name: str, prices: Prices) -> Floats:
    if name not in prices.feature_names:
        raise QfolioError(
            f"{COLUMN}{name} names a column of weights, but the table has no column {name}; give "
            "it with --features, with a weight for each asset and date."
        )
    column = prices.features[..., prices.feature_names.index(name)]
    # A delisted asset keeps its last number.
    weights = np.nan_to_num(np.where(np.isnan(prices.known), 0.0, column))
    if weights.min() < 0 or weights.sum(-1).max() > 1 + 1e-6:
        raise QfolioError(
            f"The weights in the column {name} must be at least 0 and add up to at most 1 at each "
            "date; write them as fractions, one for each asset."
        )
    return weights
