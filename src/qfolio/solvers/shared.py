"""What the solvers of markets share: quadrature, checks and the cost of a trade in logs.

In all of them, relatives are price ratios over one step and cash has relative 1; costs are
proportional and one way (0.001 is 10 basis points); growth is the expected logarithm of the
ratio of wealth. Everything is float64.

A rebalancing of one asset and cash from weight w to weight b leaves the share (1 − c w)/(1 − c b)
of the wealth when it sells and (1 − c + c w)/(1 − c + c b) when it buys: a price that is cut by c
for the seller and divided by 1 − c for the buyer.
"""

import numpy as np

from qfolio.core.errors import QfolioError


def log_remainder(before: np.ndarray, after: np.ndarray, cost: float) -> np.ndarray:
    """Log of the wealth left by a rebalancing between weights of one asset; broadcasts."""
    buy = np.log1p(-cost * (1 - before)) - np.log1p(-cost * (1 - after))
    sell = np.log1p(-cost * before) - np.log1p(-cost * after)
    return np.asarray(np.where(after > before, buy, sell))


def gauss(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and probabilities that stand for a standard normal variable."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    return nodes, weights / weights.sum()


def require(holds: bool, sentence: str) -> None:
    if not holds:
        raise QfolioError(f"{sentence}.")
