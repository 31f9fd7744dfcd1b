"""Independent ways to the optima of finite processes and of the synthetic markets.

They are for tests of ``qfolio.solvers``.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from qfolio.solvers.finite import Model, Values, look_ahead
from qfolio.solvers.shared import gauss


def soft(values: Values, epsilon: float) -> Float[np.ndarray, " state"]:
    """State values if the action is random with probability ε and otherwise the best."""
    return (1 - epsilon) * values.max(-1) + epsilon * values.mean(-1)


def value_iteration(model: Model, discount: float, epsilon: float = 0.0) -> Values:
    """Q to within 1e-10, by sweeps over all states, each of which multiplies the error by γ."""
    values = np.zeros(model.transitions.shape[:2])
    while True:
        better = look_ahead(model, soft(values, epsilon), discount)
        change = float(np.abs(better - values).max())
        values = better
        if change * discount <= 1e-10 * (1 - discount):
            return values


def merton(
    drift: ArrayLike,
    covariance: ArrayLike,
    risk_aversion: float = 1.0,
    rate: float = 0.0,
    borrowing: float | None = None,
) -> Float[np.ndarray, " asset"]:
    """Weights Σ⁻¹(μ − r)/γ of the assets; the rest is cash. Not restricted to the simplex.

    Source: R. C. Merton, "Lifetime Portfolio Selection under Uncertainty" (1969). Prices follow
    dS/S = μ dt + dB with covariance Σ, utility has constant relative risk aversion γ (1 is log).
    If borrowing costs more than lending earns, r is the rate at which the assets' weights sum to 1
    (neither lends nor borrows), but at least the rate of lending and at most that of borrowing.
    """
    mean, sigma = np.asarray(drift, dtype=float), np.asarray(covariance, dtype=float)
    borrowing = rate if borrowing is None else borrowing
    each, total = np.linalg.solve(sigma, mean), np.linalg.solve(sigma, np.ones_like(mean))
    even = (each.sum() - risk_aversion) / total.sum()
    return np.asarray((each - min(max(even, rate), borrowing) * total) / risk_aversion)


def lognormal_scenarios(
    drift: ArrayLike, covariance: ArrayLike, dt: float, points: int = 12
) -> tuple[Float[np.ndarray, "scenario column"], Float[np.ndarray, " scenario"]]:
    """Merton's market over one step of ``dt`` years: relatives, cash first, and probabilities.

    They are Gauss–Hermite nodes of log relatives with mean (μ − diag(Σ)/2) dt and covariance Σ dt;
    there are points**assets of them. With dt → 0 their optimum tends to ``merton``'s weights where
    those lie within the simplex.
    """
    mean, sigma = np.asarray(drift, dtype=float), np.asarray(covariance, dtype=float)
    assets = len(mean)
    nodes, weights = gauss(points)
    z = np.stack(np.meshgrid(*[nodes] * assets, indexing="ij"), -1).reshape(-1, assets)
    chances = np.stack(np.meshgrid(*[weights] * assets, indexing="ij"), -1).reshape(-1, assets)
    logs = (mean - np.diag(sigma) / 2) * dt + math.sqrt(dt) * z @ np.linalg.cholesky(sigma).T
    return np.column_stack([np.ones(len(z)), np.exp(logs)]), chances.prod(1)


class RegimeOptimum(NamedTuple):
    """The solution of ``regime``."""

    policy: Int[np.ndarray, "2 2"]
    """Position (0 or 1) to take, by (regime, position held)."""
    gain: float
    """Long-run log growth per step."""


def regime(stay: ArrayLike, means: ArrayLike, cost_log: float) -> RegimeOptimum:
    """The best policy of being in or out of an asset whose mean follows a two-state Markov chain.

    In each step the agent sees the regime s and its position, chooses the position for this step,
    pays ``cost_log`` if that is a switch, and earns position × means[s], with the mean of the
    regime that it *saw*; then the regime may change. It maximizes the average reward. Only the
    advantage Δ of being in rather than out matters (an optimal stopping problem): u = m + P Δ,
    Δ = clip(u, −κ, κ). The agent enters where u > κ, leaves where u < −κ, and gains
    Σ π_s (u_s − κ)⁺ a step. Linear solves find the one of the nine ways to clip that is consistent.
    """
    last, m = np.asarray(stay, dtype=float), np.asarray(means, dtype=float)
    transition = np.array([[last[0], 1 - last[0]], [1 - last[1], last[1]]])
    stationary = np.array([1 - last[1], 1 - last[0]]) / (2 - last.sum())
    tie = 1e-12 * max(cost_log, float(np.abs(m).max()))
    for clipped in itertools.product((0, 1, -1), repeat=2):
        side = np.array(clipped)
        system = np.eye(2) - transition * (side == 0)[:, None]
        advantage = np.linalg.lstsq(system, np.where(side == 0, m, side * cost_log))[0]
        worth = m + transition @ advantage
        if np.abs(np.clip(worth, -cost_log, cost_log) - advantage).max() <= tie:
            break
    enter, leave = worth > cost_log + tie, worth < -cost_log - tie
    policy = np.where(enter[:, None], 1, np.where(leave[:, None], 0, [0, 1]))
    return RegimeOptimum(policy, float(stationary @ np.where(enter, worth - cost_log, 0.0)))


def no_trade_growth(
    low: ArrayLike, high: ArrayLike, drift: float, volatility: float, cost: float
) -> Float[np.ndarray, "..."]:
    """Log growth a year of keeping the weight in any region low < high, as in ``no_trade_region``.

    ``low`` and ``high`` lie in (0, 1) and broadcast to the shape of the result.
    """
    from scipy.special import exprel, logit

    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    alpha, beta = a * (1 + cost) / (1 + cost * a), b * (1 - cost) / (1 - cost * b)
    m = 2 * drift / volatility**2 - 1
    reach = logit(b) - logit(a)
    inside = m * beta + (beta - alpha) / (reach * exprel(m * reach))
    return np.asarray(volatility**2 / 2 * inside)
