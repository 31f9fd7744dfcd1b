"""Growth of holdings between the rows of a table, for replays and for baselines' orders alike."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel, by_sign, cashed

Rows = NDArray[np.intp] | np.intp | int


class Growth:
    """Growth factors of cash and assets between any two rows of a table.

    prices: complete prices, see ``filled_in``. first: their first row, in the rows of the
    conditions.
    """

    def __init__(
        self, prices: Floats, costs: CostModel, conditions: Conditions, first: int = 0
    ) -> None:
        self.prices, self.costs, self.conditions, self.first = prices, costs, conditions, first
        self._index = None if conditions.listed is None else self._indices()

    def between(self, start: Rows, end: Rows) -> list[Floats]:
        """Growth factors of each entry from one row to another, cash first.

        Those of what is owned come before those of what is owed; there is only the first if they
        are the same.
        """
        if self._index is not None:
            return [np.asarray(index[end] / index[start]) for index in self._index]
        relatives = self.prices[end] / self.prices[start]
        context = self.conditions.holding(start + self.first, end + self.first)
        return [np.asarray(growth) for growth in self.costs.factors(relatives, context)]

    def held(self, weights: Floats, start: int, end: int) -> Floats:
        """Weights of shape (N + 1,) at a row, drifted to another; cash once all is lost.

        Assets delisted by then are cash.
        """
        worth = weights * by_sign(weights, self.between(start, end))
        total = worth.sum()
        after = np.asarray(worth / total if total > 0 else np.eye(len(worth))[0])
        listed = self.conditions.listed
        return after if listed is None else np.asarray(cashed(after, listed[end + self.first]))

    def _indices(self) -> list[Floats]:
        """The products of growth factors from the first row to each."""
        start = np.arange(len(self.prices) - 1)
        relatives = self.prices[1:] / self.prices[:-1]
        context = self.conditions.holding(start + self.first, start + self.first + 1)
        ones = np.ones((1, relatives.shape[1] + 1))
        return [
            np.cumprod(np.concatenate([ones, growth]), axis=0)
            for growth in self.costs.factors(relatives, context)
        ]


def filled_in(values: ArrayLike) -> tuple[Floats, Bools]:
    """Checked prices, with each asset's first price filled in before its start, and a mask."""
    prices = np.asarray(values, dtype=float)
    if prices.ndim != 2:
        raise QfolioError(f"Prices have the shape {prices.shape}; it must be (rows, assets).")
    begun = ~np.isnan(prices)
    fits = (prices > 0) & (prices < np.inf)
    if not fits.all():
        wrong = (begun & ~fits) | (np.maximum.accumulate(begun) & ~begun)
        if wrong.any():
            row, asset = np.argwhere(wrong)[0]
            raise QfolioError(
                f"The price of asset {asset} (counted from 0) at row {row} is "
                f"{prices[row, asset]:g}; from its first price on all must be positive and finite."
            )
        starts = prices[begun.argmax(0), np.arange(prices.shape[1])]
        prices = np.where(begun, prices, np.where(begun.any(0), starts, 1))
    return prices, begun
