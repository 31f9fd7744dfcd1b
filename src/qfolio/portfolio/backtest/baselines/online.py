"""On-line portfolio selection: rules that move a little at every row and estimate nothing.

Each decision moves the last target by a step that depends on the latest prices. That target is not
stored: prices have turned it into the holding, so the holding divided by the price relatives is
proportional to it. Where a calendar has fewer decisions than rows, this gives the holding of the
row before instead of the last target.
"""

from abc import abstractmethod

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.baselines.base import (
    Baseline,
    History,
    equal_weights,
    nearest,
    with_cash,
)

ROWS = 5
"""Rows that a step sees: those that OLMAR averages."""


class Online(Baseline):
    """A rule that starts with equal weights and takes a step at every row."""

    calendar, months, least = "row", 0, ROWS - 1

    @abstractmethod
    def step(self, target: Floats, prices: Floats) -> Floats:
        """Return the direction in which the target moves, of shape (assets,).

        Args:
            target: The weights of the last order, of shape (assets,); see above.
            prices: The latest prices, of shape (``ROWS``, assets).
        """

    def decide(self, history: History, held: Floats) -> Floats:
        prices = history.prices[-ROWS:, history.tradable]
        weights = held[1:][history.tradable]
        if not weights.any():
            return with_cash(equal_weights(history), history)
        target = weights / (prices[-1] / prices[-2])
        target /= target.sum()
        return with_cash(nearest(target + self.step(target, prices), 0, history.cap), history)


class Pamr(Online):
    """Passive aggressive mean reversion: after a gain, away from what rose.

    B. Li, P. Zhao, S. Hoi and V. Gopalkrishnan, "PAMR: Passive Aggressive Mean Reversion Strategy
    for Portfolio Selection" (2012), without slack: b ← Π(b − τ(x − x̄)) with
    τ = (b·x − ε)⁺/‖x − x̄‖² and ε = 0.5.
    """

    def step(self, target: Floats, prices: Floats) -> Floats:
        relatives = prices[-1] / prices[-2]
        return -_reach(relatives, target @ relatives - 0.5)


class Olmar(Online):
    """On-line moving average reversion: towards what is below its average of five rows.

    B. Li and S. Hoi, "On-Line Portfolio Selection with Moving Average Reversion" (2012):
    b ← Π(b + λ(x̃ − mean x̃)), where x̃ is the average price of five rows over the latest price and
    λ = (ε − b·x̃)⁺/‖x̃ − mean x̃‖² with ε = 10.
    """

    def step(self, target: Floats, prices: Floats) -> Floats:
        predicted = prices[-ROWS:].mean(axis=0) / prices[-1]
        return _reach(predicted, 10 - target @ predicted)


def _reach(relatives: Floats, missing: float) -> Floats:
    """The shortest step of sum 0 along which b·x rises by what is missing, if it is positive."""
    excess = relatives - relatives.mean()
    square = excess @ excess
    return np.asarray(max(missing, 0.0) / square * excess if square > 0 else 0 * excess)
