"""Where a return came from: constant weights, the timing of weights, and costs.

A day's net return is R = Σᵢ wᵢrᵢ − c, with weights w after the trade, returns r of cash and assets
while they were held, and the day's cost c. Over all days the mean of Σᵢ wᵢrᵢ is Σᵢ w̄ᵢr̄ᵢ, what
constant weights would have earned, plus Σᵢ cov(wᵢ, rᵢ), what was earned by holding more of an asset
on its better days (Lo 2008, "Where do alphas come from?"). All parts are arithmetic and add up
exactly. Where assets come and go, equal weights differ from day to day; so the weights that are
constant are those in excess of equal weights, and equal weights alone have no timing.

The mean weights are known only at the end, and those of a holding that drifts are high for the
assets that did well. So a holding that is never traded seems to lose by timing what it seems to
earn by constant tilts, and only the sum of the two has a t-statistic: on each day, its weights are
known before the return.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.attribution.hac import mean_t


class AssetPart(msgspec.Struct, frozen=True):
    """The annual contribution of cash or of an asset."""

    name: str
    weight: float  # the mean
    static: float  # what the mean of its weight earned, in excess of a changing equal weight
    timing: float  # covariance of that weight and return


class FoldPart(msgspec.Struct, frozen=True):
    """A fold's parts, annualized over its own days: static + timing − cost = net.

    static: return of the mean weights (in excess of equal weights) of the whole test. timing:
    return of departures from them.
    """

    name: str
    static: float
    timing: float
    cost: float
    net: float


class Decomposition(msgspec.Struct, frozen=True):
    """The parts of the annual arithmetic mean return: equal + tilts + timing − cost = net."""

    net: float
    equal: float  # return of equal weights of all assets that may be held, without costs
    tilts: float  # what the mean weights earned beyond that
    timing: float
    active_t: float  # HAC t-statistic of tilts + timing
    cost: float
    assets: list[AssetPart]  # cash first
    folds: list[FoldPart]

    @property
    def static(self) -> float:
        return self.equal + self.tilts


def decompose(
    net: Floats,
    weights: Floats,
    returns: Floats,
    folds: dict[str, slice],
    assets: Sequence[str],
    periods_per_year: float,
    open_to: np.ndarray | None = None,
) -> Decomposition:
    """Decompose a strategy's mean net return.

    Args:
        net: Net returns, shape (D,).
        weights: After each day's trade, cash first, shape (D, N + 1).
        returns: Returns of cash and assets while these weights were held, same shape.
        folds: The days of each fold, by its name.
        assets: Names of the N assets.
        periods_per_year: For example 252 for trading days.
        open_to: Whether an asset could be held on a day, shape (D, N) (default: all could).
    """
    year = periods_per_year
    there = np.ones_like(weights[:, 1:]) if open_to is None else open_to
    even = np.zeros_like(weights)
    even[:, 1:] = there / np.maximum(there.sum(1, keepdims=True), 1)
    active = weights - even
    parts, moves = weights * returns, (active - active.mean(0)) * returns
    equal, earned, timed = (even * returns).sum(1), parts.sum(1), moves.sum(1)
    static, cost = earned - timed, earned - net
    constant = (parts - moves).mean(0)
    return Decomposition(
        net=year * float(net.mean()),
        equal=year * float(equal.mean()),
        tilts=year * float((static - equal).mean()),
        timing=year * float(timed.mean()),
        active_t=mean_t(earned - equal),
        cost=year * float(cost.mean()),
        assets=[
            AssetPart(name, float(weight), year * float(own), year * float(moved))
            for name, weight, own, moved in zip(
                ("cash", *assets), weights.mean(0), constant, moves.mean(0), strict=True
            )
        ],
        folds=[
            FoldPart(
                name, *(year * float(part[days].mean()) for part in (static, timed, cost, net))
            )
            for name, days in folds.items()
        ],
    )
