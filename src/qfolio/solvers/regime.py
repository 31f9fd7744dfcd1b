"""Two regimes, all in or all out, with a cost for every switch: the exact policy."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from qfolio.solvers.shared import log_remainder, require


class RegimeOptimum(NamedTuple):
    """The solution of ``regime``."""

    policy: Int[np.ndarray, "2 2"]
    """Position (0 or 1) to take, by (regime, position held)."""
    gain: float
    """Long-run log growth per step."""
    advantage: Float[np.ndarray, " 2"]
    """Value in log wealth of holding the asset before the decision, by regime; in [−κ, κ]."""


def regime(stay: ArrayLike, means: ArrayLike, cost_log: float) -> RegimeOptimum:
    """The best policy of being in or out of an asset whose mean follows a two-state Markov chain.

    In each step the agent sees the regime s and its position, chooses the position for this step,
    pays ``cost_log`` if that is a switch, and earns position × means[s], with the mean of the
    regime that it *saw*; then the regime may change. It maximizes the average reward. Only the
    advantage Δ of being in rather than out matters (an optimal stopping problem): u = m + P Δ,
    Δ = clip(u, −κ, κ). The agent enters where u > κ, leaves where u < −κ, and gains
    Σ π_s (u_s − κ)⁺ a step. Linear solves find the one of the nine ways to clip that is consistent.

    Args:
        stay: Shape (2,), the probability that each regime lasts another step; below 1.
        means: Shape (2,), log reward per step while in.
        cost_log: κ = −log(1 − c) ≥ 0, paid at each switch, in or out.

    Raises:
        QfolioError: The parameters are out of range, or a regime never ends.
    """
    last, m = np.asarray(stay, dtype=float), np.asarray(means, dtype=float)
    require(last.shape == m.shape == (2,), "stay and means must have two numbers, one per regime")
    require(
        bool(np.all((last >= 0) & (last < 1))), f"stay must be at least 0 and below 1; not {last}"
    )
    require(bool(np.all(np.isfinite(m))), f"means must be finite numbers; not {m}")
    require(0 <= cost_log < math.inf, f"cost_log must be finite, not negative; not {cost_log}")
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
    gain = float(stationary @ np.where(enter, worth - cost_log, 0.0))
    return RegimeOptimum(policy, gain, advantage)


def regime_bands(
    stay: ArrayLike, means: ArrayLike, cost: float, discount: float = 1.0, points: int = 401
) -> Float[np.ndarray, "2 2"]:
    """The best policy of weights in the same market: between which weights to let them drift.

    A weight b earns log(1 + b (e^m − 1)) in a regime of mean m, then drifts with the price; a trade
    from weight a to b pays the remainder factor. Rewards are concave in weights and costs are
    proportional, so that each regime has a band: a weight below it is bought up to its lower edge,
    one above is sold down to its upper edge (Davis & Norman 1990). Where costs are small, the edges
    are those of ``regime``: all in good times and nothing in bad ones. Relative value iteration on
    a grid of weights finds them.

    Args:
        stay: As for ``regime``.
        means: As for ``regime``.
        cost: Proportional and one way, at least 0 and below 1.
        discount: Discount per step; at 1, the average reward of all steps is maximized, so that a
            first purchase costs nothing.
        points: Size of the grid of weights from 0 to 1, whose spacing is the edges' precision.

    Returns:
        The lower and the upper edge, by regime.
    """
    last, m = np.asarray(stay, dtype=float), np.asarray(means, dtype=float)
    weights = np.linspace(0, 1, points)
    gain = np.expm1(m)[:, None]
    earned = np.log1p(weights * gain)
    drifted = weights * (1 + gain) / (1 + weights * gain)
    trade = log_remainder(weights[:, None], weights, cost)  # (held, ordered)
    transition = discount * np.array([[last[0], 1 - last[0]], [1 - last[1], last[1]]])
    step = 0.5 if last.sum() < 1 else 1.0  # or the values of regimes that alternate would swing
    value = np.zeros((2, points))
    while True:
        later = transition @ value
        after = earned + np.stack([np.interp(drifted[s], weights, later[s]) for s in (0, 1)])
        # Between the edges a weight is held; from below and above it is traded to them.
        low, high = ((trade[end] + after).argmax(1) for end in (0, -1))
        best = np.clip(np.arange(points), low[:, None], high[:, None])
        found = trade[np.arange(points), best] + np.take_along_axis(after, best, 1)
        change = found - value
        value = value + step * change
        value -= value.min()
        if np.ptp(change) < 1e-10:
            break
    return weights[np.stack([low, high], 1)]
