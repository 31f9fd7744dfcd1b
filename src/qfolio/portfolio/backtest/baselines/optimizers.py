"""The highest Sharpe ratio and two kinds of risk parity, on the training window and since."""

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.baselines.base import Fitted
from qfolio.solvers.maximum_ratio import maximum_ratio
from qfolio.solvers.risk_budgeting import equal_risk

ORDERED = 300
"""Largest number of assets whose tree is ordered; the time grows with its fourth power."""


class MaximumRatio(Fitted):
    """The long-only portfolio of the highest Sharpe ratio."""

    def fit(self, returns: Floats, cap: float) -> Floats:
        return maximum_ratio(returns.mean(axis=0), np.atleast_2d(np.cov(returns.T)), cap)


class RiskBudgeting(Fitted):
    """Equal contributions to the variance (risk parity)."""

    def fit(self, returns: Floats, cap: float) -> Floats:
        return equal_risk(np.atleast_2d(np.cov(returns.T)))


class HierarchicalRiskParity(Fitted):
    """Risk parity over a hierarchy of clusters.

    M. López de Prado, "Building Diversified Portfolios that Outperform Out of Sample" (2016): a
    tree built on correlations orders the assets, and this order is halved again and again; the two
    halves of each cluster share its weight in inverse proportion to their variances, with weights
    ∝ 1/σ² inside. The tree is Ward's, and its leaves are ordered so that neighbors are as close as
    possible, as in skfolio. Beyond ``ORDERED`` assets, the order is the tree's own, as in the
    paper.
    """

    def fit(self, returns: Floats, cap: float) -> Floats:
        from scipy.cluster.hierarchy import leaves_list, linkage
        from scipy.spatial.distance import squareform

        covariance = np.atleast_2d(np.cov(returns.T))
        variances = np.diag(covariance)
        weights = np.ones(len(variances))
        if len(weights) == 1:
            return weights

        def variance(cluster: NDArray[np.int32]) -> float:
            inside = 1 / variances[cluster]
            inside /= inside.sum()
            return float(inside @ covariance[np.ix_(cluster, cluster)] @ inside)

        correlations = covariance / np.sqrt(np.outer(variances, variances))
        distances = np.sqrt(np.clip((1 - correlations) / 2, 0, 1))
        near = squareform(distances, checks=False)
        clusters = [leaves_list(linkage(near, "ward", optimal_ordering=len(weights) <= ORDERED))]
        while clusters:
            cluster = clusters.pop()
            left, right = np.array_split(cluster, [len(cluster) // 2])
            one, other = variance(left), variance(right)
            weights[left] *= other / (one + other)
            weights[right] *= one / (one + other)
            clusters += [half for half in (left, right) if len(half) > 1]
        return weights
