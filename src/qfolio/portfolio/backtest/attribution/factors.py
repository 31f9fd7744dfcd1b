"""Factors made from the price table itself, and a strategy's exposures to them.

Except for the market, each factor is long one unit of assets and short one unit, with weights that
are known at the close before the return; no factor pays costs. The market is held with borrowed
cash: otherwise the interest of an agent that holds cash would be its alpha. Momentum, reversal and
low volatility weight assets by the rank of a signal. The components are the largest principal
components of returns minus the market's, fitted on the rows that the fold's agents were trained on
(Connor & Korajczyk 1988).
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from qfolio.core.arrays import Bools, Floats
from qfolio.portfolio.backtest.attribution.hac import regress
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.signals import Signal, compute, formulas

COMPONENTS = 2

_DISTINCT = 1e-6
"""Least share of a factor's variance that the factors before it must leave unexplained."""


class Exposure(msgspec.Struct, frozen=True):
    """The slope on a factor, with its t-statistic."""

    name: str
    beta: float
    t: float


class Exposures(msgspec.Struct, frozen=True):
    """A regression of active returns on factors."""

    alpha: float  # annual intercept
    alpha_t: float
    r2: float
    lags: int  # of Newey & West
    factors: list[Exposure]


def exposures(
    active: Floats, factors: dict[str, Floats], periods_per_year: float
) -> Exposures | None:
    """Regress a strategy's active returns on factors; None if there are too few days.

    A factor that is spanned by those before it is left out.

    Args:
        active: Net returns minus those of the reference before its costs, shape (D,): the costs of
            an index that is rebalanced at every row are not the alpha of who trades less.
        factors: Returns of each factor on the same days, by its name.
        periods_per_year: For example 252 for trading days.
    """
    chosen: dict[str, Floats] = {}
    for name, series in factors.items():
        before = np.stack([np.ones(len(series)), *chosen.values()], axis=1)
        own = series - before @ np.linalg.lstsq(before, series, rcond=None)[0]
        if own.var() > max(_DISTINCT * series.var(), 1e-18):
            chosen[name] = series
    if len(active) < 2 * len(chosen) + 10:
        return None
    table = np.stack(list(chosen.values()), 1) if chosen else np.empty((len(active), 0))
    found = regress(active, table)
    slopes = zip(chosen, found.coefficients[1:].tolist(), found.t[1:].tolist(), strict=True)
    return Exposures(
        alpha=periods_per_year * float(found.coefficients[0]),
        alpha_t=float(found.t[0]),
        r2=found.r2,
        lags=found.lags,
        factors=[Exposure(*each) for each in slopes],
    )


def factor_returns(
    values: Floats,
    folds: Sequence[Fold],
    lag: int,
    periods_per_year: float,
    tradable: Bools | None = None,
    growth: Floats | None = None,
) -> dict[str, Floats]:
    """The returns of every factor on the days of a test.

    Args:
        values: Prices of shape (rows, N), NaN before an asset's first price.
        folds: The folds, in order and without gaps.
        lag: Rows from a decision to its execution.
        periods_per_year: Sets the number of rows in a year, a month and a week.
        tradable: Whether a factor may hold an asset from a row to the next, of the same shape as
            the prices (default: from its first price on).
        growth: Growth factors of cash and each asset on the days of the test, shape (D, 1 + N):
            interest and carry included (default: those of the prices, and 1 for cash).

    Returns:
        Series of shape (D,), by the name of the factor.
    """
    there = ~np.isnan(values) if tradable is None else tradable
    held = np.zeros(values.shape, bool)
    held[1:] = there[:-1]
    moves = np.zeros(values.shape)
    moves[1:] = np.where(held[1:], values[1:] / values[:-1] - 1, 0)
    shift = lag + 1
    days = slice(folds[0].decisions.start + shift, folds[-1].decisions.stop + shift)
    cash: Floats | float = 0.0
    if growth is not None:
        cash = growth[:, 0] - 1
        moves[days] = np.where(held[days], growth[:, 1:] - 1, 0)
    market = moves.sum(1) / np.maximum(held.sum(1), 1)
    found = {"market": market[days] - cash}
    for name, signal in _signals(periods_per_year).items():
        ranks = np.nan_to_num(compute([signal], values, tradable=there)[..., 0])
        weights = _long_short(-ranks if name == "low volatility" else ranks)
        found[name] = (weights[:-1] * moves[1:]).sum(1)[days.start - 1 : days.stop - 1]
    active = np.where(held, moves - market[:, None], 0)
    return found | _components(values, there, active, folds, shift)


def _signals(periods_per_year: float) -> dict[str, Signal]:
    """Signals by name, with lengths in rows; those that the table's frequency allows."""
    year, month, week = (max(0, round(periods_per_year / part)) for part in (1, 12, 52))
    found: dict[str, Signal] = {}
    if year > month > 0:
        found[f"momentum {year}\N{MINUS SIGN}{month}"] = formulas.Momentum(year, month)
    for rows in sorted({month, week} - {0}, reverse=True):
        found[f"reversal {rows}"] = formulas.Reversal(rows)
    if year >= 3:
        found["low volatility"] = formulas.Volatility(year)
    return found


def _long_short(scores: Floats) -> Floats:
    """Weights in proportion to scores, long one and short one; 0 where no score is known."""
    gross = abs(scores).sum(-1, keepdims=True) / 2
    return scores / np.where(gross > 0, gross, 1.0)


def _components(
    values: Floats, there: Bools, active: Floats, folds: Sequence[Fold], shift: int
) -> dict[str, Floats]:
    """The components' returns, with each fold's weights from its training rows only."""
    series: list[Floats] = []
    last: Floats | None = None
    for fold in folds:
        tradable = fold.tradable(values) & there[fold.train.stop - 1]
        seen = active[fold.train.start + 1 : fold.train.stop] * tradable
        seen = seen - np.where(tradable, seen.sum(1, keepdims=True) / max(1, tradable.sum()), 0.0)
        vectors = np.linalg.eigh(seen.T @ seen)[1][:, ::-1][:, :COMPONENTS].T
        vectors = _long_short(np.where(tradable, vectors, 0.0))
        if last is None:
            largest = np.take_along_axis(vectors, abs(vectors).argmax(1)[:, None], 1)
            signs = np.sign(largest[:, 0])
        else:  # the sign of the fold before
            signs = np.where((vectors * last).sum(1) < 0, -1.0, 1.0)
        last = vectors * signs[:, None]
        days = slice(fold.decisions.start + shift, fold.decisions.stop + shift)
        series.append(active[days] @ last.T)
    count = min(COMPONENTS, max(0, values.shape[1] - 2))
    names = [f"component {i + 1}" for i in range(count)]
    return dict(zip(names, np.concatenate(series).T[:count], strict=True))
