"""Anchors: weights at each row of a table that a policy may depart from."""

import numpy as np
from numpy.typing import NDArray

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices.table import Prices


def path(name: str, prices: Prices) -> NDArray[np.float64]:
    """The weights of an anchor at each row, (row, asset); the rest is cash.

    Raises QfolioError if there is no such anchor.
    """
    if name != "equal-weight":
        raise QfolioError(f"anchor is {name!r}; it must be equal-weight.")
    known = ~np.isnan(prices.values)
    return known / np.maximum(known.sum(1, keepdims=True), 1)
