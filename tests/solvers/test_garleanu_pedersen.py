"""Gârleanu and Pedersen's rule: the paper's figures, Riccati iterations, values by moments."""

from typing import Any

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.solvers.garleanu_pedersen import garleanu_pedersen

PAPER: dict[str, Any] = {"risk_aversion": 1.0, "cost": 0.2, "covariance": 0.04, "rho": 0.01}
"""One asset with λ = 5 in units of Σ."""

ASSETS: dict[str, Any] = {
    "phi": np.array([0.05, 0.2, 0.5, 1.0]),
    "risk_aversion": 2.0,
    "cost": np.array([[0.3, 0.05, 0.0], [0.05, 0.1, -0.02], [0.0, -0.02, 1.5]]),
    "loading": np.array([[1.0, 0.2, 0.0, 0.4], [0.3, -0.5, 0.8, 0.0], [0.0, 0.1, 1.0, -0.6]]),
    "covariance": np.array([[0.04, 0.01, 0.005], [0.01, 0.09, -0.01], [0.005, -0.01, 0.02]]),
    "rho": 0.03,
}
"""Costs that are not proportional to the covariance, and factors that load on several assets."""


def riccati(
    phi: np.ndarray, loading: np.ndarray, risk_aversion: float, cost: Any, covariance: Any,
    rho: float,
) -> np.ndarray:  # fmt: skip
    """Coefficients of (positions before, factors), by value iteration on a general quadratic."""
    cost, covariance = np.atleast_2d(cost), np.atleast_2d(covariance)
    assets, keep = len(cost), 1 - rho
    n = assets + len(phi)
    # State y = (x before, f), control x: reward ½ y'Qy + x'C y − ½ x'H x; then y' = A y + E x.
    a, q = np.zeros((n, n)), np.zeros((n, n))
    a[assets:, assets:] = np.diag(1 - phi)
    e = np.eye(n)[:, :assets]
    q[:assets, :assets] = -cost
    c = np.hstack([cost, keep * np.atleast_2d(loading)])
    h = cost + keep * risk_aversion * covariance
    value = np.zeros((n, n))
    for _ in range(6000):
        pull = c + keep * e.T @ value @ a
        drag = h - keep * e.T @ value @ e
        law = np.linalg.solve(drag, pull)
        value = q + keep * a.T @ value @ a + pull.T @ law
    return np.asarray(law)


def test_figures_of_one_asset() -> None:
    rule = garleanu_pedersen(0.25, loading=1.0, **PAPER)
    assert rule.previous == pytest.approx(np.array([[0.645664384]]), abs=5e-10)
    assert rule.factors == pytest.approx(np.array([[6.139213092]]), abs=5e-10)


@pytest.mark.parametrize("phi", [[0.25], [0.05, 0.5, 1.0]])
def test_one_asset_agrees_with_a_riccati_iteration(phi: list[float]) -> None:
    loading = np.array([1.0, -0.7, 0.3])[: len(phi)]
    expected = riccati(np.array(phi), loading, **PAPER)
    rule = garleanu_pedersen(phi, loading=loading, **PAPER)
    assert np.hstack([rule.previous, rule.factors]) == pytest.approx(expected, rel=1e-12)


def test_several_assets_agree_with_a_riccati_iteration() -> None:
    rule = garleanu_pedersen(**ASSETS)
    found = np.hstack([rule.previous, rule.factors])
    assert found == pytest.approx(riccati(**ASSETS), abs=1e-11)
    assert abs(found[:, :3] - np.diag(np.diag(found[:, :3]))).max() > 0.02  # assets hang together


def test_the_rule_is_the_papers() -> None:
    """Propositions 1 and 2: A solves its equation, and trades go Λ⁻¹A of the way to the aim."""
    rule = garleanu_pedersen(**ASSETS)
    cost, sigma, gamma = ASSETS["cost"], ASSETS["covariance"], ASSETS["risk_aversion"]
    keep, decay = 1 - ASSETS["rho"], np.diag(ASSETS["phi"])
    a = cost @ (np.eye(3) - rule.previous)
    assert a == pytest.approx(a.T, abs=1e-14)
    curvature = cost + keep * (gamma * sigma + a)
    assert a == pytest.approx(cost - cost @ np.linalg.solve(curvature, cost), abs=1e-13)
    c = cost @ rule.factors
    future = ASSETS["loading"] + c @ (np.eye(4) - decay)
    assert c == pytest.approx(keep * cost @ np.linalg.solve(curvature, future), abs=1e-13)


def test_costs_proportional_to_the_covariance_give_one_fraction() -> None:
    """Proposition 3: every asset moves by the same fraction."""
    sigma = ASSETS["covariance"]
    rule = garleanu_pedersen(**ASSETS | {"cost": 5.0 * sigma, "risk_aversion": 1.0, "rho": 0.01})
    assert rule.previous == pytest.approx(0.645664384 * np.eye(3), abs=1e-9)


@pytest.mark.parametrize("case", ["one asset", "several"])
def test_values_by_moments(case: str) -> None:
    # The rule is linear, so that the expected reward of each step follows from the covariance of
    # (x before, f), which is moved forward step by step.
    p, noise = ASSETS, np.diag([0.02, 0.01, 0.03, 0.05]) + 0.002
    if case == "one asset":
        p = PAPER | {"phi": np.array([0.25, 0.1]), "loading": np.array([[1.0, 0.5]])}
        noise = np.array([[0.02, 0.005], [0.005, 0.01]])
    rule = garleanu_pedersen(innovation=noise, **p)
    n, k = rule.factors.shape
    cost, sigma = np.atleast_2d(p["cost"]), np.atleast_2d(p["covariance"])
    decay, keep = 1 - p["phi"], 1 - p["rho"]

    def utility(previous: np.ndarray, factors: np.ndarray) -> float:
        moments = np.zeros((n + k, n + k))
        moments[n:, n:] = noise / (1 - np.outer(decay, decay))
        law = np.hstack([previous, factors])
        move = np.vstack([law, np.hstack([np.zeros((k, n)), np.diag(decay)])])
        shock = np.zeros((n + k, n + k))
        shock[n:, n:] = noise
        change = law - np.eye(n, n + k)
        gain = np.hstack([np.zeros((n, n)), p["loading"]])
        total = 0.0
        for t in range(4000):
            earned = np.trace(gain @ moments @ law.T)
            risk = p["risk_aversion"] * np.trace(sigma @ law @ moments @ law.T)
            paid = np.trace(cost @ change @ moments @ change.T)
            total += keep**t * (keep * (earned - risk / 2) - paid / 2)
            moments = move @ moments @ move.T + shock
        return float(total)

    assert utility(rule.previous, rule.factors) == pytest.approx(rule.value, rel=1e-12)
    for other in (0.97, 1.03):
        assert utility(rule.previous * other, rule.factors) < rule.value
        assert utility(rule.previous, rule.factors * other) < rule.value


def test_limits() -> None:
    free = garleanu_pedersen(**ASSETS | {"cost": np.zeros((3, 3))})
    assert free.previous == pytest.approx(np.zeros((3, 3)), abs=1e-12)
    markowitz = np.linalg.solve(ASSETS["covariance"], ASSETS["loading"]) / 2
    assert free.factors == pytest.approx(markowitz)
    dear = garleanu_pedersen(**ASSETS | {"cost": 1e9 * np.eye(3)})
    assert dear.previous == pytest.approx(np.eye(3), abs=1e-5)
    assert dear.factors == pytest.approx(np.zeros((3, 4)), abs=1e-5)


@pytest.mark.parametrize(
    "change",
    [
        {"phi": 0.0},
        {"risk_aversion": 0.0},
        {"phi": [0.1, 0.2]},
        {"cost": -1.0},
        {"covariance": 0.0},
        {"covariance": np.eye(2)},
        {"rho": 1.0},
        {"innovation": -1.0},
    ],
)
def test_parameters_without_an_optimum(change: dict[str, Any]) -> None:
    with pytest.raises(QfolioError, match=r"^[^\n]+\.$"):
        garleanu_pedersen(**{"phi": 0.25, "loading": 1.0} | PAPER | change)
