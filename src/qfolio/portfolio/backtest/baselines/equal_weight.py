"""Equal weights: rebalanced at every row, every month, slowly, within a band, or never."""

from typing import ClassVar

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.baselines.base import (
    Baseline,
    History,
    equal_weights,
    nearest,
    with_cash,
)

SPEEDS = (0.3, 0.1, 0.03, 0.01, 0.0)
"""Speeds of rebalancing, besides 1, from which a backtest chooses the best in hindsight."""


class EqualWeight(Baseline):
    """The same weight in every asset, rebalanced at every row."""

    estimates = False

    def decide(self, history: History, held: Floats) -> Floats:
        return with_cash(equal_weights(history), history)


class EqualWeightMonthly(EqualWeight):
    """The same weight in every asset, rebalanced every month."""

    calendar = "month"


class EqualWeightAt(Baseline):
    """Equal weights bought once, then traded a share of the way back to them at every row.

    Agents are compared with the best of several speeds, because rebalancing at every row pays
    costs that any slower trading saves.
    """

    calendar = "row"
    estimates = False
    buys_once = True

    def __init__(self, speed: float) -> None:
        self.speed = speed  # share of the way, from 0 (never) to 1

    def decide(self, history: History, held: Floats) -> Floats | None:
        target, weights = equal_weights(history), held[1:][history.tradable]
        if not weights.any():
            return with_cash(target, history)
        if self.speed == 0:
            return None
        wanted = weights + self.speed * (target - weights)
        # A holding may have drifted above the cap, or a mandate forced it into debt or short sales.
        if wanted.max() > history.cap or wanted.min() < 0 or wanted.sum() > 1 + 1e-9:
            wanted = nearest(wanted, 0, history.cap)
        return with_cash(wanted, history)


class EqualWeightBand(Baseline):
    """Equal weights with a no-trade band: a weight that leaves it is traded back to its edge.

    The band reaches a fifth of the target to either side (Daryanani 2008). Under proportional costs
    it is best to trade to the edge and no further (Davis & Norman 1990).
    """

    calendar = "row"
    estimates = False
    width: ClassVar[float] = 0.2

    def decide(self, history: History, held: Floats) -> Floats | None:
        target, weights = equal_weights(history), held[1:][history.tradable]
        low, high = (1 - self.width) * target, (1 + self.width) * target
        if ((low <= weights) & (weights <= high)).all():
            return None
        return with_cash(nearest(weights, low, np.minimum(high, history.cap)), history)


class BuyAndHold(Baseline):
    """Equal weights bought once and never traded again."""

    calendar = "row"
    estimates = False
    buys_once = True

    def decide(self, history: History, held: Floats) -> Floats | None:
        return None if held[1:].any() else with_cash(equal_weights(history), history)
