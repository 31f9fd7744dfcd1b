"""Almgren and Chriss's sale: published numbers, and quadratic programming."""

import itertools
import math
from typing import Any

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.solvers.almgren_chriss import almgren_chriss

PAPER: dict[str, Any] = {
    "shares": 1.0, "volatility": 0.95, "temporary": 2.5, "permanent": 0.25, "risk_aversion": 1.0,
    "duration": 5.0, "steps": 5,
}  # fmt: skip
"""Table 1 of the paper, in million shares, days, and million dollars."""


def shortfall(positions: np.ndarray, p: dict[str, Any]) -> tuple[float, float]:
    """Expected shortfall and its variance, sale by sale."""
    tau = p["duration"] / p["steps"]
    price, cost, variance = 0.0, 0.0, 0.0
    for before, after in itertools.pairwise(positions):
        sold = before - after
        cost -= sold * (price - p["temporary"] * sold / tau)
        price -= p["permanent"] * sold
        variance += p["volatility"] ** 2 * tau * after**2
    return cost, variance


def test_figures_of_the_paper() -> None:
    sale = almgren_chriss(**PAPER)
    assert sale.kappa == pytest.approx(0.61, abs=0.005)  # section 4: a half-life of 1.6 days
    assert 1 / sale.kappa == pytest.approx(1.6, abs=0.05)
    assert sale.positions[[0, -1]] == pytest.approx([1, 0], abs=1e-15)
    # Equations 10 and 11: an even sale, the minimum of cost.
    even = almgren_chriss(**PAPER | {"risk_aversion": 0.0})
    assert even.positions == pytest.approx(np.linspace(1, 0, 6))
    assert even.cost == pytest.approx(0.125 + (2.5 - 0.125) / 5)
    assert even.variance == pytest.approx(0.95**2 / 3 * 5 * (1 - 1 / 5) * (1 - 1 / 10))
    # Half-lives and variances of the frontier (DRIP's AlmgrenChriss, whose costs include a spread
    # of 0.0625).
    for aversion, *published in (0.001, 51.30, 1.0812, 0.6625), (0.009, 17.10, 1.0669, 0.6626):
        sale = almgren_chriss(**PAPER | {"risk_aversion": aversion})
        half_life, variance, cost = published
        assert 1 / sale.kappa == pytest.approx(half_life, abs=0.006)
        assert sale.variance == pytest.approx(variance, abs=6e-5)
        assert sale.cost + 0.0625 == pytest.approx(cost, abs=6e-5)


@pytest.mark.parametrize("steps", [1, 2, 7, 40])
@pytest.mark.parametrize("aversion", [0.0, 0.02, 1.0, 300.0])
def test_the_sale_is_the_minimum_of_a_quadratic_program(steps: int, aversion: float) -> None:
    p = PAPER | {"steps": steps, "risk_aversion": aversion, "shares": 1.7, "duration": 3.0}
    sale = almgren_chriss(**p)
    tau, n = 3.0 / steps, steps - 1
    # Over the positions between start and end; from the shortfall of a list of sales, in which each
    # pays for its own impact and for the permanent impact of the ones before.
    difference = np.diff(np.eye(steps + 1), axis=0) * -1
    later = np.tril(np.ones((steps, steps)), -1)
    impact = p["temporary"] / tau * np.eye(steps) + p["permanent"] * (later + later.T) / 2
    held = np.eye(steps + 1)[1:]
    hessian = difference.T @ impact @ difference + aversion * 0.95**2 * tau * held.T @ held
    inner = hessian[1:-1, 1:-1]
    free = np.linalg.solve(inner, -hessian[1:-1, 0] * 1.7) if n else np.zeros(0)
    expected = np.concatenate([[1.7], free, [0.0]])
    assert sale.positions == pytest.approx(expected, abs=1e-12)
    cost, variance = shortfall(sale.positions, p)
    assert (sale.cost, sale.variance) == pytest.approx((cost, variance), rel=1e-12)
    assert cost + aversion * variance == pytest.approx(expected @ hessian @ expected, rel=1e-12)


def test_the_fastest_sale_does_not_overflow() -> None:
    sale = almgren_chriss(**PAPER | {"risk_aversion": 1e12, "steps": 1000})
    assert sale.positions[1] < 1e-6
    assert np.isfinite(sale.positions).all()


@pytest.mark.parametrize(
    "change",
    [
        {"volatility": -0.1},
        {"permanent": 6.0},
        {"temporary": 0.0},
        {"risk_aversion": -1.0},
        {"duration": 0.0},
        {"steps": 0},
        {"shares": math.nan},
    ],
)
def test_sales_without_a_best_speed(change: dict[str, Any]) -> None:
    with pytest.raises(QfolioError, match=r"^[^\n]+\.$"):
        almgren_chriss(**PAPER | change)
