"""Shared by the solvers of markets: quadrature, checks, steps and the log cost of a trade.

In all of them, relatives are price ratios over one step, and cash has relative 1 unless a rate is
given; costs are proportional and one way (0.001 is 10 basis points); growth is the expected
logarithm of the ratio of wealth. Everything is float64.

Rebalancing one asset and cash from weight w to weight b leaves the share (1 − c w)/(1 − c b) of the
wealth when selling and (1 − c + c w)/(1 − c + c b) when buying: the seller receives 1 − c times the
price, the buyer pays the price divided by 1 − c.
"""

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError


def log_remainder(before: np.ndarray, after: np.ndarray, cost: float) -> np.ndarray:
    """Log of the share of wealth left by rebalancing one asset between two weights; broadcasts."""
    buy = np.log1p(-cost * (1 - before)) - np.log1p(-cost * (1 - after))
    sell = np.log1p(-cost * before) - np.log1p(-cost * after)
    return np.asarray(np.where(after > before, buy, sell))


def gauss(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Hermite nodes and probabilities of a standard normal variable."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    return nodes, weights / weights.sum()


def step_length(*moves: tuple[np.ndarray, np.ndarray]) -> float:
    """How much of an interior-point step to take, at most 1: all values stay positive.

    moves: values, and their changes in the whole step.
    """
    length = 1.0
    for value, change in moves:
        falling = change < 0
        length = min(length, 0.99 * float(np.min(-value[falling] / change[falling], initial=2)))
    return length


def at_bounds(weights: Floats, *, empty: Bools, full: Bools, cap: float) -> Floats:
    """Weights that are exactly 0 or the cap where they should be; the others fill up to 1."""
    w = np.where(full, cap, np.where(empty, 0, weights))
    inside = ~full & ~empty
    w[inside] *= (1 - w[~inside].sum()) / w[inside].sum() if inside.any() else 1
    return w


def square(covariance: ArrayLike) -> Floats:
    """A covariance as an array; raises QfolioError unless it is square, finite and symmetric."""
    sigma = np.asarray(covariance, dtype=float)
    require(
        sigma.ndim == 2 and sigma.shape[0] == sigma.shape[1] and bool(np.isfinite(sigma).all()),
        f"a covariance must be a square table of finite numbers; this one has shape {sigma.shape}",
    )
    least = 1e-8 * float(abs(sigma).max(initial=0))
    require(bool(np.allclose(sigma, sigma.T, atol=least)), "a covariance must be symmetric")
    return sigma


def solve(system: Floats, right: Floats) -> Floats:
    """The solution of a linear system; NaN if it is singular, so that the caller's search ends."""
    try:
        return np.asarray(np.linalg.solve(system, right))
    except np.linalg.LinAlgError:
        return np.full(right.shape, np.nan)


def require(holds: bool, sentence: str) -> None:
    """Raises QfolioError with the sentence, which lacks its period, unless ``holds``."""
    if not holds:
        raise QfolioError(f"{sentence}.")
