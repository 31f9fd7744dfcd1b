"""Timing by volatility and by reward to risk: each asset on its own, without correlations.

C. Kirby and B. Ostdiek, "It's All in the Timing: Simple Active Portfolio Strategies That Outperform
Naïve Diversification" (2012), with rolling windows of 120 months and η = 1, 2 or 4. Here η is 2,
the middle one, and returns are those of the table's rows.
"""

from typing import ClassVar

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.baselines.base import Fitted


class InverseVolatility(Fitted):
    """Weights in inverse proportion to volatility."""

    def fit(self, returns: Floats, cap: float) -> Floats:
        return np.asarray(1 / returns.std(axis=0))


class VolatilityTiming(Fitted):
    """Weights in proportion to (1/σ²)^η."""

    months = 120
    eta: ClassVar[float] = 2.0

    def fit(self, returns: Floats, cap: float) -> Floats:
        variance = returns.var(axis=0)
        return np.asarray((variance.min() / variance) ** self.eta)


class RewardToRiskTiming(VolatilityTiming):
    """Weights in proportion to (μ⁺/σ²)^η, where μ⁺ is the mean return, or 0 if it is negative.

    What cash earns is not subtracted.
    """

    def fit(self, returns: Floats, cap: float) -> Floats:
        ratio = np.maximum(returns.mean(axis=0), 0) / returns.var(axis=0)
        return np.asarray((ratio / (ratio.max() or 1)) ** self.eta)
