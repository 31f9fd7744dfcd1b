"""Statistics for a handful of training runs, of one agent or of several that are compared.

They follow R. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice" (2021): the interquartile mean ignores the best and the worst quarter of the runs,
resampling whole runs shows how much a result depends on which seeds happened to be drawn, and the
probability of improvement is how often a run of one agent beats a run of another. An exact rank
test decides whether two agents differ, because bootstrap intervals of few runs are too narrow.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats

FEWEST_SEEDS = 5
"""With fewer seeds, results show the seeds themselves, or their range, and no interval: Student's
factor is 12.7 for two seeds and 4.3 for three, and a bootstrap of so few is far too narrow."""


def regret(returns: ArrayLike, optimum: float | None) -> Floats | None:
    """The share of the optimum's return that each return misses.

    None if the optimum is unknown (None), or 0, of which there are no shares.
    """
    if not optimum:
        return None
    return np.asarray((optimum - np.asarray(returns, dtype=float)) / abs(optimum))


def interquartile_mean(values: ArrayLike) -> Floats:
    """Return the mean of the middle half of the values along the last axis.

    Values on the edge of the middle half count with the fraction that lies inside, so that the
    result is right for every number of values: the mean for one or two, and for three the middle
    value with weight 2/3 and the outer ones with 1/6 each.

    Args:
        values: Numbers of shape (..., n).

    Returns:
        An array without that axis.

    Raises:
        ValueError: There are no values along the axis.
    """
    ordered = np.sort(np.asarray(values, dtype=float), axis=-1)
    count = ordered.shape[-1]
    if count == 0:
        raise ValueError("an interquartile mean needs at least one value")
    edges = np.clip(np.arange(count + 1), count / 4, 3 * count / 4)
    weights = np.diff(edges) / (count / 2)
    return np.asarray(ordered @ weights)


def bootstrap_interval(
    groups: Sequence[ArrayLike],
    statistic: Callable[..., Any] = interquartile_mean,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Return a percentile bootstrap interval of a statistic of groups, each resampled separately.

    With few values it is too narrow: a 95% interval of the interquartile mean of three normal
    values covers the truth in about 75% of all cases, of five in 90%, and of ten in 93%.

    Args:
        groups: Groups of numbers, each of shape (n,) with its own n, such as the seeds of an agent.
        statistic: Called with the resampled groups, each of shape (resamples, n), as separate
            arguments; averages over the last axis (default: for a single group).
        level: Share of the resampled statistics inside the interval, between 0 and 1.
        resamples: How many times the groups are drawn again.
        seed: Seed of the drawing.

    Returns:
        The lower and the upper end.

    Raises:
        ValueError: A group has no values, or level or resamples is out of range.
    """
    values = [np.asarray(group, dtype=float) for group in groups]
    if not values or not all(each.size for each in values):
        raise ValueError("a bootstrap interval needs at least one value in each group")
    if not 0 < level < 1 or resamples < 1:
        raise ValueError("level must lie between 0 and 1, and resamples must be positive")
    rng = np.random.default_rng(seed)
    drawn = [each[rng.integers(each.size, size=(resamples, each.size))] for each in values]
    tail = (1 - level) / 2
    low, high = np.quantile(statistic(*drawn), [tail, 1 - tail])
    return float(low), float(high)


def band(values: ArrayLike) -> tuple[Floats, Floats]:
    """Return the lower and upper ends of the band around the interquartile mean over seeds.

    The band is the 95% bootstrap interval, or the seeds' range if there are fewer than
    FEWEST_SEEDS.

    Args:
        values: Numbers of shape (..., n), one column per seed.
    """
    table = np.asarray(values, dtype=float)
    if table.shape[-1] < FEWEST_SEEDS:
        return table.min(axis=-1), table.max(axis=-1)
    ends = [bootstrap_interval([row]) for row in table.reshape(-1, table.shape[-1])]
    low, high = np.transpose(ends).reshape(2, *table.shape[:-1])
    return low, high


def mean_interval(values: ArrayLike, level: float = 0.95) -> tuple[float, float] | None:
    """Return Student's t interval of a mean; None for fewer than FEWEST_SEEDS values.

    Args:
        values: Numbers of shape (n,), one per seed.
        level: Coverage if the values are normal, between 0 and 1.
    """
    from scipy.special import stdtrit

    sample = np.asarray(values, dtype=float)
    if sample.size < FEWEST_SEEDS:
        return None
    margin = stdtrit(sample.size - 1, (1 + level) / 2) * sample.std(ddof=1) / np.sqrt(sample.size)
    return float(sample.mean() - margin), float(sample.mean() + margin)


def probability_of_improvement(first: ArrayLike, second: ArrayLike) -> Floats:
    """Return how often a value of the first group is larger than one of the second; ties count ½.

    Args:
        first: Numbers of shape (..., n).
        second: Numbers of shape (..., m).

    Returns:
        An array of shape (...).
    """
    x, y = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    # A column at a time keeps memory small when there are many.
    columns = (x[..., i, None] for i in range(x.shape[-1]))
    wins = [(0.5 * (column > y) + 0.5 * (column >= y)).mean(-1) for column in columns]
    return np.asarray(np.mean(wins, axis=0))


def rank_test(first: ArrayLike, second: ArrayLike) -> float:
    """Return the two-sided p-value of the Wilcoxon-Mann-Whitney test, exact with ties.

    If both groups come from one distribution, each choice of n of all n + m values is equally
    likely to be the first group; the p-value is the share of choices whose rank sum is at least as
    far from the middle as the observed one. Above 100 values the rank sum is taken as normal.

    Args:
        first: Numbers of shape (n,).
        second: Numbers of shape (m,).
    """
    x, y = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    pooled = np.concatenate([x, y])
    # Twice the ranks, so that those shared by ties are whole numbers, too.
    ranks = (pooled[:, None] > pooled).sum(1) + (pooled[:, None] >= pooled).sum(1) + 1
    total, count = int(ranks.sum()), pooled.size
    middle = x.size * total / count
    distance = abs(int(ranks[: x.size].sum()) - middle)
    if count > 100:
        variance = x.size * y.size / count * ranks.var(ddof=1)
        return math.erfc(distance / math.sqrt(2 * variance)) if variance else 1.0
    # ways[k, s]: choices of k values whose ranks have the sum s.
    ways = np.zeros((x.size + 1, total + 1))
    ways[0, 0] = 1
    for rank in ranks.tolist():
        ways[1:, rank:] = ways[1:, rank:] + ways[:-1, :-rank]
    sums = np.arange(total + 1)
    return float(ways[-1, np.abs(sums - middle) >= distance - 1e-9].sum() / ways[-1].sum())


def holm(p_values: ArrayLike) -> Floats:
    """Return p-values adjusted for multiple tests; they control the family-wise error rate.

    Source: S. Holm, "A Simple Sequentially Rejective Multiple Test Procedure" (1979).

    Args:
        p_values: Numbers of shape (n,).
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(np.arange(p.size, 0, -1) * p[order])
    return np.minimum(adjusted, 1.0)
