"""The long-only portfolio of least variance, on four estimates of the covariance.

The first is the sample covariance over the training window and since. The others use the latest
twelve months, as Ledoit & Wolf (2017, "Markowitz meets Goldilocks") do with daily returns; where
rows are rare, the latest 60 rows, as many as DeMiguel, Garlappi & Uppal (2009) use of months.
"""

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.baselines.base import Fitted
from qfolio.portfolio.backtest.baselines.covariance import exponential, ledoit_wolf, nonlinear
from qfolio.solvers.minimum_variance import minimum_variance


class MinimumVariance(Fitted):
    """Least variance on the sample covariance."""

    def covariance(self, returns: Floats) -> Floats:
        return np.atleast_2d(np.cov(returns.T))

    def fit(self, returns: Floats, cap: float) -> Floats:
        return minimum_variance(self.covariance(returns), cap)


class RecentMinimumVariance(MinimumVariance):
    """Least variance on the sample covariance of the latest year."""

    months, least = 12, 60


class MinimumVarianceLedoitWolf(RecentMinimumVariance):
    """Least variance on linear shrinkage."""

    def covariance(self, returns: Floats) -> Floats:
        return ledoit_wolf(returns)


class MinimumVarianceNonlinear(RecentMinimumVariance):
    """Least variance on nonlinear shrinkage."""

    def covariance(self, returns: Floats) -> Floats:
        return nonlinear(returns)


class MinimumVarianceEwma(RecentMinimumVariance):
    """Least variance on an exponentially weighted covariance."""

    def covariance(self, returns: Floats) -> Floats:
        return exponential(returns)
