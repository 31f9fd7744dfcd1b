"""Rules that follow trends: momentum across assets, and each asset above its own average."""

import math

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.baselines.base import Baseline, History, equal_weights, with_cash


class Momentum(Baseline):
    """Equal weights of the third of the assets that rose most over a year, its last month excluded.

    N. Jegadeesh and S. Titman, "Returns to Buying Winners and Selling Losers" (1993). If the cap
    would leave cash, more assets are held.
    """

    calendar, months = "month", 12

    def decide(self, history: History, held: Floats) -> Floats:
        prices = history.window(self.months)
        if len(prices) < history.month + 2:
            return with_cash(equal_weights(history), history)
        rose = prices[-1 - history.month] / prices[0]
        count = max(math.ceil(rose.size / 3), min(math.ceil(1 / history.cap - 1e-9), rose.size))
        weights = np.zeros(rose.size)
        weights[np.argsort(-rose, kind="stable")[:count]] = min(1 / count, history.cap)
        return with_cash(weights, history)


class Trend(Baseline):
    """Equal weights of the assets above their average price of ten months; cash for the others.

    M. Faber, "A Quantitative Approach to Tactical Asset Allocation" (2007).
    """

    calendar, months = "month", 10

    def decide(self, history: History, held: Floats) -> Floats:
        prices = history.window(self.months)[1:]
        rising = prices[-1] > prices.mean(axis=0)
        return with_cash(equal_weights(history) * rising, history)
