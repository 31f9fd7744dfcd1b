"""What drives the trades of a policy that is known."""

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.text import figure
from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.drivers import (
    Driver,
    Reason,
    _bounds,
    reasons,
    sentence,
)
from qfolio.portfolio.mandate.feasible import CappedSimplex
from qfolio.portfolio.mandate.limits import feasible, mandate_text
from qfolio.portfolio.policy import Policy

from planted import ASSETS, Known, four_folds, planted


@pytest.fixture(scope="module")
def plan():
    prices = planted()
    stretch = four_folds(prices)[-1]
    policy = Policy(stretch.task, Known("momentum"), jnp.array([0.4, 0.6]), prices.assets)
    allocation = Allocation.of(policy, prices, np.zeros(ASSETS), 1000.0)
    return allocation, reasons(policy, prices, allocation)


def test_the_largest_trades_are_explained_exactly(plan):
    """From cash to equal weights, tilted by half of the rank of momentum."""
    allocation, found = plan
    changes = dict(zip(allocation.assets, allocation.weights[1:], strict=True))
    assert [reason.change for reason in found] == sorted(changes.values(), reverse=True)[:3]
    for reason in found:
        assert reason.change == changes[reason.asset]
        first, *others = reason.drivers
        assert first.name == "momentum:20"
        assert reason.rest == pytest.approx(1 / ASSETS, abs=1e-6)
        assert first.weight == pytest.approx(reason.change - 1 / ASSETS, abs=1e-6)
        assert [each.weight for each in others] == [0, 0, 0]
    best = found[0]
    assert best.drivers[0].weight == pytest.approx(0.5 / ASSETS, abs=1e-6)
    assert sentence(best) == (
        f"{best.asset} +25.00%: momentum:20 +8.33%; on a typical day it would be +16.67%."
    )
    many = Reason("A", 0.1, [Driver(name, 0.02) for name in "abcde"], 0.0)
    assert "a +2.00%, b +2.00%, c +2.00%, other signals +4.00%;" in sentence(many)
    none = Reason("A", 0.1, [Driver("a", 1e-6)], 0.1)
    assert (
        sentence(none) == "A +10.00%: no signal moves it, so that it is the same on a typical day."
    )


def test_limits_are_a_reason_where_what_is_held_or_wanted_breaks_them():
    """60% of A and 40% of cash are held; the best asset is wanted at 25%. All have a cap of 20%."""
    prices = planted()
    stretch = four_folds(prices, mandate={"assets": {"cap": 0.2}})[-1]
    policy = Policy(stretch.task, Known("momentum"), jnp.array([0.4, 0.6]), prices.assets)
    shares = np.eye(ASSETS)[0] * 600 / prices.values[-1]
    allocation = Allocation.of(policy, prices, shares, 400.0)
    largest, *others = reasons(policy, prices, allocation)
    assert largest.asset == "A"
    assert largest.required == pytest.approx(-0.4, abs=1e-6)
    assert sentence(largest).startswith(
        f"A {figure(largest.change, '+.2%')}: the limits on weights require \N{MINUS SIGN}40.00%;"
    )
    capped = next(each for each in others if each.bounds)
    assert (capped.required, capped.bounds) == (pytest.approx(0, abs=1e-6), ("its cap of 20.00%",))
    assert capped.change == pytest.approx(0.2, abs=1e-6)
    assert sentence(capped).endswith(". The target is at its cap of 20.00%.")


def test_an_order_that_exceeds_the_limit_of_turnover_is_not_said_to_be_at_it():
    """60% of A must become 20%, which is more turnover than there may be, or just as much."""
    prices = planted()
    shares = np.eye(ASSETS)[0] * 600 / prices.values[-1]
    for turnover, last in {
        0.1: " The order is beyond the limit of turnover, which yields to the other limits.",
        0.4: " The target is at its cap of 20.00% and the limit of turnover.",
    }.items():
        limits = {"assets": {"cap": 0.2}, "trading": {"turnover": turnover}}
        stretch = four_folds(prices, mandate=limits)[-1]
        policy = Policy(stretch.task, Known("momentum"), jnp.array([0.4, 0.6]), prices.assets)
        allocation = Allocation.of(policy, prices, shares, 400.0)
        largest = reasons(policy, prices, allocation)[0]
        assert largest.asset == "A"
        assert largest.change == pytest.approx(-0.4, abs=1e-4)
        assert sentence(largest).endswith(last)


def test_reasons_are_those_of_the_whole_order(plan):
    """Also where it is filled over five rows."""
    prices = planted()
    stretch = four_folds(prices, mandate={"trading": {"fill": 5}})[-1]
    policy = Policy(stretch.task, Known("momentum"), jnp.array([0.4, 0.6]), prices.assets)
    allocation = Allocation.of(policy, prices, np.zeros(ASSETS), 1000.0)
    found = reasons(policy, prices, allocation)
    for one, other in zip(found, plan[1], strict=True):
        assert (one.asset, one.change) == (other.asset, pytest.approx(other.change, abs=1e-5))
        assert one.drivers[0].weight == pytest.approx(other.drivers[0].weight, abs=1e-5)


def test_reasons_know_the_turnover_that_is_left_of_a_year():
    prices = planted()
    stretch = four_folds(prices, mandate={"trading": {"turnover_a_year": 0.5}})[-1]
    policy = Policy(stretch.task, Known("momentum"), jnp.array([0.4, 0.6]), prices.assets)
    allocation = Allocation.of(policy, prices, np.zeros(ASSETS), 1000.0, spent=0.3)
    assert allocation.turnover == pytest.approx(0.2, abs=1e-3)
    largest = reasons(policy, prices, allocation, 0.3)[0]
    assert largest.bounds == ("the limit of turnover",)
    assert abs(largest.rest) < 0.2  # and not a sixth of all that there is to be bought in a year
    assert sum(each.weight for each in largest.drivers) + largest.rest == pytest.approx(
        largest.change
    )


def test_the_limits_that_a_target_reaches_are_named():
    mandate = {
        "assets": {"cap": 0.4, "floor": {"B": 0.1}},
        "groups": {"theme": {"metals": {"assets": ["C", "D"], "cap": 0.3}}},
        "cash": {"max": 0.2},
    }
    allowed = feasible(mandate_text(mandate, "ABCD"), np.ones(4, bool))
    weights = np.array([0.2, 0.4, 0.1, 0.2, 0.1])
    metals = ("the cap of theme metals",)
    assert _bounds(allowed, weights, weights) == [
        ("its cap of 40.00%",), ("its floor of 10.00%",), metals, metals,
    ]  # fmt: skip
    weights = np.array([0.1, 0.3, 0.35, 0.15, 0.1])
    assert _bounds(allowed, weights, weights) == [()] * 4
    trading = feasible(mandate_text({"trading": {"turnover": 0.3}}, "ABCD"), np.ones(4, bool))
    held = np.array([0.4, 0.3, 0.2, 0.05, 0.05])
    assert _bounds(trading, weights, held) == [("the limit of turnover",)] * 4
    simplex = CappedSimplex(jnp.array([0.35, 1.0, 0.15, 0.0]))
    without = np.array([0.45, 0.3, 0.1, 0.15, 0.0])
    out = ("zero because it may not be held",)
    assert _bounds(simplex, without, held) == [(), (), ("its cap of 15.00%",), out]
