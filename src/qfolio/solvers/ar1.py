"""A return that an AR(1) signal predicts, with proportional costs: dynamic programming."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from qfolio.solvers.shared import gauss, log_remainder, require


@dataclass(frozen=True)
class Ar1Optimum:
    """The solution of ``ar1``; axes are the signal s, the holding h and the level a."""

    signals: Float[np.ndarray, " s"]
    holdings: Float[np.ndarray, " h"]
    """Weights before the decision."""
    levels: Float[np.ndarray, " a"]
    """Weights to choose from."""
    value: Float[np.ndarray, "s h"]
    """Discounted log growth, net of costs, by signal seen and weight held."""
    after: Float[np.ndarray, "s a"]
    """The same after moving to the level and paying the cost."""
    actions: Int[np.ndarray, "s h"]
    """Best level, as an index."""
    cost: float
    """Proportional cost, one way."""

    def policy(self, x: ArrayLike, weight: ArrayLike) -> Int[np.ndarray, "..."]:
        """Index of the best level at any signal x and weight held; both broadcast."""
        x, weight = np.broadcast_arrays(np.asarray(x, float), np.asarray(weight, float))
        after = np.stack([np.interp(x, self.signals, column) for column in self.after.T], -1)
        trade = log_remainder(weight[..., None], self.levels, self.cost)
        return np.asarray((trade + after).argmax(-1))


def ar1(
    rho: float = 0.95,
    noise: float = 0.3122,
    drift: float = 0.0002,
    slope: float = 0.004,
    volatility: float = 0.01,
    cost: float = 0.002,
    levels: ArrayLike = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
    discount: float = 0.97,
    signal_points: int | None = None,
    holding_parts: int = 4,
) -> Ar1Optimum:
    """The best weights of one asset whose mean return follows a signal, with trading costs.

    At each step the agent sees the signal x and the weight it holds and names a level b. It pays
    the remainder factor from weight to level, then earns log(1 + b r), where
    r = drift + slope·x + volatility·η is a simple return with the mean of the signal *seen*; then
    x' = rho·x + noise·ε. The weight moves with the price, to b(1 + r)/(1 + b r), and is brought
    back at a cost.

    Value iteration on (signal, weight): the expectation over x' is a sum over equally spaced
    signals within five standard deviations (exact to rounding for smooth functions), and that over
    η is Gauss–Hermite quadrature; values between grid weights are interpolated. Values are exact to
    about 1e-6 at the default grids.

    Args:
        rho, noise: Parameters of the signal; |rho| < 1, noise > 0.
        drift, slope, volatility: Parameters of the return, per step.
        cost: Proportional and one way, at least 0 and below 1.
        levels: Ascending weights in [0, 1] to choose from.
        discount: Discount per step, from 0 to 0.9999.
        signal_points: Size of the signal's grid, at least 11 (default: 201, or as many more as keep
            its points within a shock of each other).
        holding_parts: Cells of the grid of held weights between two levels.

    Raises:
        QfolioError: A parameter is out of range, or returns below −100% are too likely.
    """
    b = np.asarray(levels, dtype=float)
    numbers = np.array([rho, noise, drift, slope, volatility, cost, discount])
    require(bool(np.all(np.isfinite(numbers))), f"parameters must be finite; not {numbers}")
    require(abs(rho) < 1 and noise > 0, f"the signal needs |rho| < 1, noise > 0; not {rho, noise}")
    require(0 <= cost < 1, f"cost must be at least 0 and below 1; not {cost}")
    require(0 <= discount <= 0.9999, f"discount must lie in [0, 0.9999]; not {discount}")
    require(
        b.ndim == 1 and b.size > 1 and b[0] >= 0 and b[-1] <= 1 and bool(np.all(np.diff(b) > 0)),
        "levels must be two or more ascending weights between 0 and 1",
    )
    spread = noise / math.sqrt(1 - rho**2)
    if signal_points is None:
        signal_points = max(201, math.ceil(10 * spread / noise) + 1)
    require(signal_points >= 11 and holding_parts >= 1, "the grids are too coarse")
    x = np.linspace(-5 * spread, 5 * spread, signal_points)
    transition = np.exp(-0.5 * ((x - rho * x[:, None]) / noise) ** 2)
    transition /= transition.sum(1, keepdims=True)
    nodes, chances = gauss(9)
    returns = (drift + slope * x)[:, None, None] + volatility * nodes  # (s, 1, q)
    require(
        float(returns.min()) > -1,
        "returns below −100% are too likely; lower slope, noise or volatility",
    )
    grown = 1 + b[:, None] * returns  # (s, a, q)
    reward = np.log(grown) @ chances
    ends = np.union1d([0.0, 1.0], b)
    places = np.arange((len(ends) - 1) * holding_parts + 1) / holding_parts
    holdings = np.interp(places, np.arange(len(ends)), ends)
    later = b[:, None] * (1 + returns) / grown
    cell = np.clip(np.searchsorted(holdings, later, side="right") - 1, 0, len(holdings) - 2)
    share = np.clip((later - holdings[cell]) / (holdings[cell + 1] - holdings[cell]), 0, 1)
    row = np.arange(len(x))[:, None, None]
    trade = log_remainder(holdings[:, None], b, cost)  # (h, a)

    def look_ahead(value: np.ndarray) -> np.ndarray:
        """Reward and discounted value by signal and level."""
        then = transition @ value
        mean = (1 - share) * then[row, cell] + share * then[row, cell + 1]
        return np.asarray(reward + discount * (mean @ chances))

    value = np.zeros((len(x), len(holdings)))
    while True:
        after = look_ahead(value)
        change = (trade + after[:, None, :]).max(-1) - value
        value = value + change
        # The remaining sum of changes lies between these bounds (MacQueen 1966).
        low, high = (discount / (1 - discount) * float(end) for end in (change.min(), change.max()))
        if high - low < 1e-9:
            break
    value += (low + high) / 2
    after = look_ahead(value)
    actions = (trade + after[:, None, :]).argmax(-1)
    return Ar1Optimum(x, holdings, b, value, after, actions, cost)
