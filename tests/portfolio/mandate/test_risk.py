"""Limits on volatility and tracking error: what an order's risk is, and where it goes."""

import dataclasses

import cvxpy
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from qfolio.core.errors import QfolioError
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.feasible import Mandated, exactly
from qfolio.portfolio.mandate.limits import feasible, mandate_text
from qfolio.portfolio.mandate.mandate import Mandate
from qfolio.portfolio.mandate.risk import Risk
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from tables import price_table

ASSETS = ("A", "B", "C", "D", "E")

ROWS = 400


def table(seed: int = 0, rows: int = ROWS) -> Prices:
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.005, 0.03, 5) * np.exp(rng.normal(0, 0.3, (rows, 1)))
    values = 50 * np.exp(np.cumsum(rng.normal(3e-4, 1, (rows, 5)) * scale, axis=0))
    return price_table(values, ASSETS)


def portfolio(prices: Prices, risk: dict, **limits) -> Portfolio:
    return Portfolio.of(prices, mandate={"risk": risk, **limits}, window=10, horizon=20)


def annual_returns(prices: Prices, row: int, past: int = 252) -> np.ndarray:
    """The last known returns, scaled so that the norm of ``returns @ weights`` is volatility."""
    known = prices.values[max(0, row - past) : row + 1]
    return (known[1:] / known[:-1] - 1) * np.sqrt(prices.periods_per_year / (len(known) - 1))


def volatility(prices: Prices, row: int, weights: np.ndarray, past: int = 252) -> float:
    """Annual, from the last returns that are known."""
    return float(np.linalg.norm(annual_returns(prices, row, past) @ weights))


@pytest.mark.parametrize("past", [20, 252])
def test_an_order_is_as_risky_as_it_may_be(past):
    prices, rng = table(), np.random.default_rng(1)
    task = portfolio(prices, {"volatility": 0.12, "rows": past}, assets={"cap": 0.6})
    order = jax.jit(lambda row, wanted: task.wanted(row, task.hold(wanted), wanted))
    bound = 0
    for row in rng.integers(20, ROWS, 60):
        wanted = rng.dirichlet(np.full(6, 0.5))
        capped = np.minimum(wanted[1:], 0.6)
        found = np.asarray(order(jnp.array(row), jnp.asarray(wanted, jnp.float32)), float)
        if volatility(prices, row, capped, past) < 0.12:
            np.testing.assert_allclose(found[1:], capped, atol=1e-6)
        else:
            assert volatility(prices, row, found[1:], past) == pytest.approx(0.12, rel=3e-5)
            bound += 1
    assert 20 < bound < 60


RISKS = (
    {"volatility": 0.12},
    {"tracking_error": 0.03},
    {"volatility": 0.12, "tracking_error": 0.06},
)


@eqx.filter_jit
def traded(task: Portfolio, row: Array, wanted: Array, held: Array) -> Array:
    return task.allow(row, task.hold(held), wanted)


@pytest.mark.parametrize("risk", RISKS)
def test_no_order_is_nearer(risk):
    """A conic solver finds the nearest one. Baselines' are in float64, agents' in float32."""
    prices, rng, equal = table(), np.random.default_rng(5), np.full(5, 0.2)
    centers = {"volatility": 0 * equal, "tracking_error": equal}
    task = portfolio(prices, risk, assets={"cap": 0.6})
    ratios = []
    for row in rng.integers(20, ROWS, 150):
        wanted, held = rng.dirichlet(np.full(6, 0.5)), rng.dirichlet(np.ones(6))
        factor = np.linalg.qr(annual_returns(prices, row), "r")
        nearest = cvxpy.Variable(5)
        conditions = [nearest >= 0, cvxpy.sum(nearest) <= 1, nearest <= 0.6]
        for name, most in risk.items():
            conditions.append(cvxpy.norm(factor @ (nearest - centers[name])) <= most)
        away = cvxpy.sum_squares(nearest - wanted[1:])
        least = cvxpy.Problem(cvxpy.Minimize(away), conditions).solve(cvxpy.CLARABEL) ** 0.5
        for order in (
            exactly(task.feasible_at(jnp.array(row)), wanted, held),
            traded(task, jnp.array(row), *jnp.asarray([wanted, held], jnp.float32)),
        ):
            found = np.asarray(order, float)[1:]
            assert min(found.min(), 1 - found.sum(), 0.6 - found.max()) >= -1e-6
            for name, most in risk.items():
                assert volatility(prices, row, found - centers[name]) <= most * (1 + 3e-5)
            if least > 1e-3:
                ratios.append(np.linalg.norm(found - wanted[1:]) / least)
    assert len(ratios) > 200
    assert min(ratios) > 1 - 1e-4
    for of_one_kind in (ratios[::2], ratios[1::2]):
        assert np.mean(of_one_kind) < 1.0001
        assert max(of_one_kind) < 1.005


@pytest.mark.parametrize("forbidden", [[], ["A"]])
def test_few_holdings_are_chosen_with_an_eye_on_risk(forbidden):
    """All of B is wanted, but only B and C together are near enough to the benchmark."""
    limits = {
        "assets": {"forbidden": forbidden}, "trading": {"holdings": 2},
        "risk": {"tracking_error": 0.05},
    }  # fmt: skip
    made = feasible(mandate_text(limits, ("A", "B", "C")), np.ones(3, bool))
    covariance, benchmark = 0.04 * np.eye(3), np.array([0.0, 0.5, 0.5])
    made = made.knowing(Risk(jnp.asarray(covariance), jnp.asarray(benchmark)))
    order = exactly(made, np.array([0, 0, 1.0, 0]), np.array([1.0, 0, 0, 0]))
    np.testing.assert_allclose(order, [0, 0, 0.5 + 0.25 / np.sqrt(2), 0.5 - 0.25 / np.sqrt(2)],
                               atol=2e-3)  # fmt: skip


@pytest.mark.parametrize("room", [2**24, 0])
def test_the_risk_of_an_asset_that_joins_comes_from_its_own_days(monkeypatch, room):
    monkeypatch.setattr("qfolio.portfolio.mandate.risk.ROOM", room)
    prices, first = table(), 300
    values = np.array(prices.values)
    values[:first, 2] = np.nan
    members = np.ones_like(values, bool)
    members[:50, 0] = False
    late = Prices(prices.dates, ASSETS, values, members=members)
    task = Portfolio.blank(5, 0, mandate=mandate_text({"risk": {"volatility": 0.2}}, ASSETS)).on(
        late
    )
    for row in (first + 10, ROWS - 1):
        found = np.asarray(task.risk_at(jnp.array(row)).covariance)
        for i in range(5):
            past = min(252, row - first * (i == 2))
            assert found[i, i] == pytest.approx(
                volatility(prices, row, np.eye(5)[i], past) ** 2, rel=1e-4
            )
        assert np.linalg.eigvalsh(found).min() > 0


def test_other_limits_hold_and_both_risks_are_met_where_they_can_be():
    prices, rng = table(), np.random.default_rng(3)
    limits = {"assets": {"cap": 0.5, "floor": {"A": 0.05}}, "cash": {"min": 0.02},
              "trading": {"turnover": 0.8}}  # fmt: skip
    task = portfolio(prices, {"volatility": 0.15, "tracking_error": 0.06}, **limits)
    equal, met = np.full(5, 0.2), 0
    for row in rng.integers(20, ROWS, 60):
        wanted, held = rng.dirichlet(np.full(6, 0.5), 2)
        allowed = task.feasible_at(jnp.array(row))
        assert isinstance(allowed, Mandated)
        found = exactly(allowed, wanted, held)
        outside = max(allowed.violations(held).values()) > 0
        for said, amount in allowed.violations(found, held).items():
            assert amount <= 1e-6 or (outside and said.startswith("turnover")), said

        def over(weights, row=row):
            tracked = volatility(prices, row, weights[1:] - equal) / 0.06
            return max(tracked, volatility(prices, row, weights[1:]) / 0.15) - 1

        safe = equal * min(1.0, 0.15 / volatility(prices, row, equal))
        if over(exactly(allowed, np.append(1 - safe.sum(), safe), held)) <= 0:
            assert over(found) <= 1e-5
            further = found + 1e-3 * (exactly(_without_risk(allowed), wanted, held) - found)
            assert abs(further - found).max() < 1e-6 or over(further) > 0
            met += 1
    assert 20 < met < 60


def _without_risk(allowed: Mandated) -> Mandated:
    return dataclasses.replace(allowed, risk=None)


@pytest.mark.parametrize("room", [2**24, 0])
def test_risk_is_known_without_later_prices(monkeypatch, room):
    monkeypatch.setattr("qfolio.portfolio.mandate.risk.ROOM", room)
    prices = table()
    task, row = portfolio(prices, {"volatility": 0.1, "tracking_error": 0.05}), 100
    other = prices.values.copy()
    other[row + 1 :] *= np.exp(np.random.default_rng(0).normal(0, 0.5, other[row + 1 :].shape))
    changed = portfolio(Prices(prices.dates, ASSETS, other), {"volatility": 0.1})
    wanted = np.append(0.0, np.eye(5)[2])
    for early in (5, 60, row):
        mine, theirs = (t.risk_at(jnp.array(early)) for t in (task, changed))
        np.testing.assert_array_equal(mine.covariance, theirs.covariance)
        risk = float(mine.of(jnp.asarray(wanted[1:], jnp.float32)))
        np.testing.assert_allclose(risk, volatility(prices, early, wanted[1:]), rtol=1e-4)


@pytest.mark.parametrize("risk", RISKS)
def test_its_derivative_is_that_of_finite_differences(risk):
    with jax.enable_x64(True):
        task = portfolio(table(), risk)
        allowed, rng = task.feasible_at(jnp.array(300)), np.random.default_rng(4)
        wanted, held, by = jnp.asarray(rng.dirichlet(np.ones(6), (3, 40)))
        score = jnp.asarray(rng.normal(size=(40, 6)))

        def worth(wanted, held, score):
            return (allowed.project(wanted, held) * score).sum()

        slope = (jax.jit(jax.vmap(jax.grad(worth)))(wanted, held, score) * (by - wanted)).sum(1)
        step, each = 1e-3, jax.jit(jax.vmap(worth))
        ahead, back = (each(wanted + s * (by - wanted), held, score) for s in (step, -step))
        # The search ends where risk is met; along the limit, the order is less exact.
        off = np.asarray(abs(slope - (ahead - back) / (2 * step)))
        assert np.median(off) < 1e-4
        assert np.mean(off < 3e-3) >= 0.85  # but at kinks
        assert np.median(abs(slope)) > 0.05


def test_no_wish_moves_an_order_whose_risk_cannot_be_met():
    task = portfolio(table(), {"volatility": 0.1, "tracking_error": 0.001})
    allowed, equal = task.feasible_at(jnp.array(300)), jnp.array([0.0, *[0.2] * 5])
    slope = jax.grad(lambda wanted: (allowed.project(wanted, equal) * jnp.arange(6.0)).sum())(equal)
    np.testing.assert_array_equal(slope, 0.0)


def test_its_derivative_is_finite_at_the_benchmark():
    """An anchored policy starts there, without any tracking error."""
    task = portfolio(table(), {"tracking_error": 0.05})
    allowed, equal = task.feasible_at(jnp.array(300)), jnp.array([0.0, *[0.2] * 5])
    score = jnp.arange(6.0)
    slope = jax.jit(jax.grad(lambda wanted: (allowed.project(wanted, equal) * score).sum()))(equal)
    assert jnp.isfinite(slope).all()


def test_what_it_is_measured_against_must_be_known():
    with pytest.raises(
        QfolioError, match="benchmark 'SPY', which is no asset of the table and no baseline"
    ):
        Mandate.of({"benchmark": "SPY", "risk": {"tracking_error": 0.05}}).text(ASSETS)
    text = Mandate.of({"benchmark": "A", "risk": {"tracking_error": 0.05}}).text(ASSETS)
    assert '"benchmark":"A"' in text
    own = {"tracking_error": 0.05, "benchmark": "B"}
    assert '"benchmark":"B"' in Mandate.of({"benchmark": "A", "risk": own}).text(ASSETS)
    assert "benchmark" not in Mandate.of({"benchmark": "A", "risk": {"volatility": 0.1}}).text(
        ASSETS
    )


def test_it_may_be_measured_against_a_column_of_weights():
    weights = np.tile([0.4, 0.3, 0.1, 0.1, 0.1], (ROWS, 1))
    prices = dataclasses.replace(table(), features=weights[..., None], feature_names=("index",))
    task = portfolio(prices, {"tracking_error": 0.05, "benchmark": "feature:index"})
    np.testing.assert_allclose(task.benchmarks, weights, rtol=1e-6)
    with pytest.raises(QfolioError, match=r"or to feature:NAME with its weights\.$"):
        portfolio(prices, {"tracking_error": 0.05, "benchmark": "index"})


def calmer(made: Mandated, share: float) -> Mandated:
    """The set at a row where all volatility is a share of what it is."""
    assert isinstance(made.risk, Risk)
    return made.knowing(made.risk._replace(covariance=share**2 * made.risk.covariance))


SHORTS = {"assets": {"cap": 0.5, "floor": -0.1}, "cash": {"min": -0.2, "max": 0.0}}


@pytest.mark.parametrize(
    ("kind", "limits"),
    [
        ("volatility", {"cash": {"max": 0.05}}),
        ("volatility", {"assets": {"cap": 0.25}, "cash": {"max": 0.1}}),
        ("volatility", SHORTS | {"exposure": {"gross": 1.5}}),
        ("tracking error", {"cash": {"min": 0.2}}),
        ("tracking error", {"assets": {"forbidden": ["A", "B"]}}),
    ],
)  # fmt: skip
def test_the_least_risk_is_what_a_conic_solver_finds(kind, limits):
    prices = table()
    task = portfolio(prices, {kind.replace(" ", "_"): 0.001}, **limits)
    made = feasible(task.mandate, np.ones(5, bool)).knowing(task.risk_at(jnp.array(300)))
    weights, center = cvxpy.Variable(5), np.full(5, 0.2 if kind == "tracking error" else 0.0)
    low, high, rows, most, gross, _ = made.limits[:6]
    conditions = [weights >= low, weights <= high, rows @ weights <= most]
    conditions += [cvxpy.norm1(weights) <= gross] if np.isfinite(gross) else []
    risk = cvxpy.norm(annual_returns(prices, 300) @ (weights - center))
    least = cvxpy.Problem(cvxpy.Minimize(risk), conditions).solve(cvxpy.CLARABEL)
    found = checks._least_risk(made, kind, 0.0)
    assert least * (1 - checks.GAP) - 1e-6 <= found <= least * (1 + 1e-4)
    checks.require_safe(task.mandate, [calmer(made, 1e-9)])
    with pytest.raises(
        QfolioError, match=rf"cannot be met: {kind} is at least {100 * found:.3g}% at"
    ):
        checks.require_safe(task.mandate, [made])


def test_what_forces_risk_is_named_if_no_row_allows_as_little():
    prices = table()
    task = portfolio(prices, {"volatility": 0.02}, assets={"cap": 0.6}, cash={"max": 0.05})
    risky = feasible(task.mandate, np.ones(5, bool)).knowing(task.risk_at(jnp.array(300)))
    said = (
        r"least \d+\.?\d*% at the start of every fold, with cash of at most 5%, and "
        r"risk\.volatility is 2%; change"
    )
    with pytest.raises(QfolioError, match=said):
        checks.require_safe(task.mandate, [risky, risky])
    checks.require_safe(task.mandate, [risky, calmer(risky, 0.1)])
    checks.require_safe(mandate_text({"cash": {"max": 0.05}}, ASSETS), iter([]))


def test_least_risk_up_to_a_twentieth_above_its_limit_counts_as_met():
    task = portfolio(table(), {"volatility": 0.02}, cash={"max": 0.05})
    risky = feasible(task.mandate, np.ones(5, bool)).knowing(task.risk_at(jnp.array(300)))
    least = checks._least_risk(risky, "volatility", 0.0)
    checks.require_safe(task.mandate, [calmer(risky, 1.03 * 0.02 / least)])
    with pytest.raises(QfolioError, match="cannot be met: volatility"):
        checks.require_safe(task.mandate, [calmer(risky, 1.07 * 0.02 / least)])


@pytest.mark.parametrize("order", [1, -1])
def test_the_least_risk_of_all_rows_is_said(order):
    task = portfolio(table(), {"volatility": 0.001}, cash={"max": 0.05})
    risky = feasible(task.mandate, np.ones(5, bool)).knowing(task.risk_at(jnp.array(300)))
    least = 50 * checks._least_risk(risky, "volatility", 0.0)
    with pytest.raises(QfolioError, match=f"volatility is at least {least:.3g}% at the start"):
        checks.require_safe(task.mandate, [risky, calmer(risky, 0.5)][::order])


@pytest.mark.parametrize(
    ("forbidden", "said"),
    [(["A"], "with assets.forbidden, and .* change one of them"), ([], "fold, and .* raise it")],
)
def test_assets_that_cannot_be_held_may_force_tracking_error(forbidden, said):
    task = portfolio(table(), {"tracking_error": 0.001}, assets={"forbidden": forbidden})
    there = np.array([False, True, True, True, True])
    made = feasible(task.mandate, there).knowing(task.risk_at(jnp.array(300)))
    with pytest.raises(QfolioError, match=said):
        checks.require_safe(task.mandate, [made])
