"""Exact optima of the synthetic markets, against which agents are graded.

Six markets, from one bet to a mean-reverting signal with costs. Relatives are price ratios over
one step, cash has relative 1, costs are proportional and one way (0.001 is 10 basis points), growth
is the expected logarithm of the wealth's ratio. Everything is float64.

A rebalancing of one asset and cash from weight w to weight b leaves the share (1 − c w)/(1 − c b)
of the wealth when it sells and (1 − c + c w)/(1 − c + c b) when it buys: a price that is cut by c
for the seller and divided by 1 − c for the buyer.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from qfolio.core.errors import QfolioError

LEVELS = tuple(i / 10 for i in range(11))
"""The weights to choose from in the market ``ar1``."""


def kelly(up: float, down: float, probability: float) -> tuple[float, float]:
    """The fraction of wealth to bet when a stake becomes ``up`` or ``down`` times itself.

    Source: J. L. Kelly, "A New Interpretation of Information Rate" (1956). Long only: the fraction
    is clipped to [0, 1].

    Args:
        up: Relative with the given probability, above 1.
        down: Relative otherwise, at least 0 and below 1.
        probability: Of ``up``.

    Returns:
        The fraction and the growth per bet.

    Raises:
        QfolioError: A parameter is out of range, so that one side of the bet is never worse.
    """
    from scipy.special import xlogy

    _require(0 <= down < 1 < up < math.inf, f"a bet needs 0 ≤ down < 1 < up; not {down} and {up}")
    _require(0 <= probability <= 1, f"a probability lies between 0 and 1; not at {probability}")
    fraction = probability / (1 - down) - (1 - probability) / (up - 1)
    fraction = min(max(fraction, 0.0), 1.0)
    win, lose = 1 + fraction * (up - 1), 1 - fraction * (1 - down)
    return fraction, float(xlogy(probability, win) + xlogy(1 - probability, lose))


class GrowthOptimum(NamedTuple):
    weights: Float[np.ndarray, " asset"]
    growth: float
    """Expected log relative per step."""
    violation: float
    """Worst violation of the optimality conditions; growth is optimal to within this number."""


def growth_optimal(
    relatives: ArrayLike, probabilities: ArrayLike | None = None, tol: float = 1e-9
) -> GrowthOptimum:
    """The weights b on the simplex that maximise E log(b·x) over finitely many scenarios.

    On the rows of a price history this is the best constant-rebalanced portfolio. Since
    b·∇E log(b·x) = 1, the maximum of E log(b·x) − Σb over b ≥ 0 lies on the simplex by itself, and
    b is optimal exactly if E[x_i/(b·x)] ≤ 1 for all i, with equality where b_i > 0 (T. Cover, "An
    Algorithm for Maximizing Expected Log Investment Return", 1984, theorem 1). Cover's iteration
    starts, a primal-dual interior-point method follows, and Newton's method on the assets held
    takes it to rounding error.

    Args:
        relatives: Shape (scenario, asset), at least 0; cash, if wanted, is a column of ones.
        probabilities: Shape (scenario,), summing to 1; equal ones by default.
        tol: Largest violation of the conditions that is accepted.

    Raises:
        QfolioError: The arguments are no scenarios, every asset is worth nothing in one of them,
            or the tolerance is out of reach.
    """
    x = np.asarray(relatives, dtype=float)
    _require(
        x.ndim == 2 and x.size > 0 and bool(np.all(np.isfinite(x) & (x >= 0))),
        "relatives must be a table (scenario, asset) of finite numbers that are not negative",
    )
    p = np.full(len(x), 1 / len(x)) if probabilities is None else np.asarray(probabilities, float)
    _require(
        p.shape == (len(x),) and bool(np.all(p >= 0)) and abs(p.sum() - 1) < 1e-9,
        f"probabilities must be {len(x)} numbers, not negative, that sum to 1",
    )
    x, p = x[p > 0], p[p > 0]
    best = x.max(1, keepdims=True)
    _require(bool(np.all(best > 0)), "in one scenario every asset is worth nothing; add cash")
    y = x / best  # changes neither the weights nor the conditions, and keeps numbers near 1
    b = np.full(y.shape[1], 1 / y.shape[1])
    for _ in range(10):
        b = b * _marginal(y, p, b)
    b = _newton_on_support(y, p, *_interior_point(y, p, b), tol)
    slope = _marginal(y, p, b) - 1
    violation = float(np.max(np.where(b > 0, np.abs(slope), slope)))
    _require(
        violation <= tol,
        f"the growth-optimal weights violate the optimality conditions by {violation:.1g}, more "
        f"than tol={tol:.1g}; give a larger tolerance",
    )
    return GrowthOptimum(b, float(p @ np.log(x @ b)), max(violation, 0.0))


def _marginal(
    x: Float[np.ndarray, "s n"], p: Float[np.ndarray, " s"], b: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """E[x_i / (b·x)]"""
    return np.asarray((p / (x @ b)) @ x)


def _curvature(
    x: Float[np.ndarray, "s n"], p: Float[np.ndarray, " s"], b: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """E[x x'/(b·x)²], minus the Hessian"""
    scaled = x * (np.sqrt(p) / (x @ b))[:, None]
    return np.asarray(scaled.T @ scaled)


def _interior_point(
    x: Float[np.ndarray, "s n"], p: Float[np.ndarray, " s"], b: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Weights b > 0 and multipliers z > 0 with E[x/(b·x)] − 1 + z = 0 and b z = 0, nearly."""
    b = np.maximum(b, 1e-6)
    z = np.full_like(b, 0.1)

    def residual(b: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, float]:
        balance = _marginal(x, p, b) - 1 + z
        return balance, math.hypot(float(np.linalg.norm(balance)), float(np.linalg.norm(b * z)))

    balance, error = residual(b, z)
    for _ in range(200):
        target = 0.1 * float(b @ z) / len(b)
        if error < 1e-13:
            break
        system = _curvature(x, p, b) + np.diag(z / b)
        step_b = np.linalg.solve(system, balance - z + target / b)
        step_z = (target - z * step_b) / b - z
        length = 1.0
        for value, step in ((b, step_b), (z, step_z)):
            falling = step < 0
            length = min(length, 0.99 * float(np.min(-value[falling] / step[falling], initial=2)))
        while length > 1e-12:
            tried = b + length * step_b, z + length * step_z
            balance, moved = residual(*tried)
            if moved <= (1 - 0.01 * length) * error:
                break
            length /= 2
        else:
            break  # rounding: no step improves any more
        (b, z), error = tried, moved
    return b, z


def _newton_on_support(
    x: Float[np.ndarray, "s n"],
    p: Float[np.ndarray, " s"],
    b: Float[np.ndarray, " n"],
    z: Float[np.ndarray, " n"],
    tol: float,
) -> Float[np.ndarray, " n"]:
    """Sets what is not held to exactly 0, and the conditions on the rest to equality."""
    held = b > z
    b = np.where(held, b, 0.0)
    for _ in range(50):
        b /= b.sum()
        slope = _marginal(x, p, b) - 1
        if np.max(np.where(held, np.abs(slope), slope)) <= tol / 1000:
            break
        wanted = held | (slope > tol)
        # Assets that repeat others leave the step open; the shortest one will do.
        step = np.linalg.lstsq(_curvature(x[:, wanted], p, b[wanted]), slope[wanted], rcond=1e-13)[
            0
        ]
        b[wanted] = np.maximum(b[wanted] + step, 0.0)
        held = b > 0
    return b


def merton(
    drift: ArrayLike, covariance: ArrayLike, risk_aversion: float = 1.0, rate: float = 0.0
) -> Float[np.ndarray, " asset"]:
    """Weights Σ⁻¹(μ − r)/γ of the assets; the rest is cash. Not restricted to the simplex.

    Source: R. C. Merton, "Lifetime Portfolio Selection under Uncertainty" (1969). Prices follow
    dS/S = μ dt + dB with covariance Σ, utility has constant relative risk aversion γ (1 is log).

    Args:
        drift: Shape (asset,), a year.
        covariance: Shape (asset, asset), a year, positive definite.
        risk_aversion: γ > 0.
        rate: Of cash, a year.

    Raises:
        QfolioError: γ is not positive, or the shapes or the covariance are no market's.
    """
    mean, sigma = _market(drift, covariance)
    _require(0 < risk_aversion < math.inf, f"risk aversion must be positive; not {risk_aversion}")
    return np.asarray(np.linalg.solve(sigma, mean - rate) / risk_aversion)


def lognormal_scenarios(
    drift: ArrayLike, covariance: ArrayLike, dt: float, points: int = 12
) -> tuple[Float[np.ndarray, "scenario column"], Float[np.ndarray, " scenario"]]:
    """Merton's market over one step of ``dt`` years as scenarios for ``growth_optimal``.

    Gauss–Hermite nodes of log relatives with mean (μ − diag(Σ)/2) dt and covariance Σ dt, so that
    there are points**assets of them. With dt → 0 their optimum tends to ``merton``'s weights where
    those lie within the simplex.

    Args:
        drift: μ over cash, shape (asset,), a year.
        covariance: Σ, shape (asset, asset), a year, positive definite.
        dt: Years in a step.
        points: Nodes per asset.

    Returns:
        Relatives of shape (scenario, 1 + asset) with cash first, and probabilities.

    Raises:
        QfolioError: The shapes or the covariance are no market's, or there are too many scenarios.
    """
    mean, sigma = _market(drift, covariance)
    _require(0 < dt < math.inf, f"dt must be positive; not {dt}")
    assets = len(mean)
    _require(points**assets <= 1_000_000, f"{points}**{assets} scenarios are too many")
    nodes, weights = _gauss(points)
    z = np.stack(np.meshgrid(*[nodes] * assets, indexing="ij"), -1).reshape(-1, assets)
    chances = np.stack(np.meshgrid(*[weights] * assets, indexing="ij"), -1).reshape(-1, assets)
    logs = (mean - np.diag(sigma) / 2) * dt + math.sqrt(dt) * z @ np.linalg.cholesky(sigma).T
    return np.column_stack([np.ones(len(z)), np.exp(logs)]), chances.prod(1)


class RegimeOptimum(NamedTuple):
    policy: Int[np.ndarray, "2 2"]
    """Position (0 or 1) to take, by (regime, position held)."""
    gain: float
    """Long-run log growth per step."""
    advantage: Float[np.ndarray, " 2"]
    """Log wealth that holding the asset before the decision is worth, by regime; in [−κ, κ]."""


def regime(stay: ArrayLike, means: ArrayLike, cost_log: float) -> RegimeOptimum:
    """The best way to be in or out of an asset whose mean follows a two-state Markov chain.

    In each step the agent sees the regime s and its position, chooses the position for this step,
    pays ``cost_log`` if that is a switch, and earns position × means[s], the mean of the regime it
    *saw*; then the regime changes. It maximises the average reward. Only the advantage Δ of being
    in rather than out matters (an optimal stopping problem): u = m + P Δ, Δ = clip(u, −κ, κ). The
    agent enters where u > κ, leaves where u < −κ, and gains Σ π_s (u_s − κ)⁺ a step. Of the nine
    ways to clip, the one that agrees with itself is found by linear solves.

    Args:
        stay: Shape (2,), the probability that each regime lasts another step; below 1.
        means: Shape (2,), log reward per step while in.
        cost_log: κ = −log(1 − c) ≥ 0, paid at each switch, in or out.

    Raises:
        QfolioError: The parameters are out of range, or a regime never ends.
    """
    last, m = np.asarray(stay, dtype=float), np.asarray(means, dtype=float)
    _require(last.shape == m.shape == (2,), "stay and means must have two numbers, one per regime")
    _require(
        bool(np.all((last >= 0) & (last < 1))), f"stay must be at least 0 and below 1; not {last}"
    )
    _require(bool(np.all(np.isfinite(m))), f"means must be finite numbers; not {m}")
    _require(0 <= cost_log < math.inf, f"cost_log must be finite, not negative; not {cost_log}")
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


@dataclass(frozen=True)
class Ar1Optimum:
    """The solved market of ``ar1``; shapes name signal s, holding h and level a."""

    signals: Float[np.ndarray, " s"]
    holdings: Float[np.ndarray, " h"]
    """Weights before the decision."""
    levels: Float[np.ndarray, " a"]
    """Weights to choose from."""
    value: Float[np.ndarray, "s h"]
    """Discounted log growth, net of costs, by signal seen and weight held."""
    after: Float[np.ndarray, "s a"]
    """The same once the level is reached and the cost is paid."""
    actions: Int[np.ndarray, "s h"]
    """Best level, as an index."""
    growth: float
    """Of the best policy, a year."""
    cost: float
    growth_of: Callable[[Int[np.ndarray, "s h"]], float]
    """Stationary growth a year of any table of actions."""

    def policy(self, x: ArrayLike, weight: ArrayLike) -> Int[np.ndarray, "..."]:
        """Index of the best level at any signal x and weight held; both broadcast."""
        x, weight = np.broadcast_arrays(np.asarray(x, float), np.asarray(weight, float))
        after = np.stack([np.interp(x, self.signals, column) for column in self.after.T], -1)
        trade = _log_remainder(weight[..., None], self.levels, self.cost)
        return np.asarray((trade + after).argmax(-1))


def ar1(
    rho: float = 0.95,
    noise: float = 0.3122,
    drift: float = 0.0002,
    slope: float = 0.004,
    volatility: float = 0.01,
    cost: float = 0.002,
    levels: ArrayLike = LEVELS,
    discount: float = 0.97,
    drifting: bool = True,
    signal_points: int = 201,
    holding_parts: int = 4,
    steps_per_year: int = 252,
) -> Ar1Optimum:
    """The best weights of one asset whose mean return follows a signal, with trading costs.

    At each step the agent sees the signal x and the weight it holds and names a level b. It pays
    the remainder factor from weight to level, then earns log(1 + b r), where
    r = drift + slope·x + volatility·η is a simple return with the mean of the signal *seen*; then
    x' = rho·x + noise·ε. With ``drifting`` the weight moves with the price, to
    b(1 + r)/(1 + b r), and is brought back at a cost; without, it stays at its level.

    Value iteration on (signal, weight): the expectation over x' is a sum over equally spaced
    signals within five standard deviations (exact to rounding for smooth functions), that over η
    Gauss–Hermite quadrature; weights between the grid's are interpolated. Values are exact to
    about 1e-6, growth to about 2e-5 a year at the default grids.

    Args:
        rho, noise: Of the signal; |rho| < 1, noise > 0.
        drift, slope, volatility: Of the return, per step.
        cost: One way, at least 0 and below 1.
        levels: Ascending weights in [0, 1] to choose from.
        discount: Per step, from 0 to 0.9999.
        drifting: Whether prices move the weights.
        signal_points: Size of the signal's grid.
        holding_parts: Cells of the grid of held weights between two levels.
        steps_per_year: Turns growth per step into growth a year.

    Raises:
        QfolioError: A parameter is out of range, or returns below −100 % are too likely.
    """
    b = np.asarray(levels, dtype=float)
    numbers = np.array([rho, noise, drift, slope, volatility, cost, discount])
    _require(bool(np.all(np.isfinite(numbers))), f"parameters must be finite; not {numbers}")
    _require(abs(rho) < 1 and noise > 0, f"the signal needs |rho| < 1, noise > 0; not {rho, noise}")
    _require(0 <= cost < 1, f"cost must be at least 0 and below 1; not {cost}")
    _require(0 <= discount <= 0.9999, f"discount must lie in [0, 0.9999]; not {discount}")
    _require(
        b.ndim == 1 and b.size > 1 and b[0] >= 0 and b[-1] <= 1 and bool(np.all(np.diff(b) > 0)),
        "levels must be two or more ascending weights between 0 and 1",
    )
    _require(signal_points >= 11 and holding_parts >= 1, "the grids are too coarse")
    spread = noise / math.sqrt(1 - rho**2)
    x = np.linspace(-5 * spread, 5 * spread, signal_points)
    transition = np.exp(-0.5 * ((x - rho * x[:, None]) / noise) ** 2)
    transition /= transition.sum(1, keepdims=True)
    nodes, chances = _gauss(9)
    returns = (drift + slope * x)[:, None, None] + volatility * nodes  # (s, 1, q)
    _require(
        float(returns.min()) > -1,
        "returns below −100 % are too likely; lower slope, noise or volatility",
    )
    grown = 1 + b[:, None] * returns  # (s, a, q)
    reward = np.log(grown) @ chances
    ends = np.union1d([0.0, 1.0], b)
    places = np.arange((len(ends) - 1) * holding_parts + 1) / holding_parts
    holdings = np.interp(places, np.arange(len(ends)), ends) if drifting else b
    later = b[:, None] * ((1 + returns) / grown if drifting else np.ones_like(grown))
    cell = np.clip(np.searchsorted(holdings, later, side="right") - 1, 0, len(holdings) - 2)
    share = np.clip((later - holdings[cell]) / (holdings[cell + 1] - holdings[cell]), 0, 1)
    row = np.arange(len(x))[:, None, None]
    trade = _log_remainder(holdings[:, None], b, cost)  # (h, a)

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
        # What is left of the sum of changes lies between these multiples (MacQueen 1966).
        low, high = (discount / (1 - discount) * float(end) for end in (change.min(), change.max()))
        if high - low < 1e-9:
            break
    value += (low + high) / 2
    after = look_ahead(value)
    actions = (trade + after[:, None, :]).argmax(-1)

    def growth_of(actions: Int[np.ndarray, "s h"]) -> float:
        """Stationary growth a year, starting in cash, by following the distribution of states."""
        states = np.zeros((len(x), len(holdings)))
        states[:, 0] = np.exp(-((x / spread) ** 2) / 2)
        states /= states.sum()
        s, h = np.indices(states.shape)
        earned = trade[h, actions] + reward[s, actions]
        places = (row * len(holdings) + np.stack([cell, cell + 1])).ravel()
        shares = np.stack([1 - share, share])
        for _ in range(100_000):
            chosen = np.bincount((s * len(b) + actions).ravel(), states.ravel(), reward.size)
            mass = chosen.reshape(reward.shape)[..., None] * chances
            moved = np.bincount(places, (mass * shares).ravel(), states.size)
            before, states = states, transition.T @ moved.reshape(states.shape)
            if np.abs(states - before).max() < 1e-12:
                break
        return steps_per_year * float((states * earned).sum())

    growth = growth_of(actions)
    return Ar1Optimum(x, holdings, b, value, after, actions, growth, cost, growth_of)


class NoTradeRegion(NamedTuple):
    low: float
    high: float
    growth: float
    """A year."""


def no_trade_region(
    drift: float, volatility: float, cost: float, rate: float = 0.0, buying: float | None = None
) -> NoTradeRegion:
    """The weights between which an investor with log utility does not trade; continuous time.

    One asset follows geometric Brownian motion; selling value s yields (1 − cost)s of cash, buying
    value s takes (1 + buying)s. Outside [low, high] the agent trades to the nearer edge.

    Sources: Taksar, Klass and Assaf, "A Diffusion Model for Optimal Portfolio Selection in the
    Presence of Brokerage Fees" (1988); Gerhold, Muhle-Karbe and Schachermayer, "The dual optimizer
    for the growth-optimal portfolio under transaction costs" (2013). In y = logit(w) the weight is
    a Brownian motion with drift between two barriers, and the growth of a region (a, b) is

        g = r + ½σ² [m β + (β − α) m / (e^{mD} − 1)],  m = 2θ/σ² − 1,  D = logit b − logit a,

    where α is the weight a seen at the price of buying and β the weight b at that of selling. At
    the best region α and β lie δ below and above the Merton weight θ/σ², and
    g = r + θ²/2σ² − σ²δ²/2; one equation in δ remains.

    Args:
        drift: θ, the asset's expected return over cash, a year.
        volatility: σ, a year.
        cost: Of selling, as a fraction of the value sold; at least 0 and below 1.
        rate: Of cash, a year.
        buying: Cost of buying, as a fraction of the value bought; by default ``cost``. Where
            spending m buys (1 − c)m, as in the backtest, it is c/(1 − c).

    Raises:
        QfolioError: The Merton weight is not between 0 and 1, or so near to either that rounding
            hides an edge, or a parameter is out of range.
    """
    from scipy.optimize import brentq
    from scipy.special import expit, exprel, logit

    weight = _merton_weight(drift, volatility, cost)
    buying = cost if buying is None else buying
    _require(0 <= buying < math.inf, f"the cost of buying must not be negative; not {buying}")
    wedge = math.log1p(buying) - math.log1p(-cost)
    room = min(weight, 1 - weight)
    steep = 1 - 2 * room  # |m|
    delta = 0.0
    if wedge > 0:

        def excess(log_gap: float) -> float:
            """Of the condition at the edge (α or β) that is this close to all cash or all asset."""
            gap = math.exp(log_gap)
            reach = float(logit(2 * room - gap) - logit(gap)) + wedge
            inside = math.log(gap * (1 - gap) * reach * exprel(-steep * reach)) + steep * reach
            return inside - math.log(2 * (room - gap))

        ends = math.log(1e-15), math.log(room * (1 - 1e-14))
        _require(
            excess(ends[0]) < 0 < excess(ends[1]),
            f"with a Merton weight of {weight:.3g} and cost {cost:.3g} an edge of the best region "
            "cannot be told from the Merton weight, or from all cash or all asset",
        )
        delta = room - math.exp(brentq(excess, *ends, xtol=1e-15, rtol=1e-15))
    return NoTradeRegion(
        float(expit(logit(weight - delta) - math.log1p(buying))),
        float(expit(logit(weight + delta) - math.log1p(-cost))),
        rate + (drift**2 / volatility**2 - volatility**2 * delta**2) / 2,
    )


def no_trade_growth(
    low: ArrayLike,
    high: ArrayLike,
    drift: float,
    volatility: float,
    cost: float,
    rate: float = 0.0,
    buying: float | None = None,
) -> Float[np.ndarray, "..."]:
    """Growth a year of keeping the weight in any region low < high, as in ``no_trade_region``.

    Grades a learned region without simulation. ``low`` and ``high`` lie in (0, 1) and broadcast.
    """
    from scipy.special import exprel, logit

    buying = cost if buying is None else buying
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    _require(bool(np.all((a > 0) & (a < b) & (b < 1))), "a region needs 0 < low < high < 1")
    alpha, beta = a * (1 + buying) / (1 + buying * a), b * (1 - cost) / (1 - cost * b)
    m = 2 * drift / volatility**2 - 1
    reach = logit(b) - logit(a)
    inside = m * beta + (beta - alpha) / (reach * exprel(m * reach))
    return np.asarray(rate + volatility**2 / 2 * inside)


def no_trade_region_discrete(
    drift: float, volatility: float, cost: float, dt: float, rate: float = 0.0
) -> NoTradeRegion:
    """The no-trade region of an investor who may trade every ``dt`` years only.

    The backtest's rule: at each step the agent sees the weight w, trades at the remainder factor
    (so that buying costs c/(1 − c) of the value bought), and then earns
    log(1 − w + w exp((θ − σ²/2)dt + σ√dt ε)). With dt → 0 the region tends to that of
    ``no_trade_region(…, buying=cost / (1 - cost))``.

    Policy iteration for the average reward. Between the edges the relative value is a polynomial
    through Chebyshev points, outside it is the value at the edge less the cost of going there; the
    expectation is Gauss–Legendre quadrature between the edges and beyond them.

    Args:
        drift, volatility, cost, rate: As in ``no_trade_region``.
        dt: Years between decisions, above 0.

    Raises:
        QfolioError: A parameter is out of range, or no finite region is best.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import expit, logit

    _require(0 < dt < math.inf, f"dt must be positive; not {dt}")
    step, shift = volatility * math.sqrt(dt), (drift - volatility**2 / 2) * dt
    points = 48
    nodes, areas = np.polynomial.legendre.leggauss(points)
    chebyshev = np.cos(np.pi * (np.arange(points) + 0.5) / points)

    def polynomials(t: np.ndarray) -> np.ndarray:
        return np.asarray(np.polynomial.chebyshev.chebvander(t, points - 1))

    def ahead(y: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        """From logits y: E[log growth + log of the next trade], E[polynomials at the next logit]"""
        cuts = (np.array([low, high]) - y[:, None] - shift) / step
        ends = np.clip(np.insert(cuts, [0, 2], [-9.0, 9.0], axis=1), -9, 9)
        middle, half = (ends[:, 1:] + ends[:, :-1]) / 2, np.diff(ends) / 2
        z = middle[..., None] + half[..., None] * nodes  # (y, piece, node)
        chances = half[..., None] * areas * np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
        moved = y[:, None, None] + shift + step * z
        edge = np.clip(moved, low, high)
        # Growth of cash and asset together: (1 - w) + w x = (1 - w)(1 + odds).
        earned = np.logaddexp(0, moved) - np.logaddexp(0, y)[:, None, None]
        earned += _log_remainder(expit(moved), expit(edge), cost)
        basis = polynomials((2 * edge - low - high) / (high - low))
        return (earned * chances).sum((1, 2)), np.einsum("ypq,ypqn->yn", chances, basis)

    def improve(low: float, high: float) -> tuple[float, float, float]:
        """Growth a step of the region between two logits, and a region that is no worse."""
        earned, basis = ahead((low + high) / 2 + (high - low) / 2 * chebyshev, low, high)
        system = polynomials(chebyshev) - basis
        system[:, 0] = 1.0  # the value's constant is free; the gain takes its place
        gain, *rest = np.linalg.solve(system, earned)
        coefficients = np.array([0.0, *rest])

        def best(paid: Callable[[float], float], bounds: tuple[float, float]) -> float:
            """Where the value less what has been paid for going there is largest."""

            def loss(y: float) -> float:
                earned, basis = ahead(np.array([y]), low, high)
                return paid(float(expit(y))) - float(earned[0] + basis[0] @ coefficients)

            found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-9})
            return float(found.x)

        bought = best(lambda w: math.log1p(-cost * (1 - w)), (low - 2, high))
        sold = best(lambda w: math.log1p(-cost * w), (low, high + 2))
        return float(gain), bought, sold

    start = no_trade_region(drift, volatility, cost, buying=cost / (1 - cost))
    low, high = float(logit(start.low)), float(logit(start.high))
    if cost == 0:  # every step's best weight is the same
        loss = lambda y: -float(ahead(np.array([y]), low - 1, low + 1)[0][0])  # noqa: E731
        found = minimize_scalar(loss, bounds=(low - 2, low + 2), method="bounded")
        weight = float(expit(found.x))
        return NoTradeRegion(weight, weight, rate - float(found.fun) / dt)
    best, kept = -math.inf, (low, high)
    for _ in range(50):
        gain, *edges = improve(low, high)
        if gain - best <= 1e-13 * dt:
            break
        best, kept = gain, (low, high)
        low, high = edges
        if not low < high:  # narrower than rounding can tell
            break
    return NoTradeRegion(float(expit(kept[0])), float(expit(kept[1])), rate + best / dt)


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
    Transaction Costs" (2013), propositions 1 to 4: the best position moves the part a/λ of the way
    to an aim, in which factor k counts 1/(1 + φ_k a/γ) of what it would count without costs.

    Args:
        phi: Decay of each factor per step, in (0, 1]; shape (factor,), or a number for one.
        risk_aversion: γ > 0.
        cost_scale: λ ≥ 0, in units of Σ.
        loading: B, same shape as ``phi``.
        variance: Σ > 0 of the asset's noise.
        rho: Discount rate per step, between 0 and 1, both excluded.
        innovation: Covariance of ε, (factor, factor), or the variance of one or of each of several
            independent ones. Only the value depends on it.

    Raises:
        QfolioError: A parameter is out of range.
    """
    decay, b = np.atleast_1d(np.asarray(phi, float)), np.atleast_1d(np.asarray(loading, float))
    _require(
        decay.ndim == 1 and decay.shape == b.shape,
        f"phi and loading must have one number per factor; not {decay.shape}, {b.shape}",
    )
    _require(bool(np.all((decay > 0) & (decay <= 1))), f"phi must lie in (0, 1]; not {decay}")
    _require(
        risk_aversion > 0 and cost_scale >= 0 and variance > 0 and 0 < rho < 1,
        "risk_aversion and variance must be positive, cost_scale not negative, rho within (0, 1)",
    )
    omega = np.asarray(innovation, dtype=float)
    omega = np.diag(np.broadcast_to(omega, decay.shape)) if omega.ndim < 2 else omega
    _require(
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


def _market(drift: ArrayLike, covariance: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    mean, sigma = np.asarray(drift, dtype=float), np.asarray(covariance, dtype=float)
    _require(
        mean.ndim == 1 and mean.size > 0 and sigma.shape == (mean.size, mean.size),
        f"covariance must be (asset, asset) for drift (asset,); not {sigma.shape}, {mean.shape}",
    )
    _require(
        bool(np.all(np.isfinite(mean)) and np.all(np.isfinite(sigma)))
        and bool(np.allclose(sigma, sigma.T) and np.all(np.linalg.eigvalsh(sigma) > 0)),
        "covariance must be symmetric and positive definite, else risk-free profit has no optimum",
    )
    return mean, sigma


def _merton_weight(drift: float, volatility: float, cost: float) -> float:
    _require(0 < volatility < math.inf, f"volatility must be positive; not {volatility}")
    _require(0 <= cost < 1, f"cost must be at least 0 and below 1; not {cost}")
    weight = drift / volatility**2
    _require(
        1e-9 < weight < 1 - 1e-9,
        f"drift / volatility² is {weight:.3g}; it must lie between 0 and 1, or the best region "
        "touches all cash or all asset",
    )
    return weight


def _log_remainder(before: np.ndarray, after: np.ndarray, cost: float) -> np.ndarray:
    """Log of the wealth left by a rebalancing between weights of one asset; broadcasts."""
    buy = np.log1p(-cost * (1 - before)) - np.log1p(-cost * (1 - after))
    sell = np.log1p(-cost * before) - np.log1p(-cost * after)
    return np.asarray(np.where(after > before, buy, sell))


def _gauss(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and probabilities that stand for a standard normal variable."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    return nodes, weights / weights.sum()


def _require(holds: bool, sentence: str) -> None:
    if not holds:
        raise QfolioError(f"{sentence}.")
