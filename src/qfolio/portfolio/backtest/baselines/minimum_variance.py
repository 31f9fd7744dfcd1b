"""The long-only portfolio of least variance, on four estimates of the covariance.

The first is the sample covariance over the training window and since. The others use the latest
twelve months, as Ledoit & Wolf (2017, "Markowitz meets Goldilocks") do with daily returns.
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


class MinimumVarianceLedoitWolf(MinimumVariance):
    """Least variance on linear shrinkage."""

    months = 12

    def covariance(self, returns: Floats) -> Floats:
        return ledoit_wolf(returns)


class MinimumVarianceNonlinear(MinimumVariance):
    """Least variance on nonlinear shrinkage."""

    months = 12

    def covariance(self, returns: Floats) -> Floats:
        return nonlinear(returns)


class MinimumVarianceEwma(MinimumVariance):
    """Least variance on an exponentially weighted covariance."""

    months = 12

    def covariance(self, returns: Floats) -> Floats:
        return exponential(returns)
