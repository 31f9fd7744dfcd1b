"""Merton with leverage, shorts and two rates: known figures, limits, and a convex solver."""

from typing import Any

import numpy as np
import pytest

from optima import lognormal_scenarios, merton
from qfolio.core.errors import QfolioError
from qfolio.solvers.merton import leveraged_optimal

TWO = np.array([[0.04, 0.01], [0.01, 0.09]])


@pytest.mark.parametrize(
    ("drift", "weight"),
    [
        (0.03, 0.25),  # (.03 − .02)/.04: lends
        (0.06, 1.0),  # (.06 − .02)/.04 = 1
        (0.07, 1.0),  # 1.25 at the rate of lending, .75 at that of borrowing: neither
        (0.08, 1.0),
        (0.10, 1.5),  # (.10 − .04)/.04: borrows
        (0.01, -0.25),  # sells short, and lends
    ],
)
def test_three_regimes_of_one_asset(drift: float, weight: float) -> None:
    assert merton([drift], [[0.04]], rate=0.02, borrowing=0.04) == pytest.approx([weight])


@pytest.mark.parametrize("seed", range(30))
def test_several_assets_maximise_growth_with_a_kink(seed: int) -> None:
    """No other weights have more drift less half the risk, whichever side of the kink."""
    rng = np.random.default_rng(seed)
    mean = rng.normal(0.05, 0.03, 2)
    gamma = rng.uniform(0.5, 4)
    weights = merton(mean, TWO, gamma, rate=0.02, borrowing=0.05)

    def worth(w: np.ndarray) -> np.ndarray:
        cash = 1 - w.sum(-1)
        interest = np.minimum(0.02 * cash, 0.05 * cash)
        return np.asarray(w @ mean + interest - gamma / 2 * np.einsum("...i,ij,...j", w, TWO, w))

    for scale in (1e-3, 0.1, 3.0):
        others = weights + scale * rng.normal(size=(2000, 2))
        others[:1000, 1] += 1 - others[:1000].sum(-1)  # along the kink, too
        assert worth(others).max() <= worth(weights) + 1e-15


def test_all_regimes_are_met() -> None:
    sums = [
        merton([mu, mu], TWO, 2.0, rate=0.02, borrowing=0.05).sum()
        for mu in (0.03, 0.09, 0.11, 0.2)
    ]
    assert sums[0] < 1
    assert sums[1:3] == pytest.approx([1, 1])
    assert sums[3] > 1


def by_convex_solver(x: Any, p: Any, gamma: float, cash: float, debt: float) -> np.ndarray:
    import cvxpy as cp

    w, g = cp.Variable(x.shape[1]), cp.Variable(len(x))
    each = cp.log(g) if gamma == 1 else -cp.power(g, 1 - gamma) / (gamma - 1)
    bounds = [g <= relative + (x - relative) @ w for relative in (cash, debt)]
    problem = cp.Problem(cp.Maximize(p @ each), bounds)
    problem.solve(solver="CLARABEL", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    return np.asarray(w.value)


@pytest.mark.filterwarnings("ignore")  # of the convex solver's own
@pytest.mark.parametrize("gamma", [1.0, 3.0])
@pytest.mark.parametrize("mean", [-0.01, 0.002, 0.012, 0.03])
def test_scenarios_against_a_convex_solver(gamma: float, mean: float) -> None:
    rng = np.random.default_rng(8)
    x = np.exp(rng.multivariate_normal([mean, 0.5 * mean], TWO / 4, 60))
    p = rng.dirichlet(np.ones(60))
    found = leveraged_optimal(x, p, gamma, cash=1.002, debt=1.01)
    expected = by_convex_solver(x, p, gamma, 1.002, 1.01)
    assert found.weights == pytest.approx(expected, abs=2e-5)
    assert found.violation < 1e-10


@pytest.mark.parametrize("gamma", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("drift", [[0.01, 0.03], [0.06, 0.07], [0.11, 0.2], [0.09, -0.05]])
def test_no_other_weights_have_more_utility(gamma: float, drift: list[float]) -> None:
    x, p = lognormal_scenarios(drift, TWO, 0.25, points=5)
    assets = x[:, 1:]
    best = leveraged_optimal(assets, p, gamma, cash=1.005, debt=1.015)

    def utility(w: np.ndarray) -> np.ndarray:
        cash = 1 - w.sum(-1, keepdims=True)
        g = w @ assets.T + np.minimum(1.005 * cash, 1.015 * cash)
        with np.errstate(divide="ignore", invalid="ignore"):
            each = np.log(g) if gamma == 1 else (g ** (1 - gamma) - 1) / (1 - gamma)
        return np.where((g > 0).all(-1), each @ p, -np.inf)

    assert utility(best.weights) == pytest.approx(best.utility, abs=1e-14)
    rng = np.random.default_rng(0)
    for scale in (1e-3, 0.1, 1.0):
        others = best.weights + scale * rng.normal(size=(1000, 2))
        others[:500, 1] += 1 - others[:500].sum(-1)
        assert utility(others).max() <= best.utility + 1e-14


@pytest.mark.parametrize("drift", [[0.03, 0.04], [0.07, 0.08], [0.11, 0.2], [0.09, -0.05]])
def test_small_steps_tend_to_continuous_time(drift: list[float]) -> None:
    """In every regime, and with a short position."""
    goal = merton(drift, TWO, 2.0, rate=0.02, borrowing=0.05)
    apart = []
    for dt in (1 / 8, 1 / 32, 1 / 128):
        x, p = lognormal_scenarios(drift, TWO, dt)
        cash, debt = np.exp(0.02 * dt), np.exp(0.05 * dt)
        weights = leveraged_optimal(x[:, 1:], p, 2.0, cash, debt).weights
        apart.append(np.abs(weights - goal).max())
        if goal.sum() == pytest.approx(1):
            assert weights.sum() == pytest.approx(1, abs=1e-12)
    assert apart[2] < 0.004
    assert apart[1] / apart[2] == pytest.approx(4, rel=0.2)  # of first order in dt


def test_one_asset_alone() -> None:
    """A bet that doubles or halves: from lending over neither to borrowing."""
    x = [[2.0], [0.5]]
    assert leveraged_optimal(x).weights == pytest.approx([0.5])  # Cover's example
    assert leveraged_optimal(x, [0.9, 0.1], debt=1.75).weights == pytest.approx([1.0])
    # Always better than cash, but not than debt.
    assert leveraged_optimal([[1.01], [1.03]], debt=1.02).weights == pytest.approx([1.0])
    borrowed = leveraged_optimal(x, [0.9, 0.1])
    assert borrowed.weights == pytest.approx([1.7])  # .9/.5 − .1/1
    assert leveraged_optimal(x, [0.2, 0.8]).weights == pytest.approx([0.2 / 0.5 - 0.8])


@pytest.mark.parametrize(
    "call",
    [
        lambda: leveraged_optimal([[1.0], [0.0]]),
        lambda: leveraged_optimal([[1.1], [0.9]], [0.5, 0.4]),
        lambda: leveraged_optimal([[1.1], [0.9]], risk_aversion=0.0),
        lambda: leveraged_optimal([[1.1], [0.9]], cash=1.01, debt=1.0),
        lambda: leveraged_optimal([[1.1], [1.05]]),  # never less than cash
        lambda: leveraged_optimal([[1.1, 1.0], [0.9, 0.85]]),  # the first beats the second
    ],
)
def test_no_optimum(call: Any) -> None:
    with pytest.raises(QfolioError, match=r"^[^\n]+\.$"):
        call()
