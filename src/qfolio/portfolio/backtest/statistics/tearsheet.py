"""The figures of a tear sheet: tails, months, drawdowns, rolling ratios, contributions of assets.

They describe a track record and test nothing; ``measures.py`` has what is tested. Other definitions
follow quantstats and pyfolio where these agree.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.measures import (
    STEADY,
    checked_dates,
    deviations,
    drawdown,
    log_growth,
    measures,
    monthly,
    ratio_or_zero,
)
from qfolio.portfolio.backtest.statistics.sharpe import skewness_and_kurtosis

TAIL = 0.05
"""Share of returns in the tail beyond the value at risk, whose mean loss is CVaR."""

SHARED = ("growth", "volatility", "sharpe", "sortino", "calmar", "drawdown")
"""Figures that are measures of ``measures.py``."""


class Fall(NamedTuple):
    """A fall below a peak and its recovery; places are periods, −1 is the start of the record."""

    start: int  # the peak
    trough: int
    end: int | None  # the first period at the old peak again; none if it has not recovered
    depth: float  # between 0 and 1
    length: int  # periods from the peak to the end, or to the end of the record


def falls(returns: ArrayLike, count: int) -> list[Fall]:
    """Return the deepest drawdowns of one track record, deepest first.

    Args:
        returns: Simple returns of shape (periods,).
        count: Largest number of drawdowns to return.
    """
    depth = drawdown(returns)
    below = np.concatenate([[False], depth > 0, [False]])
    edges = np.flatnonzero(below[1:] != below[:-1])
    found = []
    for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        trough = first + int(depth[first:after].argmax())
        end = after if after < len(depth) else None
        length = (len(depth) - 1 if end is None else end) - (first - 1)
        found.append(Fall(first - 1, trough, end, float(depth[trough]), length))
    return sorted(found, key=lambda fall: -fall.depth)[:count]


def value_at_risk(returns: ArrayLike) -> tuple[float, float]:
    """Return the historical value at risk and the expected loss beyond it (CVaR), as losses.

    Value at risk is the loss that a share ``TAIL`` of the returns exceed (the quantile with linear
    interpolation); CVaR is the mean loss of the returns at or below that quantile. NaN for fewer
    returns than one in ``TAIL``, which have no such tail.
    """
    values = np.asarray(returns, dtype=float)
    if len(values) * TAIL < 1:
        return math.nan, math.nan
    edge = np.quantile(values, TAIL)
    return float(-edge), float(-values[values <= edge].mean())


def rolling_sharpe(returns: ArrayLike, window: int, periods_per_year: float) -> Floats:
    """Return the annualized Sharpe ratio of the last ``window`` returns, NaN before there are any.

    Args:
        returns: Simple returns of shape (..., periods).
        window: Number of returns, at least 2.
        periods_per_year: For example 252 for trading days.
    """
    (mean, variance), _ = _rolling(np.asarray(returns, dtype=float), None, window)
    ratio = ratio_or_zero(mean, np.sqrt(variance * window / (window - 1)))
    return _padded(math.sqrt(periods_per_year) * ratio, window)


def rolling_beta(returns: ArrayLike, reference: ArrayLike, window: int) -> Floats:
    """Return the slope of the last ``window`` returns on those of a reference.

    NaN before there are so many, and where the reference did not move.

    Args:
        returns: Simple returns of shape (..., periods).
        reference: Simple returns of the reference, shape (periods,).
        window: Number of returns, at least 2.
    """
    other = np.asarray(reference, dtype=float)
    _, covariance = _rolling(np.asarray(returns, dtype=float), other, window)
    (_, variance), _ = _rolling(other, None, window)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _padded(np.where(variance > 0, covariance / variance, np.nan), window)


def effective_number(weights: ArrayLike) -> Floats:
    """Return the effective number of assets: one over the sum of squared shares.

    An asset's share is its part of what is invested. The number is 0 if all is cash.

    Args:
        weights: Weights of shape (..., assets + 1), cash first.
    """
    risky = np.asarray(weights, dtype=float)[..., 1:]
    invested = np.abs(risky).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(invested > 1e-9, invested**2 / (risky**2).sum(axis=-1), 0.0)


def leverage(weights: ArrayLike) -> tuple[float, float]:
    """Return the gross leverage and the net exposure, means over time.

    They are the sums of the sizes of an account's positions, and of the positions themselves, over
    its value; cash is none.

    Args:
        weights: Weights of shape (periods, assets + 1), cash first.
    """
    risky = np.asarray(weights, dtype=float)[:, 1:]
    return float(np.abs(risky).sum(axis=1).mean()), float(risky.sum(axis=1).mean())


def alpha(returns: ArrayLike, reference: ArrayLike, periods_per_year: float) -> float:
    """Return the annual mean return that the regression on a reference leaves.

    NaN if the returns fluctuate ``STEADY`` times as much as the reference. Where cash earns
    interest, both are to be in excess of it: otherwise holding cash has an alpha.

    Args:
        returns: Simple returns of shape (periods,).
        reference: Simple returns of the reference, same shape.
        periods_per_year: For example 252 for trading days.
    """
    ours, theirs = np.asarray(returns, dtype=float), np.asarray(reference, dtype=float)
    own, other = deviations(ours), deviations(theirs)
    if own @ own >= STEADY**2 * (other @ other):
        return math.nan
    beta = float(other @ own / (other @ other))
    return periods_per_year * float(ours.mean() - beta * theirs.mean())


def stability(returns: ArrayLike) -> float:
    """Return the R² of the regression of log wealth on time.

    It is 1 for steady growth or decline, 0 if there is neither, and NaN after a total loss.
    """
    wealth = np.cumsum(log_growth(np.asarray(returns, dtype=float)))
    if len(wealth) < 2 or not np.isfinite(wealth).all():
        return math.nan
    time, moved = deviations(np.arange(len(wealth), dtype=float)), deviations(wealth)
    return float(ratio_or_zero((time @ moved) ** 2, (time @ time) * (moved @ moved)))


def kelly(returns: ArrayLike) -> float:
    """Return Kelly's fraction of two outcomes, the mean gain and the mean loss.

    It is p − q/b, where p and q are the shares of gains and losses among the periods that moved,
    and b is the mean gain over the mean loss. NaN without any gain.
    """
    values = np.asarray(returns, dtype=float)
    gains, losses = values[values > 0], -values[values < 0]
    if not len(gains):
        return math.nan
    share = len(gains) / (len(gains) + len(losses))
    return share - (1 - share) * (float(losses.mean() / gains.mean()) if len(losses) else 0.0)


def longest_run(flags: ArrayLike) -> int:
    """Return the length of the longest run of true values in a row of flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(flags, bool), [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def contributions(
    returns: ArrayLike, weights: ArrayLike, moves: ArrayLike, periods_per_year: float
) -> tuple[Floats, float]:
    """Return what each asset contributed to the annual mean return, and the rest.

    An asset's contribution is the mean of its weight times its return. The rest is the mean net
    return minus all contributions: trading costs, and interest and fees if there are any.

    Args:
        returns: Simple net returns of shape (seeds, periods).
        weights: Weights after each trade, the mean over the seeds, (periods, assets + 1), cash
            first.
        moves: Simple returns of the assets over the same periods, shape (periods, assets).
        periods_per_year: For example 252 for days of trading.

    Returns:
        Contributions of shape (assets,), and the rest.
    """
    held, moved = np.asarray(weights, dtype=float)[:, 1:], np.asarray(moves, dtype=float)
    parts = periods_per_year * np.einsum("pa,pa->a", held, moved) / len(held)
    net = periods_per_year * float(np.asarray(returns, dtype=float).mean())
    return parts, net - float(parts.sum())


def figures(returns: ArrayLike, dates: ArrayLike, periods_per_year: float) -> dict[str, float]:
    """Return the usual figures of a tear sheet for one track record; returns are simple and net.

    ``growth`` is the compound annual rate (CAGR), ``kurtosis`` is 3 for a normal distribution,
    ``longest`` is the longest drawdown in years, ``time_below`` the share of the time below a peak,
    ``tail_ratio`` the 95% quantile over the size of the 5% quantile, ``omega`` the sum of gains
    over that of losses, ``gain_to_pain`` the sum of monthly returns over that of monthly losses,
    ``payoff`` the mean gain over the mean loss, ``hit_rate`` the share of periods with a gain among
    those that moved, ``winning`` and ``losing`` the most periods in a row with a gain or a loss,
    ``ulcer`` the root mean square of drawdowns; ``stability`` and ``kelly`` are as above.

    Args:
        returns: Simple net returns, of shape (periods,).
        dates: Days on which the returns were earned, shape (periods,), strictly increasing.
        periods_per_year: For example 252 for trading days.
    """
    values = np.asarray(returns, dtype=float)
    checked_dates(dates, len(values))
    depth, nothing = drawdown(values), np.zeros_like(values)
    found = measures(values, nothing, nothing, periods_per_year)
    table = monthly(values, dates)[1]
    months = table[~np.isnan(table)]
    years = np.nanprod(1 + table, axis=-1)[~np.isnan(table).all(axis=-1)] - 1
    gains, losses = values[values > 0], values[values < 0]
    skewness, kurtosis = skewness_and_kurtosis(values[None])
    low, high = np.quantile(values, [TAIL, 1 - TAIL])
    day, month = value_at_risk(values), value_at_risk(months)
    longest = max((fall.length for fall in falls(values, len(values))), default=0)

    def over(above: float, below: float) -> float:
        return float(ratio_or_zero(above, below))

    return {
        **{key: float(found[key]) for key in SHARED},
        "total": math.expm1(float(log_growth(values).sum())),
        "stability": stability(values),
        "omega": over(float(gains.sum()), abs(float(losses.sum()))),
        "gain_to_pain": over(float(months.sum()), abs(float(months[months < 0].sum()))),
        "kelly": kelly(values),
        "winning": longest_run(values > 0),
        "losing": longest_run(values < 0),
        "longest": longest / periods_per_year,
        "time_below": float((depth > 0).mean()),
        "ulcer": math.sqrt(float((depth**2).mean())),
        "var": day[0],
        "cvar": day[1],
        "var_month": month[0],
        "cvar_month": month[1],
        "skewness": skewness,
        "kurtosis": kurtosis,
        "tail_ratio": over(float(abs(high)), float(abs(low))),
        "hit_rate": over(len(gains), len(gains) + len(losses)),
        "hit_rate_month": float((months > 0).mean()),
        "payoff": over(
            float(gains.mean()) if len(gains) else 0.0,
            abs(float(losses.mean())) if len(losses) else 0.0,
        ),
        "best": float(values.max()),
        "worst": float(values.min()),
        "best_month": float(months.max()),
        "worst_month": float(months.min()),
        "best_year": float(years.max()),
        "worst_year": float(years.min()),
    }


def _rolling(values: Floats, other: Floats | None, window: int) -> tuple[NDArray, Floats]:
    """Mean and variance of each window, stacked, and the covariance with another series."""
    center = values.mean(axis=-1, keepdims=True)  # or differences of sums would lose precision
    moved = values - center
    mean = _means(moved, window)
    variance = np.maximum(_means(moved**2, window) - mean**2, 0)
    variance = np.where(variance > 1e-18, variance, 0)
    both = np.stack([mean + center, variance])
    if other is None:
        return both, variance
    beside = other - other.mean()
    return both, _means(moved * beside, window) - mean * _means(beside, window)


def _means(values: Floats, window: int) -> Floats:
    sums = np.cumsum(values, axis=-1)
    before = np.concatenate(
        [np.zeros_like(sums[..., :1]), sums[..., :-window]], axis=-1
    )  # the sum up to each window
    return np.asarray((sums[..., window - 1 :] - before) / window)


def _padded(values: Floats, window: int) -> Floats:
    missing = np.full((*values.shape[:-1], window - 1), np.nan)
    return np.concatenate([missing, values], axis=-1)
