"""The stationary bootstrap of track records."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.measures import (
    MEASURES,
    checked_risk_free,
    checked_track,
    deepest_drawdown,
    deviations,
    from_moments,
    log_growth,
    per_period,
    ratio_or_zero,
)

LEVEL = 0.95
"""Coverage of all intervals, and the probability required for a claim."""

CHUNK = 2_000_000
"""Resampled days held at a time: tens of megabytes, whatever the resamples."""

TOGETHER = 100
"""Fewest histories at a time, because each chunk loops over all days in Python."""


def block_length(series: ArrayLike) -> float:
    """Choose the mean block length of the stationary bootstrap from a series' autocorrelation.

    Politis & White (2004), "Automatic block-length selection for the dependent bootstrap", with
    the correction of Patton, Politis & White (2009): b = (2 G² / D · n)^⅓ with D = 2 g(0)², where
    g(0) and G sum R(k) and |k| R(k) under a flat-top window. The window ends at twice the lag
    after which five autocorrelations in a row stay within ±2 √(log10 n / n).

    Args:
        series: Numbers of shape (n,).

    Returns:
        The length, from 1 (independent days) to min(3 √n, n / 3).
    """
    values = np.asarray(series, dtype=float)
    count = values.size
    longest = max(1.0, math.ceil(min(3 * math.sqrt(count), count / 3)))
    centered = deviations(values)
    if count < 3 or not centered.any():
        return 1.0
    run = max(5, math.ceil(math.sqrt(math.log10(count))))
    lags = min(math.ceil(math.sqrt(count)) + run, count - 1)
    covariance = np.array([centered[k:] @ centered[: count - k] for k in range(lags + 1)]) / count
    small = np.abs(covariance) < 2 * math.sqrt(math.log10(count) / count) * covariance[0]
    quiet = (m for m in range(lags - run + 1) if small[m + 1 : m + 1 + run].all())
    window = min(2 * max(next(quiet, lags), 1), lags)
    k = np.arange(1, window + 1)
    weights = 2 * np.minimum(1, 2 * (1 - k / window)) * covariance[1 : window + 1]
    spectrum = covariance[0] + weights.sum()  # g(0)
    slope = k @ weights  # G
    return float(np.clip((ratio_or_zero(slope, spectrum) ** 2 * count) ** (1 / 3), 1, longest))


def stationary_bootstrap_indices(
    periods: int, block: float, resamples: int, rng: np.random.Generator
) -> NDArray[np.int32]:
    """Draw the days of resampled histories: circular blocks of geometric length.

    Politis & Romano (1994), "The stationary bootstrap": each day follows the one before with
    probability 1 − 1/block, and is otherwise a random day; the first day follows the last.

    Args:
        periods: Number of days.
        block: The mean length of a block, at least 1; at 1 the days are independent draws.
        resamples: Number of histories to draw.
        rng: Source of randomness.

    Returns:
        Indices of shape (resamples, periods).
    """
    shape = (resamples, periods)
    day = np.arange(periods, dtype=np.int32)
    jump = rng.random(shape, dtype=np.float32) * np.float32(block) < 1
    begun = np.maximum.accumulate(
        np.where(jump, day, 0), axis=1
    )  # when the block began; the first at 0
    # Each block draws its shift from the calendar, which is constant within the block.
    shift = np.take_along_axis(rng.integers(periods, size=shape, dtype=np.int32), begun, axis=1)
    shift += day
    return np.where(shift >= periods, shift - np.int32(periods), shift)


def histories(
    periods: int, block: float, resamples: int, rng: np.random.Generator
) -> Iterator[tuple[NDArray[np.int32], Floats]]:
    """Draw resampled histories, some at a time.

    The arguments are those of ``stationary_bootstrap_indices``.

    Yields:
        Their days, and how often each day was drawn, both of shape (some, periods). Averages over a
        history depend only on the latter, so they are one matrix product.
    """
    chunk = max(TOGETHER, CHUNK // periods)
    for start in range(0, resamples, chunk):
        size = min(chunk, resamples - start)
        days = stationary_bootstrap_indices(periods, block, size, rng)
        cells = days + periods * np.arange(size)[:, None]
        counts = np.bincount(cells.ravel(), minlength=size * periods).reshape(size, periods)
        yield days, counts.astype(float)


def bootstrap_measures(
    returns: ArrayLike,
    turnover: ArrayLike,
    cost: ArrayLike,
    periods_per_year: float,
    block: float,
    resamples: int,
    rng: np.random.Generator,
    risk_free: ArrayLike | None = None,
) -> dict[str, Floats]:
    """Compute ``measures`` on histories resampled by the stationary bootstrap.

    The same days are drawn for all series. Only the drawdown depends on their order.

    Args:
        returns, turnover, cost: As in ``measures``, shape (series, periods), at least two periods.
        periods_per_year, risk_free: As in ``measures``.
        block, resamples, rng: As in ``stationary_bootstrap_indices``.

    Returns:
        One array of shape (resamples, series) for each name in ``MEASURES``.
    """
    track = checked_track(returns, turnover, cost)
    series, periods = track[0].shape
    center = track[0].mean(axis=-1)
    free = checked_risk_free(risk_free, periods)
    features = per_period(track, center, free).reshape(-1, periods).T
    steps = np.ascontiguousarray(log_growth(track[0]).T)
    parts = []
    for days, counts in histories(periods, block, resamples, rng):
        moments = (counts @ features / periods).reshape(len(days), -1, series)
        parts.append(
            from_moments(
                moments.swapaxes(0, 1),
                deepest_drawdown(steps, days),
                center,
                free,
                periods,
                periods_per_year,
            )
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in MEASURES}


def percentile_interval(samples: Floats, level: float = LEVEL) -> Floats:
    """Return the percentile interval of samples along the first axis, shape (2, …).

    Its ends are samples.
    """
    count = len(samples)
    tail = max(math.floor((count + 1) * (1 - level) / 2), 1)
    ordered = np.sort(samples, axis=0)  # no interpolation: an end may be infinite
    return ordered[[tail - 1, count - tail]]
