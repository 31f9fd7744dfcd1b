"""What one table says about an agent, beside the reference and the best of its rivals.

The rivals are the reference at its best speed of rebalancing, and the best baseline.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.text import finite
from qfolio.portfolio.backtest.statistics.estimates import Estimate, clear, estimate
from qfolio.portfolio.backtest.statistics.measures import (
    log_growth,
    paired_difference,
    ratio_or_zero,
)

Against = Literal["to_reference", "to_rebalanced"]
AGAINST: tuple[Against, ...] = ("to_reference", "to_rebalanced")
"""What an agent is compared with: the reference, and its best rebalancing."""


class TableReturns(NamedTuple):
    """Simple daily returns on one table over the days of its test, each of shape (days,).

    agents: by name, each traded as ``allocate`` trades it. rebalancings: the reference first, then
    the reference at other speeds. baselines: all of them, the reference included. risk_free: of
    cash, which Sharpe ratios subtract; None if it earns nothing.
    """

    days: Sequence[str]
    periods_per_year: float
    agents: Mapping[str, Floats]
    rebalancings: Mapping[str, Floats]
    baselines: Mapping[str, Floats]
    risk_free: Floats | None = None


class Active(msgspec.Struct, frozen=True, kw_only=True):
    """An agent minus a reference on one table; numbers are annual, None if they are not finite."""

    reference: str
    growth: float | None  # difference in the growth of log wealth
    low: float | None  # 95% interval of the growth
    high: float | None
    tracking_error: float | None  # standard deviation of the differences in log return
    information_ratio: float | None  # growth over tracking error
    t: float | None  # growth over its standard error, which allows for autocorrelation
    z: float | None  # normal quantile of the one-sided test that the agent is better


class Evidence(msgspec.Struct, frozen=True, kw_only=True):
    """What one table says about one agent."""

    first: str
    last: str
    days: int
    years: float
    to_reference: Active
    to_rebalanced: Active  # minus the best rebalancing; z tests the claim that it beats them all
    baseline: str  # the one with the highest Sharpe ratio over the same days
    sharpe: float | None  # annual Sharpe ratio minus that of this baseline
    sharpe_t: float | None
    sharpe_z: float | None


def evidence(tested: TableReturns, agent: str) -> Evidence:
    """Compare an agent with its references on one table.

    The estimator is that of a backtest (``estimates.py``). The best rebalancing and the best
    baseline are chosen with hindsight. To beat the best rebalancing, an agent has to beat them all:
    its z is the least of them (an intersection–union test, Berger 1982).
    """
    ours, year = tested.agents[agent], tested.periods_per_year
    to = {
        name: estimate(ours[None], theirs[None], year)["growth"]
        for name, theirs in tested.rebalancings.items()
    }
    reference, best = next(iter(to)), _best_rebalancing(tested)
    baseline = _best_baseline(tested)
    theirs = tested.baselines[baseline]
    sharpe = estimate(ours[None], theirs[None], year, tested.risk_free)["sharpe"]
    return Evidence(
        first=tested.days[0],
        last=tested.days[-1],
        days=len(tested.days),
        years=len(tested.days) / year,
        to_reference=_active(tested, agent, reference, to[reference], z_of(to[reference])),
        to_rebalanced=_active(tested, agent, best, to[best], min(map(z_of, to.values()))),
        baseline=baseline,
        sharpe=finite(sharpe.value),
        sharpe_t=finite(_t(sharpe)),
        sharpe_z=finite(z_of(sharpe)),
    )


def active_returns(tested: TableReturns, agent: str, against: Against) -> Floats:
    """Daily differences in log return, of shape (days,)."""
    reference = next(iter(tested.rebalancings))
    name = reference if against == "to_reference" else _best_rebalancing(tested)
    return _differences(tested, agent, name)


def z_of(difference: Estimate) -> float:
    """The standard normal quantile of an estimate: as unlikely as its t, if there is no difference.

    It is 0 if the estimate is a rounding error, and NaN if its standard error is not known.
    """
    from scipy.special import ndtri, stdtr

    if not difference.known:
        return math.nan
    # The smallest number, where the tail is none: an infinite z would leave nothing to pool.
    tail = max(float(stdtr(difference.freedom, -abs(_t(difference)))), np.finfo(float).tiny)
    return math.copysign(float(ndtri(tail)), difference.value)


def _active(tested: TableReturns, agent: str, name: str, shown: Estimate, z: float) -> Active:
    # A total loss has no spread.
    daily = _differences(tested, agent, name) if shown.known else np.full(2, math.nan)
    spread = math.sqrt(tested.periods_per_year) * float(daily.std(ddof=1))
    low, high = shown.interval()
    return Active(
        reference=name,
        growth=finite(shown.value),
        low=finite(low),
        high=finite(high),
        tracking_error=finite(spread),
        information_ratio=finite(float(ratio_or_zero(clear(shown.value), spread))),
        t=finite(_t(shown)),
        z=finite(z),
    )


def _differences(tested: TableReturns, agent: str, name: str) -> Floats:
    """An agent's log returns less those of a rebalancing."""
    return paired_difference(
        log_growth(tested.agents[agent]), log_growth(tested.rebalancings[name])
    )


def _best_rebalancing(tested: TableReturns) -> str:
    growth = {name: float(log_growth(x).mean()) for name, x in tested.rebalancings.items()}
    return max(growth, key=lambda name: growth[name])


def _best_baseline(tested: TableReturns) -> str:
    """The baseline with the highest Sharpe ratio."""
    free = 0.0 if tested.risk_free is None else tested.risk_free

    def sharpe(name: str) -> float:
        excess = tested.baselines[name] - free
        return float(ratio_or_zero(excess.mean(), excess.std(ddof=1)))

    return max(tested.baselines, key=sharpe)


def _t(difference: Estimate) -> float:
    if not difference.known:
        return math.nan
    return float(ratio_or_zero(clear(difference.value), difference.error))
