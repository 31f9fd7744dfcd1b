"""Gârleanu & Pedersen (2013): trading on decaying signals with quadratic costs."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from qfolio.solvers.shared import require


class TradingRule(NamedTuple):
    """The best position is previous × (position before) + factors · f."""

    previous: float
    factors: Float[np.ndarray, " factor"]
    value: float
    """Expected discounted utility from no position, over stationary factors."""


def garleanu_pedersen(
    phi: ArrayLike,
    risk_aversion: float,
    cost_scale: float,
    loading: ArrayLike,
    variance: float,
    rho: float,
    innovation: ArrayLike = 1.0,
) -> TradingRule:
    """The best trading rate in one asset whose return is predicted by decaying factors.

    Positions x_t and profits are additive, in shares and money: the return over t to t+1 is B f_t
    plus noise of variance Σ, with f_{t+1} = (1 − φ) f_t + ε. The agent sees f_t, chooses x_t and
    maximises E Σ_t [(1 − ρ)^{t+1} (x_t B f_t − ½γΣ x_t²) − (1 − ρ)^t ½λΣ (x_t − x_{t−1})²].

    Source: N. Gârleanu and L. H. Pedersen, "Dynamic Trading with Predictable Returns and
    Transaction Costs" (2013), propositions 1 to 4: the best position moves by the fraction a/λ
    towards an aim, in which factor k has 1/(1 + φ_k a/γ) times its weight without costs.

    Args:
        phi: Decay of each factor per step, in (0, 1]; shape (factor,), or a number for one.
        risk_aversion: γ > 0.
        cost_scale: λ ≥ 0, in units of Σ.
        loading: B, same shape as ``phi``.
        variance: Σ > 0 of the asset's noise.
        rho: Discount rate per step, between 0 and 1, both excluded.
        innovation: Covariance of ε, (factor, factor), or variances of independent factors. Only
            the value depends on it.

    Raises:
        QfolioError: A parameter is out of range.
    """
    decay, b = np.atleast_1d(np.asarray(phi, float)), np.atleast_1d(np.asarray(loading, float))
    require(
        decay.ndim == 1 and decay.shape == b.shape,
        f"phi and loading must have one number per factor; not {decay.shape}, {b.shape}",
    )
    require(bool(np.all((decay > 0) & (decay <= 1))), f"phi must lie in (0, 1]; not {decay}")
    require(
        risk_aversion > 0 and cost_scale >= 0 and variance > 0 and 0 < rho < 1,
        "risk_aversion and variance must be positive, cost_scale not negative, rho within (0, 1)",
    )
    omega = np.asarray(innovation, dtype=float)
    omega = np.diag(np.broadcast_to(omega, decay.shape)) if omega.ndim < 2 else omega
    require(
        omega.shape == (decay.size, decay.size)
        and bool(np.allclose(omega, omega.T) and np.linalg.eigvalsh(omega).min() >= -1e-12),
        f"innovation must be a covariance of {decay.size} factors",
    )
    keep, gamma, lam = 1 - rho, risk_aversion, cost_scale
    half = gamma * keep + lam * rho
    # a/λ, written so that it holds at λ = 0 as well (then 1: trade all the way).
    rate = 2 * gamma * keep / (half + math.sqrt(half**2 + 4 * gamma * lam * keep**2))
    factors = rate * b / (gamma * variance * (1 + decay * rate * lam / gamma))
    # V(x, f) = −½aΣx² + x s·f + ½f'Mf + n. Completing the square in the Bellman equation, whose
    # curvature is J = Λ/(1 − rate) = Λ + (1 − ρ)(γ + a)Σ, leaves ½J (factors·f)² + the future.
    curvature = (lam + keep * (gamma + rate * lam)) * variance
    left = (1 - decay)[:, None] * (1 - decay)
    m = curvature * np.outer(factors, factors) / (1 - keep * left)
    stationary = omega / (1 - left)  # covariance of f
    value = float((m * (stationary + omega * keep / rho)).sum()) / 2
    return TradingRule(1 - rate, factors, value)
