"""Two regimes, with a cost for every trade: the bands in which the best policy does not trade."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from qfolio.solvers.shared import log_remainder


def regime_bands(
    stay: ArrayLike, means: ArrayLike, cost: float, discount: float = 1.0
) -> Float[np.ndarray, "2 2"]:
    """Between which weights to let an asset drift whose mean follows a two-state Markov chain.

    In each step the agent sees the regime and its weight a, trades to a weight b at the remainder
    factor, and earns log(1 + b (e^m − 1)), with the mean m of the regime that it *saw*; then the
    weight drifts with the price, and the regime may change. Rewards are concave in weights and
    costs are proportional, so that each regime has a band: a weight below it is bought up to its
    lower edge, one above is sold down to its upper edge (Davis & Norman 1990). Where costs are
    small, these are all in good times and nothing in bad ones. Relative value iteration on a grid
    of weights finds them.

    Args:
        stay: Shape (2,), the probability that each regime lasts another step; below 1.
        means: Shape (2,), log reward per step of holding the asset alone.
        cost: Proportional and one way, at least 0 and below 1.
        discount: Discount per step; at 1, the average reward of all steps is maximized, so that a
            first purchase costs nothing.

    Returns:
        The lower and the upper edge, by regime.
    """
    last, m = np.asarray(stay, dtype=float), np.asarray(means, dtype=float)
    points = 401  # the edges are as precise as the spacing of this grid
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
