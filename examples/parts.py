"""A signal and a cost model, as files of a user's own hold them."""

from dataclasses import dataclass

import numpy as np

from qfolio.portfolio.costs import Proportional
from qfolio.portfolio.signals import Signal


class Trend(Signal):
    """The slope of the log price over its rows, relative to its volatility."""

    def measure(self, prices, rows):
        found = np.full(prices.shape, np.nan)
        time = np.arange(rows) - (rows - 1) / 2
        for row in range(rows, len(prices)):
            logs = np.log(prices[row + 1 - rows : row + 1])
            slope = (time[:, None] * logs).sum(0) / (time**2).sum()
            found[row] = slope / np.diff(logs, axis=0).std(0)
        return found


@dataclass(frozen=True)
class PerOrder(Proportional):
    """Proportional costs, and a fee for each day with an order."""

    fee: float = 2e-5  # share of the wealth

    def trade(self, before, after, context):
        left, kinds = super().trade(before, after, context)
        fee = self.fee * (left < 1)
        return left * (1 - fee), kinds | {"fee": left * fee}
