"""Baselines: the rules that agents are compared with.

A baseline decides as an agent does: it sees the rows up to a decision and its holding, and returns
target weights. ``orders.py`` runs it over the folds of a test; skfolio fits the optimisers.
"""

import warnings
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.registry import imported

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class History(NamedTuple):
    """The data of a baseline's decision, with T rows up to the decision and N assets."""

    dates: NDArray[np.datetime64]  # (T,)
    prices: Floats  # (T, N), NaN before an asset's first price
    train: slice  # rows of the fold's training window, which ends at its first decision or earlier
    tradable: Bools  # (N,), assets that may be held; they have prices in the whole training window
    cap: float  # largest weight of one asset when it is ordered

    @property
    def returns(self) -> Floats:
        """Simple returns of the tradable assets over the training window, (rows − 1, assets)."""
        window = self.prices[self.train][:, self.tradable]
        return np.asarray(window[1:] / window[:-1] - 1)


class Baseline(ABC):
    """A rule that decides on weights; subclasses take no constructor arguments.

    A warning in ``decide`` becomes a note in the report, with the baseline and the fold.

    Attributes:
        calendar: When ``decide`` is called. "fold": at the first decision of each fold; its result
            is the target of every row of the fold, so that drift is traded back daily.
            "row": at every row; None then lets the holding drift.
    """

    calendar: ClassVar[Literal["fold", "row"]] = "fold"

    @abstractmethod
    def decide(self, history: History, held: Floats) -> Floats | None:
        """Return target weights, or None for no order.

        Args:
            history: All rows up to the decision, and none after it.
            held: Weights at the decision, cash first, of shape (N + 1,): the last order, drifted
                with prices. All cash before the first order.

        Returns:
            Target weights of shape (N + 1,), cash first, or None for no order.
        """


class EqualWeight(Baseline):
    """The same weight in every asset, rebalanced daily."""

    def decide(self, history: History, held: Floats) -> Floats:
        return with_cash(equal_weights(history), history)


class BuyAndHold(Baseline):
    """Equal weights bought once and never traded again."""

    calendar = "row"

    def decide(self, history: History, held: Floats) -> Floats | None:
        return None if held[1:].any() else with_cash(equal_weights(history), history)


class Fitted(Baseline):
    """An optimiser of skfolio, fitted to the training window of each fold.

    If it finds no solution, weights are equal, with a warning. If it does not support a cap, the
    excess goes to the assets below the cap, in proportion to their weights. If the cap is too low
    for the assets to hold everything, all are at the cap and the rest is cash.
    """

    @abstractmethod
    def optimizer(self, cap: float) -> Any:
        """Make the estimator of skfolio."""

    def decide(self, history: History, held: Floats) -> Floats:
        equal = equal_weights(history)
        if history.cap * equal.size <= 1 + 1e-9:
            return with_cash(equal, history)

        from skfolio.exceptions import SkfolioError

        try:
            # skfolio raises ValueError if no portfolio has a positive return or returns are few.
            found = np.maximum(self.optimizer(history.cap).fit(history.returns).weights_, 0)
            if not 0 < found.sum() < np.inf:
                raise ValueError("the weights found are not numbers")
        except (SkfolioError, ValueError) as error:
            warnings.warn(f"no solution, so weights are equal: {error}", stacklevel=1)
            return with_cash(equal, history)
        return with_cash(_capped(found, history.cap), history)


class InverseVolatility(Fitted):
    """Weights in inverse proportion to volatility."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import InverseVolatility

        return InverseVolatility()


class MinimumVariance(Fitted):
    """The long-only portfolio of least variance."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import MeanRisk

        return MeanRisk(max_weights=cap)


class MaximumRatio(Fitted):
    """The long-only portfolio of the highest Sharpe ratio."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import MeanRisk, ObjectiveFunction

        return MeanRisk(objective_function=ObjectiveFunction.MAXIMIZE_RATIO, max_weights=cap)


class RiskBudgeting(Fitted):
    """Equal contributions to the variance (risk parity)."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import RiskBudgeting

        return RiskBudgeting(max_weights=cap)


class HierarchicalRiskParity(Fitted):
    """Risk parity over a hierarchy of clusters (López de Prado, 2016)."""

    def optimizer(self, cap: float) -> Any:
        from skfolio.optimization import HierarchicalRiskParity

        return HierarchicalRiskParity(max_weights=cap)


def baseline(name: str) -> Baseline:
    """Make a baseline by its name, or by ``module:Name`` if that module has been imported.

    Raises:
        QfolioError: There is none, or its module has not been imported.
    """
    made: Baseline = imported("baseline", name)()
    return made


def equal_weights(history: History) -> Floats:
    """Equal weights of the tradable assets, at most the cap."""
    count = int(history.tradable.sum())
    return np.full(count, min(1 / count, history.cap))


def with_cash(weights: ArrayLike, history: History) -> Floats:
    """Weights of the tradable assets as a target: cash, the rest, comes first."""
    wanted = np.asarray(weights, dtype=float)
    target = np.zeros(len(history.tradable) + 1)
    target[1:][history.tradable] = wanted
    target[0] = max(0.0, 1 - wanted.sum())
    return target


def _capped(proposed: Floats, cap: float) -> Floats:
    """Weights of sum 1 that are at most the cap; those below it keep their proportions."""
    capped = proposed / proposed.sum()
    free = np.ones(len(capped), dtype=bool)
    while (over := free & (capped > cap)).any():
        free &= ~over
        capped[~free] = cap
        rest = 1 - cap * (~free).sum()
        share = capped[free].sum()
        capped[free] = capped[free] * (rest / share) if share > 0 else rest / free.sum()
    return capped
