"""Whether the history in a price table is the one that a backtest has seen.

Returns are compared, since adjusted prices change with every dividend: a whole history is then
scaled, and its returns stay as they were.
"""

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import figure
from qfolio.portfolio.prices.findings import LISTED, Finding, Findings, day, first_of
from qfolio.portfolio.prices.table import Prices

REVISED = 0.05
"""How far log returns may differ: an adjustment for a dividend, new or left out, is smaller."""

UNLIKE = 0.25
"""How far half of them may, as a share of the usual return: between two assets of a correlation of
0.95, half of them differ by 0.3."""

ENOUGH = 20
"""Returns from which on an asset may be said to be another one."""

PLACES = 8
"""The most decimal places that prices are rounded to."""


def revisions(known: Prices, table: Prices) -> list[Finding]:
    """A warning for each asset of which a table has other returns than the backtest's.

    What the rounding of prices explains is no difference.

    Args:
        known: The backtest's table.
        table: Another one, with the same assets in the same order.

    Raises:
        QfolioError: An asset differs at most rows, so that it must be another one.
    """
    dates, *rows = np.intersect1d(known.dates, table.dates, return_indices=True)
    if len(dates) < 2:
        return []
    values = [each.known[at] for each, at in zip((known, table), rows, strict=True)]
    before, now = (np.diff(np.log(each), axis=0) for each in values)
    off = abs(now - before) - sum(map(_rounding, values))  # NaN where an asset has no price
    others = [name for j, name in enumerate(known.assets) if _another(before[:, j], off[:, j])]
    if others:
        raise QfolioError(
            f"The price table has other returns than the backtest's for {first_of(others)}, on "
            "most of the dates that are in both; give each asset its own column and each row its "
            "own date, or start a new backtest."
        )
    found = Findings()
    revised = np.flatnonzero((off > REVISED).any(axis=0)).tolist()
    for j in revised[:LISTED]:
        i, *later = np.flatnonzero(off[:, j] > REVISED).tolist()
        here, there = (figure(np.expm1(returns[i, j]), "+.1%") for returns in (now, before))
        found.warn(
            f"the return is {here}, and {there} in the backtest's table"
            + f" (the first of {1 + len(later):,} that differ)" * bool(later),
            column=known.assets[j],
            date=day(dates[i + 1]),
            advice="Correct the table that is wrong; if it is the backtest's, start a new one.",
        )
    found.others("warning", len(revised), "asset", " with other returns than the backtest's")
    return found


def _another(before: np.ndarray, off: np.ndarray) -> bool:
    """Whether most of an asset's returns are off by much, compared with their usual size."""
    both = ~np.isnan(off)
    if both.sum() < ENOUGH:
        return False
    return bool(np.median(off[both]) > UNLIKE * np.median(abs(before[both])))


def _rounding(values: np.ndarray) -> np.ndarray:
    """How far rounding puts log returns off at most, of shape (rows − 1, assets)."""
    steps = np.zeros(values.shape[1])
    for j, prices in enumerate(values.T):
        for places in range(PLACES + 1):
            if np.allclose(prices, prices.round(places), rtol=1e-7, atol=0, equal_nan=True):
                steps[j] = 10.0**-places
                break
    off = steps / 2 / values
    return np.asarray(off[1:] + off[:-1])
