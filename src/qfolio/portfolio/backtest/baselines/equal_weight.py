"""Equal weights: rebalanced at every row, every month, within a band, or never."""

from typing import ClassVar

import numpy as np

from qfolio.portfolio.backtest.baselines.base import (
    Baseline,
    Floats,
    History,
    equal_weights,
    nearest,
    with_cash,
)


class EqualWeight(Baseline):
    """The same weight in every asset, rebalanced at every row."""

    def decide(self, history: History, held: Floats) -> Floats:
        return with_cash(equal_weights(history), history)


class EqualWeightMonthly(EqualWeight):
    """The same weight in every asset, rebalanced every month."""

    calendar = "month"


class EqualWeightBand(Baseline):
    """Equal weights with a no-trade band: a weight that leaves it is traded back to its edge.

    The band reaches a fifth of the target to either side (Daryanani 2008). Under proportional costs
    it is best to trade to the edge and no further (Davis & Norman 1990).
    """

    calendar = "row"
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

    def decide(self, history: History, held: Floats) -> Floats | None:
        return None if held[1:].any() else with_cash(equal_weights(history), history)
