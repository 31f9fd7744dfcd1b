"""The no-trade region of a log investor who pays proportional costs."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from qfolio.solvers.shared import log_remainder, require


class NoTradeRegion(NamedTuple):
    """The edges of a no-trade region, as weights of the asset, and the growth that it earns."""

    low: float
    high: float
    growth: float
    """Log growth a year."""


def no_trade_region(
    drift: float, volatility: float, cost: float, rate: float = 0.0, buying: float | None = None
) -> NoTradeRegion:
    """The weights between which an investor with log utility does not trade, in continuous time.

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
        cost: Cost of selling, as a fraction of the value sold; at least 0 and below 1.
        rate: Interest rate of cash, a year.
        buying: Cost of buying, as a fraction of the value bought (default: ``cost``). If spending
            m buys (1 − c)m, as in the backtest, it is c/(1 − c).

    Raises:
        QfolioError: The Merton weight is not between 0 and 1, or so near to either that rounding
            hides an edge, or a parameter is out of range.
    """
    from scipy.optimize import brentq
    from scipy.special import expit, exprel, logit

    weight = _merton_weight(drift, volatility, cost)
    buying = cost if buying is None else buying
    require(0 <= buying < math.inf, f"the cost of buying must not be negative; not {buying}")
    wedge = math.log1p(buying) - math.log1p(-cost)
    room = min(weight, 1 - weight)
    steep = 1 - 2 * room  # |m|
    delta = 0.0
    if wedge > 0:

        def excess(log_gap: float) -> float:
            """Residual at the edge (α or β) that is exp(log_gap) from all cash or all asset."""
            gap = math.exp(log_gap)
            reach = float(logit(2 * room - gap) - logit(gap)) + wedge
            inside = math.log(gap * (1 - gap) * reach * exprel(-steep * reach)) + steep * reach
            return inside - math.log(2 * (room - gap))

        ends = math.log(1e-15), math.log(room * (1 - 1e-14))
        require(
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


def no_trade_region_discrete(
    drift: float, volatility: float, cost: float, dt: float, rate: float = 0.0
) -> NoTradeRegion:
    """The no-trade region of an investor who may trade only every ``dt`` years.

    As in the backtest, at each step the agent sees the weight w, trades at the remainder factor
    (so that buying costs c/(1 − c) of the value bought), and then earns
    log(1 − w + w exp((θ − σ²/2)dt + σ√dt ε)). With dt → 0 the region tends to that of
    ``no_trade_region(…, buying=cost / (1 - cost))``.

    Solved by policy iteration for the average reward. Between the edges the relative value is a
    polynomial at Chebyshev points; outside, it is the value at the edge less the cost of going
    there. Expectations use Gauss–Legendre quadrature between the edges and beyond them.

    Args:
        drift, volatility, cost, rate: As in ``no_trade_region``.
        dt: Years between decisions, above 0.

    Raises:
        QfolioError: A parameter is out of range, or no finite region is best.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import expit, logit

    require(0 < dt < math.inf, f"dt must be positive; not {dt}")
    require(0 <= cost < 1, f"cost must be at least 0 and below 1; not {cost}")
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
        earned += log_remainder(expit(moved), expit(edge), cost)
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
            """Where the value less the cost of going there is largest."""

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


def _merton_weight(drift: float, volatility: float, cost: float) -> float:
    require(0 < volatility < math.inf, f"volatility must be positive; not {volatility}")
    require(0 <= cost < 1, f"cost must be at least 0 and below 1; not {cost}")
    weight = drift / volatility**2
    require(
        1e-9 < weight < 1 - 1e-9,
        f"drift / volatility² is {weight:.3g}; it must be above 0 and below 1, or the best region "
        "touches all cash or all asset",
    )
    return weight
