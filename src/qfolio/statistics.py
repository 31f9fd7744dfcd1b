"""Statistics for a handful of training runs: interquartile mean and bootstrap intervals.

Both follow R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice" (2021): the interquartile mean ignores the best and the worst quarter of the runs, and
resampling whole runs shows how much a result depends on which seeds happened to be drawn.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def interquartile_mean(values: ArrayLike, axis: int = -1) -> Floats:
    """Return the mean of the middle half of the values along an axis.

    Values on the edge of the middle half count with the fraction that lies inside, so that the
    result is right for every number of values: the mean for one or two, and for three the middle
    value with weight 2/3 and the outer ones with 1/6 each.

    Args:
        values: Numbers of shape (..., n, ...).
        axis: The axis of length n that is averaged away.

    Returns:
        An array without that axis.

    Raises:
        ValueError: There are no values along the axis.
    """
    ordered = np.sort(np.moveaxis(np.asarray(values, dtype=float), axis, -1), axis=-1)
    count = ordered.shape[-1]
    if count == 0:
        raise ValueError("an interquartile mean needs at least one value")
    edges = np.clip(np.arange(count + 1), count / 4, 3 * count / 4)
    weights = np.diff(edges) / (count / 2)
    return np.asarray(ordered @ weights)


def bootstrap_interval(
    values: ArrayLike,
    statistic: Callable[..., Any] = interquartile_mean,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[Floats, Floats]:
    """Return a percentile bootstrap interval of a statistic over the last axis.

    Whole columns are drawn again with replacement, the same ones for every row, and equal
    arguments give equal results. With one value per row the interval has no width.

    Args:
        values: Numbers of shape (..., n), one column per seed.
        statistic: Called as statistic(samples, axis=-1), for example numpy.mean.
        level: Share of the resampled statistics inside the interval, between 0 and 1.
        resamples: How many times the columns are drawn again.
        seed: Seed of the drawing.

    Returns:
        The lower and the upper ends, each of shape (...).

    Raises:
        ValueError: There are no values, or level or resamples is out of range.
    """
    table = np.asarray(values, dtype=float)
    if table.ndim == 0 or table.size == 0:
        raise ValueError("a bootstrap interval needs at least one value")
    if not 0 < level < 1 or resamples < 1:
        raise ValueError("level must lie between 0 and 1, and resamples must be positive")
    count = table.shape[-1]
    picks = np.random.default_rng(seed).integers(count, size=(resamples, count))
    # One row at a time keeps memory small when there are many rows.
    estimates = [statistic(row[picks], axis=-1) for row in table.reshape(-1, count)]
    tail = (1 - level) / 2
    low, high = np.quantile(np.stack(estimates), [tail, 1 - tail], axis=-1)
    return low.reshape(table.shape[:-1]), high.reshape(table.shape[:-1])


def mean_interval(values: ArrayLike, level: float = 0.95) -> tuple[float, float]:
    """Return Student's t interval of a mean, which keeps its level with few seeds, too.

    Args:
        values: At least two numbers, one per seed.
        level: Coverage where the values are normal, between 0 and 1.
    """
    from scipy.special import stdtrit

    sample = np.asarray(values, dtype=float)
    margin = stdtrit(sample.size - 1, (1 + level) / 2) * sample.std(ddof=1) / np.sqrt(sample.size)
    return float(sample.mean() - margin), float(sample.mean() + margin)
