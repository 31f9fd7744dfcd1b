"""The evidence of several tables on an agent, pooled."""

import math
from collections.abc import Mapping, Sequence
from functools import cache

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Floats
from qfolio.core.text import finite
from qfolio.portfolio.backtest.statistics.bootstrap import (
    block_length,
    histories,
    percentile_interval,
)
from qfolio.portfolio.backtest.statistics.differences import Finding
from qfolio.portfolio.backtest.statistics.estimates import clear
from qfolio.portfolio.backtest.statistics.measures import (
    ratio_or_zero,
)
from qfolio.portfolio.prices.frequency import spacing
from qfolio.portfolio.study.evidence import (
    AGAINST,
    Active,
    Evidence,
    TableReturns,
    active_returns,
    evidence,
)

RESAMPLES = 2000
"""Number of histories that the hierarchical bootstrap draws."""

MONTHS = 24
"""Common months of two tables from which on their sums say how much the tables share."""

SPANS = ((1.5, "D"), (11.0, "W"), (46.0, "M"), (137.0, "3M"), (math.inf, "Y"))
"""Spans of the calendar, and the most days between the rows of a table that they suit."""


class Pooled(msgspec.Struct, frozen=True, kw_only=True):
    """What all tables say about one agent against one reference."""

    growth: float | None  # mean over tables of the annual active growth
    low: float | None  # 95% interval by the hierarchical bootstrap; one table alone keeps its own
    high: float | None
    z: float | None  # Stouffer's
    p: float | None  # two-sided; against rebalancings only the claim "better" is tested
    p_holm: float | None = None  # corrected for all comparisons of the main variant
    finding: Finding | None = None  # by p_holm and what luck reaches; none for other variants
    positive: int  # tables on which the agent grew more
    worst: str  # the table with the least active growth


class PooledSharpe(msgspec.Struct, frozen=True, kw_only=True):
    """What all tables say about the Sharpe ratio of one agent, less that of their best baselines.

    The best baseline of each table is known in hindsight only, so this is no fair test of an agent:
    one as good as all baselines falls short of the luckiest of them.
    """

    difference: float | None  # mean over tables
    z: float | None  # Stouffer's
    positive: int  # tables on which the agent's is higher


class Pools(msgspec.Struct, frozen=True, kw_only=True):
    """What all tables say about one agent; evidence: that of each table, by its name."""

    evidence: dict[str, Evidence]
    to_reference: Pooled
    to_rebalanced: Pooled
    sharpe: PooledSharpe


def pool(tables: Mapping[str, TableReturns], agents: Sequence[str]) -> dict[str, Pools]:
    """Pool the evidence of tables on each agent, without Holm's correction.

    All agents share the tables and days that the bootstrap draws.

    Args:
        tables: The tables by name, at least one.
        agents: Names of agents that all tables have.
    """
    keys = [(agent, against) for agent in agents for against in AGAINST]
    # Any number will do for a total loss, which has neither an interval nor a z.
    active = [
        np.nan_to_num([active_returns(table, *key) for key in keys], neginf=0.0, posinf=0.0)
        for table in tables.values()
    ]
    years = [table.periods_per_year for table in tables.values()]
    annual = [year * daily for year, daily in zip(years, active, strict=True)]
    drawn = hierarchical_bootstrap(annual, RESAMPLES, np.random.default_rng(0))
    known = {a: {name: evidence(table, a) for name, table in tables.items()} for a in agents}
    days = [table.days for table in tables.values()]
    pooled = {
        (agent, against): _pooled(
            {name: getattr(each, against) for name, each in known[agent].items()},
            [math.sqrt(each.years) for each in known[agent].values()],
            correlations(days, [daily[place] for daily in active]),
            drawn[:, place],
            both=against == "to_reference",
        )
        for place, (agent, against) in enumerate(keys)
    }
    return {
        agent: Pools(
            evidence=known[agent],
            to_reference=pooled[agent, "to_reference"],
            to_rebalanced=pooled[agent, "to_rebalanced"],
            sharpe=_pooled_sharpe(tables, agent, known[agent]),
        )
        for agent in agents
    }


def _pooled_sharpe(
    tables: Mapping[str, TableReturns], agent: str, known: Mapping[str, Evidence]
) -> PooledSharpe:
    """From the evidence of each table on an agent."""
    found = [_known(each.sharpe) for each in known.values()]
    # To first order, a day contributes the difference of both standardized returns.
    daily = [
        _standardized(table.agents[agent]) - _standardized(table.baselines[known[name].baseline])
        for name, table in tables.items()
    ]
    shared = correlations([table.days for table in tables.values()], daily)
    weights = [math.sqrt(each.years) for each in known.values()]
    z = stouffer([_known(each.sharpe_z) for each in known.values()], weights, shared)
    return PooledSharpe(
        difference=finite(float(np.mean(found))),
        z=finite(z),
        positive=int((clear(found) > 0).sum()),
    )


def _pooled(
    tables: Mapping[str, Active], weights: list[float], shared: Floats, drawn: Floats, *, both: bool
) -> Pooled:
    """From differences by table, their weights and correlations, and resampled means."""
    growth = {name: _known(each.growth) for name, each in tables.items()}
    mean = float(np.mean(list(growth.values())))
    low, high = np.full(2, math.nan)
    if len(tables) == 1:  # nothing is pooled, and the table has an interval of its own
        (only,) = tables.values()
        low, high = _known(only.low), _known(only.high)
    elif math.isfinite(mean):
        # The bootstrap draws tables independently; common shocks widen the interval.
        errors = np.array([_known(x.tracking_error) for x in tables.values()]) / weights
        wider = math.sqrt(ratio_or_zero(errors @ shared @ errors, errors @ errors))
        low, high = mean + wider * (percentile_interval(drawn) - mean)
    z = stouffer([_known(each.z) for each in tables.values()], weights, shared)
    return Pooled(
        growth=finite(mean),
        low=finite(float(low)),
        high=finite(float(high)),
        z=finite(z),
        p=finite(p_value(z, both=both)),
        positive=int((clear(list(growth.values())) > 0).sum()),
        # A growth that is not finite is that of a total loss.
        worst=min(growth, key=lambda name: (math.isfinite(growth[name]), growth[name])),
    )


def stouffer(z: ArrayLike, weights: ArrayLike, correlation: ArrayLike) -> float:
    """Combine one-sided tests of several tables: Σ wz / √(w'Rw), standard normal without an edge.

    Stouffer et al. (1949), "The American Soldier", with the weights of Lipták (1958); R allows for
    tables with common shocks (Strube 1985).

    Args:
        z: Normal quantiles of shape (tables,).
        weights: Positive numbers of the same shape. √years has the most power if all tables have
            the same information ratio, because the expected z is that ratio times √years.
        correlation: R of shape (tables, tables).
    """
    scores, w, shared = (np.asarray(x, dtype=float) for x in (z, weights, correlation))
    return float(w @ scores / math.sqrt(w @ shared @ w))


def correlations(days: Sequence[Sequence[str]], active: Sequence[Floats]) -> Floats:
    """Estimate the correlations of the tables' mean active returns from their common time.

    The correlation of two means is ρ · n / √(n₁n₂), where ρ is that of the n common days. Negative
    ones count as 0, so that the pooled z is never larger than that of independent tables.

    Rows of different length have no common days to speak of, and two monthly tables may give a
    month its first or its last day. So the days are those of the calendar for daily and intraday
    rows only; otherwise they are its weeks, months, quarters or years, whichever are as long as the
    rows of both tables, with the sums of the differences. Shocks also arrive a day later in another
    part of the world, and in stale prices, so that two common years or more are also compared by
    months, and the larger correlation counts.

    Args:
        days: Days of each table, with a time of day if there are several rows a day.
        active: Differences of each table, of shape (days,).
    """
    dates = [np.array([day[:10] for day in each], "datetime64[D]") for each in days]
    lengths = [spacing(each.astype("datetime64[s]"))[1] if len(each) > 1 else 1 for each in dates]
    sums = cache(lambda table, unit: _sums(dates[table], active[table], unit))
    shared = np.eye(len(days))
    for i in range(len(days)):
        for j in range(i):
            longest = max(lengths[i], lengths[j])
            units = [next(unit for most, unit in SPANS if longest <= most)]
            common = np.intersect1d(sums(i, "M")[0], sums(j, "M")[0])
            if len(common) >= MONTHS and units[0] in "DW":
                units.append("M")
            found = max(_shared(sums(i, unit), sums(j, unit)) for unit in units)
            shared[i, j] = shared[j, i] = found
    return shared


def _shared(one: tuple[NDArray, Floats], other: tuple[NDArray, Floats]) -> float:
    """The correlation of two means, from sums in spans of the calendar; 0 if it is negative."""
    (own, x), (others, y) = one, other
    _, here, there = np.intersect1d(own, others, return_indices=True)
    first, second = x[here], y[there]
    if len(here) < 3 or first.std() == 0 or second.std() == 0:
        return 0.0
    part = len(here) / math.sqrt(len(own) * len(others))
    return max(0.0, float(np.corrcoef(first, second)[0, 1]) * part)


def _sums(dates: NDArray, values: Floats, unit: str) -> tuple[NDArray, Floats]:
    """The days, weeks, months, … of some dates, and the sum of the values in each."""
    monday = np.timedelta64(3 if unit == "W" else 0, "D")  # numpy's weeks begin on Thursdays
    spans, places = np.unique((dates + monday).astype(f"datetime64[{unit}]"), return_inverse=True)
    return spans, np.asarray(np.bincount(places, values), float)


def hierarchical_bootstrap(
    tables: Sequence[Floats], resamples: int, rng: np.random.Generator
) -> Floats:
    """Resample the mean over tables of their means over days: draw tables, then days within them.

    Tables are drawn with replacement, and the days of each drawn table by the stationary bootstrap
    (Davison & Hinkley 1997, section 3.8; Politis & Romano 1994). The noise of days is already in
    the differences between tables, so that intervals of independent tables are too wide rather than
    too narrow. A single table is resampled by days.

    Args:
        tables: Daily numbers of each table, shape (series, days); all have the same series.
        resamples: Number of means to draw.
        rng: Source of randomness.

    Returns:
        Means of shape (resamples, series).
    """
    picks = rng.integers(len(tables), size=(resamples, len(tables)))
    total = np.zeros((resamples, len(tables[0])))
    for place, table in enumerate(tables):
        block, days = max(block_length(series) for series in table), table.shape[1]
        rows = np.nonzero(picks == place)[0]
        for _, counts in histories(days, block, len(rows), rng):
            some, rows = rows[: len(counts)], rows[len(counts) :]
            np.add.at(total, some, counts @ table.T / days)
    return total / len(tables)


def p_value(z: float, *, both: bool) -> float:
    """The two-sided p-value of a z; if not ``both``, that of a z of 0 or less is 1."""
    from scipy.special import ndtr

    return float(np.minimum(1.0, 2 * ndtr(-abs(z) if both else -z)))


def _standardized(returns: Floats) -> Floats:
    return ratio_or_zero(returns - returns.mean(), returns.std())


def _known(value: float | None) -> float:
    return math.nan if value is None else value
