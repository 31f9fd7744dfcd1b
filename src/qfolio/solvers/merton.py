"""The growth-optimal portfolio on the simplex, and Merton's, who may borrow and sell short."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from qfolio.solvers.shared import require, step_length


class GrowthOptimum(NamedTuple):
    """The growth-optimal portfolio of ``growth_optimal``."""

    weights: Float[np.ndarray, " asset"]
    growth: float
    """Expected log relative per step."""
    violation: float
    """Worst violation of the optimality conditions; growth is optimal to within this number."""


TOLERANCE = 1e-9
"""Largest violation of the conditions that ``growth_optimal`` accepts."""


def growth_optimal(relatives: ArrayLike, probabilities: ArrayLike | None = None) -> GrowthOptimum:
    """The weights b on the simplex that maximize E log(b·x) over finitely many scenarios.

    On the rows of a price history this is the best constant-rebalanced portfolio. Since
    b·∇E log(b·x) = 1, the maximum of E log(b·x) − 1'b over b ≥ 0 lies on the simplex by itself, and
    b is optimal exactly if E[x_i/(b·x)] ≤ 1 for all i, with equality where b_i > 0 (T. Cover, "An
    Algorithm for Maximizing Expected Log Investment Return", 1984, theorem 1). Cover's iteration
    comes first, then a primal-dual interior-point method; Newton's method on the assets held
    refines the result to rounding error.

    Args:
        relatives: Shape (scenario, asset), at least 0; cash, if wanted, is a column of ones.
        probabilities: Shape (scenario,), summing to 1 (default: equal).

    Raises:
        QfolioError: The arguments are not valid scenarios, every asset is worthless in one of them,
            or the conditions are not met.
    """
    x = np.asarray(relatives, dtype=float)
    require(
        x.ndim == 2 and x.size > 0 and bool(np.all(np.isfinite(x) & (x >= 0))),
        "relatives must be a table (scenario, asset) of finite numbers that are not negative",
    )
    p = _chances(probabilities, len(x))
    x, p = x[p > 0], p[p > 0]
    best = x.max(1, keepdims=True)
    require(bool(np.all(best > 0)), "in one scenario every asset is worthless; add cash")
    y = x / best  # changes neither the weights nor the conditions, and keeps numbers near 1
    b = np.full(y.shape[1], 1 / y.shape[1])
    for _ in range(10):
        b = b * _marginal(y, p, b)
    b = _newton_on_support(y, p, *_interior_point(y, p, b))
    slope = _marginal(y, p, b) - 1
    violation = float(np.max(np.where(b > 0, np.abs(slope), slope)))
    require(
        violation <= TOLERANCE,
        f"no growth-optimal weights were found; the best ones violate the optimality conditions by "
        f"{violation:.1g}, more than {TOLERANCE:.1g}",
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
        length = step_length((b, step_b), (z, step_z))
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
) -> Float[np.ndarray, " n"]:
    """Sets assets not held to exactly 0 and solves the conditions on the rest as equalities."""
    held = b > z
    b = np.where(held, b, 0.0)
    for _ in range(50):
        b /= b.sum()
        slope = _marginal(x, p, b) - 1
        if np.max(np.where(held, np.abs(slope), slope)) <= TOLERANCE / 1000:
            break
        wanted = held | (slope > TOLERANCE)
        # Redundant assets leave the step undetermined; the shortest one will do.
        curvature = _curvature(x[:, wanted], p, b[wanted])
        step = np.linalg.lstsq(curvature, slope[wanted], rcond=1e-13)[0]
        b[wanted] = np.maximum(b[wanted] + step, 0.0)
        held = b > 0
    return b


class LeveragedOptimum(NamedTuple):
    """The portfolio of ``leveraged_optimal``."""

    weights: Float[np.ndarray, " asset"]
    """Of the assets; the rest, which may be negative, is cash."""
    utility: float
    """E u(g), the expected utility of the relative of wealth."""
    violation: float
    """Largest of the slopes E[u'(g) ∂g] / E u'(g), which should all be 0."""


def leveraged_optimal(
    relatives: ArrayLike,
    probabilities: ArrayLike | None = None,
    risk_aversion: float = 1.0,
    cash: float = 1.0,
    debt: float | None = None,
) -> LeveragedOptimum:
    """The best weights over finitely many scenarios, for an investor who may borrow and short.

    Wealth grows by g = w·x + c R, where c = 1 − Σw is cash and R its relative: ``cash`` for c ≥ 0,
    else ``debt``, which is no less. E u(g), with u(g) = (g^(1−γ) − 1)/(1−γ) (log g for γ = 1), is
    concave in w and has a kink where c = 0. With the best weights without cash, the investor would
    neither lend nor borrow at R = E[u'(g) g] / E u'(g). If this R lies between the two relatives,
    those weights are optimal; else the optimum is the one for the nearer relative. Newton's method
    finds each.

    Args:
        relatives: Shape (scenario, asset), above 0.
        probabilities: Shape (scenario,), summing to 1 (default: equal).
        risk_aversion: γ > 0.
        cash: Relative of cash over the step.
        debt: Relative of what is borrowed over the step, at least ``cash`` (default: ``cash``).

    Raises:
        QfolioError: The arguments are not valid scenarios, or there is no optimum, because some
            portfolio never loses against cash or debt.
    """
    x = np.asarray(relatives, dtype=float)
    require(
        x.ndim == 2 and x.size > 0 and bool(np.all(np.isfinite(x) & (x > 0))),
        "relatives must be a table (scenario, asset) of finite numbers above 0",
    )
    p = _chances(probabilities, len(x))
    require(0 < risk_aversion < math.inf, f"risk aversion must be positive; not {risk_aversion}")
    debt = cash if debt is None else debt
    require(0 < cash < math.inf, f"the relative of cash must be positive; not {cash}")
    _require_rates(cash, debt)
    x, p = x[p > 0], p[p > 0]
    # Without cash, the first asset takes what the others leave.
    others, utility, violation = _unconstrained(x[:, 0], x[:, 1:] - x[:, :1], p, risk_aversion)
    weights = np.insert(others, 0, 1 - others.sum())
    g = x @ weights
    marginal = p * (g / g.min()) ** -risk_aversion
    even = float(marginal @ g / marginal.sum())
    if cash <= even <= debt:
        return LeveragedOptimum(weights, utility, violation)
    relative = cash if even < cash else debt
    return _unconstrained(np.full(len(x), relative), x - relative, p, risk_aversion)


def _unconstrained(
    base: Float[np.ndarray, " s"],
    excess: Float[np.ndarray, "s n"],
    p: Float[np.ndarray, " s"],
    gamma: float,
) -> LeveragedOptimum:
    """The maximum of E u(base + excess·w), by Newton's method with shorter steps near ruin."""

    def utility(g: np.ndarray) -> float:
        each = np.log(g) if gamma == 1 else np.expm1((1 - gamma) * np.log(g)) / (1 - gamma)
        return float(p @ each)

    def slope(g: np.ndarray) -> np.ndarray:
        """E[u'(g) excess] / E u'(g)"""
        marginal = p * (g / g.min()) ** -gamma
        return np.asarray(marginal @ excess / marginal.sum())

    w, g = np.zeros(excess.shape[1]), base
    for _ in range(200):
        marginal = p * (g / g.min()) ** -gamma
        scaled = excess * np.sqrt(gamma * marginal / marginal.sum() / g)[:, None]
        # Redundant assets leave the step undetermined; the shortest one will do.
        step = np.linalg.lstsq(scaled.T @ scaled, slope(g), rcond=1e-13)[0]
        length = 1.0
        while length > 1e-12:
            tried = base + excess @ (w + length * step)
            # Where utility has no digits left to improve, the slope has.
            if tried.min() > 0 and (
                utility(tried) > utility(g)
                or (utility(tried) > utility(g) - 1e-13 and _size(slope(tried)) < _size(slope(g)))
            ):
                break
            length /= 2
        else:
            break  # rounding: no step improves any more
        w, g = w + length * step, tried
    require(
        _size(slope(g)) < 1e-9,
        "no best weights were found; some portfolio never, or hardly ever, loses against cash or "
        "debt in these scenarios",
    )
    return LeveragedOptimum(w, utility(g), _size(slope(g)))


def _size(slope: Float[np.ndarray, " n"]) -> float:
    return float(np.abs(slope).max(initial=0.0))


def _require_rates(cash: float, debt: float) -> None:
    require(
        math.isfinite(cash) and cash <= debt < math.inf,
        f"debt must cost at least what cash earns, else borrowing to lend pays; not {debt} and "
        f"{cash}",
    )


def _chances(probabilities: ArrayLike | None, count: int) -> Float[np.ndarray, " s"]:
    """The scenarios' probabilities as an array; raises QfolioError if invalid."""
    p = np.full(count, 1 / count) if probabilities is None else np.asarray(probabilities, float)
    require(
        p.shape == (count,) and bool(np.all(p >= 0)) and abs(p.sum() - 1) < 1e-9,
        f"probabilities must be {count} numbers, not negative, that sum to 1",
    )
    return p
