"""Gârleanu & Pedersen (2013): trading on decaying signals with quadratic costs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from qfolio.solvers.shared import require


class TradingRule(NamedTuple):
    """The best positions are previous @ (positions before) + factors @ f."""

    previous: Float[np.ndarray, "asset asset"]
    factors: Float[np.ndarray, "asset factor"]
    value: float
    """Expected discounted utility from no position, over stationary factors."""


def garleanu_pedersen(
    phi: ArrayLike,
    risk_aversion: float,
    cost: ArrayLike,
    loading: ArrayLike,
    covariance: ArrayLike,
    rho: float,
    innovation: ArrayLike = 1.0,
) -> TradingRule:
    """The best trading in assets whose returns are predicted by decaying factors.

    Positions x_t and profits are additive, in shares and money: the returns over t to t+1 are B f_t
    plus noise of covariance Σ, with f_{t+1} = (1 − φ) f_t + ε. The agent sees f_t, chooses x_t and
    maximizes E Σ_t [(1 − ρ)^{t+1} (x_t'B f_t − ½γ x_t'Σx_t) − (1 − ρ)^t ½ Δx_t'ΛΔx_t].

    Source: N. Gârleanu and L. H. Pedersen, "Dynamic Trading with Predictable Returns and
    Transaction Costs" (2013), propositions 1 and 2: V(x, f) = −½x'A x + x'C f + …, and the best
    trade is Λ⁻¹A (aim − x₋) with aim = A⁻¹C f. Portfolios W with W'ΣW = 1 and W'ΛW = diag(λ) solve
    the Riccati equation of A: neither risk nor cost connects them, so that each is traded like one
    asset. It moves by the fraction a/λ towards an aim in which factor k has 1/(1 + φ_k a/γ) times
    its weight without costs (propositions 3 and 4, where Λ = λΣ makes all fractions the same).

    Args:
        phi: Decay of each factor per step, in (0, 1]; shape (factor,), or a number for one.
        risk_aversion: γ > 0.
        cost: Λ, shape (asset, asset), positive semidefinite, or a number for one asset.
        loading: B, shape (asset, factor); for one asset also (factor,) or a number.
        covariance: Σ of the assets' noise per step, shape (asset, asset), positive definite, or a
            number for one asset.
        rho: Discount rate per step, between 0 and 1, both excluded.
        innovation: Covariance of ε, shape (factor, factor), or variances of independent factors,
            shape (factor,) or one number (default: 1). Only ``value`` depends on it.

    Raises:
        QfolioError: A parameter is out of range.
    """
    from scipy.linalg import eigh

    decay = np.atleast_1d(np.asarray(phi, float))
    b, lam, sigma = (np.atleast_2d(np.asarray(x, float)) for x in (loading, cost, covariance))
    n, k = len(b), decay.size
    require(
        decay.shape == b.shape[1:],
        f"loading must be (asset, factor) for phi (factor,); not {b.shape}, {decay.shape}",
    )
    require(bool(np.all((decay > 0) & (decay <= 1))), f"phi must lie in (0, 1]; not {decay}")
    require(risk_aversion > 0 and 0 < rho < 1, "risk_aversion must be positive, rho within (0, 1)")
    require(
        _least_eigenvalue(lam, n) >= -1e-12 * abs(lam).max() and _least_eigenvalue(sigma, n) > 0,
        f"cost and covariance must be symmetric tables of {n} assets, the cost not negative and "
        "the covariance positive definite",
    )
    omega = np.asarray(innovation, dtype=float)
    omega = np.diag(np.broadcast_to(omega, decay.shape)) if omega.ndim < 2 else omega
    require(
        _least_eigenvalue(omega, k) >= -1e-12, f"innovation must be a covariance of {k} factors"
    )
    keep, gamma = 1 - rho, risk_aversion
    costs, portfolios = eigh(lam, sigma)
    costs = np.maximum(costs, 0.0)
    half = gamma * keep + costs * rho
    # a/λ, written so that it holds at λ = 0 as well (then 1: trade all the way).
    rates = 2 * gamma * keep / (half + np.sqrt(half**2 + 4 * gamma * costs * keep**2))
    predicted = portfolios.T @ b  # return of each portfolio, by factor
    targets = rates[:, None] * predicted / (gamma + np.outer(rates * costs, decay))
    previous = portfolios @ ((1 - rates)[:, None] * (portfolios.T @ sigma))
    # V = … + ½f'Mf + m. Completing the square in the Bellman equation, whose curvature in a
    # portfolio is λ/(1 − rate) = λ + (1 − ρ)(γ + a), leaves ½ Σ curvature (target f)² + the future.
    curvature = costs + keep * (gamma + rates * costs)
    left = (1 - decay)[:, None] * (1 - decay)
    m = targets.T @ (curvature[:, None] * targets) / (1 - keep * left)
    stationary = omega / (1 - left)  # covariance of f
    value = float((m * (stationary + omega * keep / rho)).sum()) / 2
    return TradingRule(previous, portfolios @ targets, value)


def _least_eigenvalue(matrix: Float[np.ndarray, "..."], size: int) -> float:
    """The least eigenvalue; −∞ if the matrix is not symmetric or not of this size."""
    symmetric = matrix.shape == (size, size) and np.allclose(matrix, matrix.T, rtol=1e-9, atol=0)
    return float(np.linalg.eigvalsh(matrix).min()) if symmetric else -np.inf
