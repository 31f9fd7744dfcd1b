"""What a baseline is, and what baselines share."""

import warnings
from abc import ABC, abstractmethod
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError
from qfolio.core.registry import imported

Calendar = Literal["fold", "month", "row"]
"""When a baseline decides; see ``Baseline``."""


class History(NamedTuple):
    """The data of a baseline's decision, with T rows up to the decision and N assets."""

    dates: NDArray[np.datetime64]  # (T,)
    prices: Floats  # (T, N), NaN before an asset's first price
    train: slice  # rows of the fold's training window, which ends at its first decision or earlier
    tradable: Bools  # (N,), assets that may be held; they have prices in the whole training window
    cap: float  # largest weight of one asset when it is ordered
    month: int = 21  # rows in a month

    def window(self, months: int | None = None, least: int = 0) -> Floats:
        """Prices of the tradable assets from the start of the training window to the decision.

        Args:
            months: Only the returns of this many latest months, if there are so many.
            least: Number of returns below which these months are too few, if rows are rare.

        Returns:
            Prices of shape (rows, assets), without gaps; one row more than there are returns.
        """
        start = self.train.start or 0
        if months is not None:
            start = max(start, len(self.prices) - window_rows(months, least, self.month))
        return np.asarray(self.prices[start:][:, self.tradable])

    def returns(self, months: int | None = None, least: int = 0) -> Floats:
        """Simple returns over ``window``, of shape (rows, assets)."""
        prices = self.window(months, least)
        return np.asarray(prices[1:] / prices[:-1] - 1)


class Baseline(ABC):
    """A rule that decides on weights; subclasses take no constructor arguments.

    A warning in ``decide`` becomes a note in the report, with the baseline and the fold.

    Attributes:
        calendar: When ``decide`` is called. "fold": at the first decision of each fold, and where
            the assets that may be bought have changed since; its result is the target of every row
            from there on, so that drift is traded back at every row. "month": every
            ``History.month`` rows from the first decision of the test on; the holding drifts in
            between. "row": at every row; None then lets the holding drift.
        estimates: Whether ``decide`` reads past prices. If not, it may hold any asset that is
            available at the decision, where assets come and go.
        months: Latest months whose returns it reads (default: the training window and all rows
            since).
        least: Number of returns that it reads at least, if there are so many.
        buys_once: Whether what its first target lacks is bought until limits on turnover no longer
            cut the purchase, and each order is filled before ``decide`` is called again.
    """

    calendar: ClassVar[Calendar] = "fold"
    estimates: ClassVar[bool] = True
    buys_once: ClassVar[bool] = False
    months: ClassVar[int | None] = None
    least: ClassVar[int] = 0

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


class Fitted(Baseline):
    """Weights that are estimated from past returns, anew every month.

    If there is no solution, weights are equal, with a warning. The excess of a weight over the cap
    goes to the assets below the cap, in proportion to their weights. If the cap is too low for the
    assets to hold everything, all are at the cap and the rest is cash.
    """

    calendar = "month"

    @abstractmethod
    def fit(self, returns: Floats, cap: float) -> Floats:
        """Return weights of shape (assets,) up to a factor; raise ValueError if there are none.

        Args:
            returns: Simple returns of shape (rows, assets), each asset with some variance.
            cap: Largest weight of one asset; it may be ignored.
        """

    def decide(self, history: History, held: Floats) -> Floats:
        equal = equal_weights(history)
        if history.cap * equal.size <= 1 + 1e-9:
            return with_cash(equal, history)
        returns = history.returns(self.months, self.least)
        try:
            if len(returns) < 3 or not np.ptp(returns, axis=0).all():
                raise ValueError("the returns of an asset are too few or have no variance")
            found = np.maximum(self.fit(returns, history.cap), 0)
            if not 0 < found.sum() < np.inf:
                raise ValueError("no asset is worth holding")
        except (QfolioError, ValueError) as error:
            warnings.warn(f"no solution, so weights are equal: {error}", stacklevel=1)
            return with_cash(equal, history)
        return with_cash(_capped(found, history.cap), history)


def baseline(name: str) -> Baseline:
    """Make a baseline by its name, or by ``module:Name`` if that module has been imported.

    Raises:
        QfolioError: There is no such baseline, or its module has not been imported.
    """
    made: Baseline = imported("baseline", name)()
    return made


def window_rows(months: int, least: int, month: int) -> int:
    """Rows of prices that give the returns of some latest months, and at least ``least`` returns.

    month: rows in a month.
    """
    return max(months * month, least) + 1


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


def nearest(wanted: Floats, low: Floats | float, high: Floats | float) -> Floats:
    """The weights between bounds and of sum 1 that are nearest to those wanted.

    They are clip(wanted − τ, low, high) for the one τ that makes the sum 1, which falls piecewise
    linearly in τ. If the upper bounds add up to less than 1, all weights are at them.

    Args:
        wanted: Numbers of shape (assets,).
        low, high: Bounds, numbers or of the same shape; the lower ones add up to 1 or less.
    """
    kinks = np.concatenate([wanted - high, wanted - low])  # where a weight starts and stops falling
    order = np.argsort(kinks)
    kinks, falling = kinks[order], np.cumsum(np.where(order < wanted.size, 1, -1))
    fallen = np.concatenate([[0.0], np.cumsum(falling[:-1] * np.diff(kinks))])
    excess = np.broadcast_to(high, wanted.shape).sum() - 1
    return np.clip(wanted - np.interp(excess, fallen, kinks), low, high)


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
