"""Sifting: an optimum over many assets from optima over few of them.

Most weights of a long-only optimum are zero. The problem is solved for some of the assets; others
that would then be bought are added, until there are none (R. Bixby et al., "Very Large-Scale Linear
Programming", 1992, for columns of linear programs). The result is the optimum over all.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Floats

FIRST = 100
"""Number of assets at the start (or more, for a low cap), and the most added at a time."""


def sift(
    order: Floats,
    cap: float,
    solve: Callable[[NDArray[np.intp]], Floats],
    price: Callable[[Floats], Floats],
    tol: float,
) -> Floats:
    """The optimal weights of all assets.

    Args:
        order: The assets with the smallest numbers are tried first, shape (asset,).
        cap: Largest weight of one asset.
        solve: Returns the optimal weights of some assets alone, given their indices.
        price: Returns the marginal cost of each asset, given the weights of all. At an optimum no
            asset costs less than one that is held, unless the cheaper one is at the cap.
        tol: Smaller differences between these costs count as rounding errors.

    Returns:
        Weights of shape (asset,).
    """
    count = len(order)
    chosen = np.zeros(count, dtype=bool)
    chosen[np.argsort(order, kind="stable")[: max(FIRST, int(np.ceil(2 / cap)))]] = True
    while True:
        weights = np.zeros(count)
        weights[chosen] = solve(np.flatnonzero(chosen))
        costs = price(weights)
        cheap = np.where(chosen, np.inf, costs) < costs[weights > 0].max() - tol
        if not cheap.any():
            return weights
        found = np.flatnonzero(cheap)
        chosen[found[np.argsort(costs[found], kind="stable")[:FIRST]]] = True
