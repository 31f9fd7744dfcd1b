"""Optimisers, fitted every month to the training window and all rows since; two are skfolio's."""

from abc import abstractmethod
from typing import Any

import numpy as np

from qfolio.portfolio.backtest.baselines.base import Fitted, Floats
from qfolio.solvers.risk_budgeting import equal_risk


class Optimiser(Fitted):
    """An estimator of skfolio that finds weights."""

    @abstractmethod
    def optimizer(self, cap: float) -> Any:
        """Make the estimator of skfolio."""

    def fit(self, returns: Floats, cap: float) -> Floats:
        from skfolio.exceptions import SkfolioError

        try:
            # skfolio raises ValueError if no portfolio has a positive return or returns are few.
            return np.asarray(self.optimizer(cap).fit(returns).weights_)
        except SkfolioError as error:
            raise ValueError(str(error)) from error


class MaximumRatio(Optimiser):
    """The long-only portfolio of the highest Sharpe ratio."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import MeanRisk, ObjectiveFunction

        return MeanRisk(objective_function=ObjectiveFunction.MAXIMIZE_RATIO, max_weights=cap)


class RiskBudgeting(Fitted):
    """Equal contributions to the variance (risk parity)."""

    def fit(self, returns: Floats, cap: float) -> Floats:
        return equal_risk(np.atleast_2d(np.cov(returns.T)))


class HierarchicalRiskParity(Optimiser):
    """Risk parity over a hierarchy of clusters (López de Prado, 2016)."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import HierarchicalRiskParity

        return HierarchicalRiskParity(max_weights=cap)
