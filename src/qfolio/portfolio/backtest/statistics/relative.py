"""Measures of a track record against a benchmark: active return, tracking error, beta, capture."""

import math

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Bools, Floats
from qfolio.portfolio.backtest.statistics.bootstrap import histories
from qfolio.portfolio.backtest.statistics.estimates import clear
from qfolio.portfolio.backtest.statistics.measures import paired_difference, ratio_or_zero

RELATIVE = (
    *("active_return", "tracking_error", "information_ratio", "beta"),
    *("up_capture", "down_capture", "active_share"),
)

_WORST = -1 + 1e-12  # a total loss, whose logarithm would not be finite

_STILL = 1e-24
"""Variance of a period's active return up to which it is constant: what is left is rounding, and a
ratio to it would be a number of seventeen digits."""


def relative(
    returns: ArrayLike,
    benchmark: ArrayLike,
    periods_per_year: float,
    share: ArrayLike | None = None,
) -> dict[str, Floats]:
    """Compute measures of track records against a benchmark, annualized where it says so.

    Args:
        returns: Simple returns of shape (..., periods).
        benchmark: Simple returns of the benchmark, of shape (periods,).
        periods_per_year: For example 252 for trading days.
        share: The active share by period, of the shape of the returns; NaN where it is not known
            (default: nowhere).

    Returns:
        One array of shape (...) for each name in ``RELATIVE``:

        - active_return: mean of the differences in returns, annualized;
        - tracking_error: their standard deviation (n − 1), annualized;
        - information_ratio: active return over tracking error, 0 if the former is a rounding error;
        - beta: covariance with the benchmark over its variance;
        - up_capture, down_capture: geometric mean of the returns over that of the benchmark, in
          the periods in which the benchmark rises, or falls; NaN if there are none;
        - active_share: its mean; NaN unless it is known in all periods.
    """
    ours, theirs = np.asarray(returns, float), np.asarray(benchmark, float)
    held = np.full_like(ours, np.nan) if share is None else np.asarray(share, float)
    moments = _per_period(ours, theirs, held).mean(axis=-1)
    return _from_moments(moments, ours.shape[-1], periods_per_year, _known(held))


def bootstrap_relative(
    returns: Floats,
    benchmark: Floats,
    periods_per_year: float,
    share: Floats,
    block: float,
    resamples: int,
    seed: int,
) -> dict[str, Floats]:
    """Compute ``relative`` on histories resampled by the stationary bootstrap.

    Args:
        returns, benchmark, periods_per_year, share: As in ``relative``; returns of shape
            (series, periods).
        block, resamples: As in ``bootstrap.stationary_bootstrap_indices``.
        seed: Seed of the draws; equal seeds give the same histories.

    Returns:
        One array of shape (resamples, series) for each name in ``RELATIVE``.
    """
    series, periods = returns.shape
    features = _per_period(returns, benchmark, share).reshape(-1, periods).T
    rng = np.random.default_rng(seed)
    parts = []
    for _, counts in histories(periods, block, resamples, rng):
        moments = (counts @ features / periods).reshape(len(counts), -1, series).swapaxes(0, 1)
        parts.append(_from_moments(moments, periods, periods_per_year, _known(share)))
    return {name: np.concatenate([part[name] for part in parts]) for name in RELATIVE}


def active_share(weights: Floats, benchmark: Floats) -> Floats:
    """Half the sum of the absolute differences of weights of shape (..., N + 1), cash included."""
    return np.asarray(np.abs(weights - benchmark).sum(axis=-1) / 2)


def _known(share: Floats) -> Bools:
    return np.asarray(~np.isnan(share).any(axis=-1))


def _per_period(returns: Floats, benchmark: Floats, share: Floats) -> Floats:
    """Quantities whose means over time give all measures: (13, ..., periods)."""
    other = np.broadcast_to(benchmark, returns.shape)
    active = paired_difference(returns, other)
    mean = np.broadcast_to(active.mean(axis=-1, keepdims=True), returns.shape)
    # Centered, or the variances would lose precision.
    spread, mine = active - mean, returns - returns.mean(axis=-1, keepdims=True)
    theirs = other - benchmark.mean()
    logs, rises = np.log1p(np.maximum([returns, other], _WORST)), (other > 0, other < 0)
    captured = [when * each for when in rises for each in (1.0, *logs)]
    held = np.nan_to_num(share)
    moments = [mean, spread, spread**2, mine, theirs, mine * theirs, theirs**2, *captured, held]
    return np.stack(moments)


def _from_moments(
    moments: Floats, periods: int, periods_per_year: float, known: Bools
) -> dict[str, Floats]:
    mean, spread, square, mine, theirs, product, variance, *captured, held = moments
    bessel = periods / (periods - 1) if periods > 1 else math.nan
    moves = square - spread**2
    error = np.sqrt(periods_per_year * bessel * np.where(moves > _STILL, moves, 0))
    active = periods_per_year * (mean + spread)
    with np.errstate(divide="ignore", invalid="ignore"):
        up, down = (
            np.expm1(ours / count) / np.expm1(other / count)
            for count, ours, other in (captured[:3], captured[3:])
        )
        beta = (product - mine * theirs) / (variance - theirs**2)
    return {
        "active_return": active,
        "tracking_error": error,
        "information_ratio": ratio_or_zero(clear(active), error),
        "beta": beta,
        "up_capture": up,
        "down_capture": down,
        "active_share": np.where(known, held, np.nan),
    }
