"""The trades that lead from holdings to target weights."""

from types import SimpleNamespace

import numpy as np
import pytest

from qfolio.allocation import Allocation, require_fresh
from qfolio.errors import QfolioError
from qfolio.markets.prices import Prices

PRICES = Prices(
    np.array(["2024-12-30", "2024-12-31"], "datetime64[s]"), ("A", "B"), [[10, 50], [20, 40]]
)


def plan(weights, shares, cash, cost=0.01, **options):
    names = ("cash", "A", "B")
    policy = SimpleNamespace(
        weights=lambda prices, held: dict(zip(names, weights, strict=True)),
        task=SimpleNamespace(cost=cost),
    )
    return Allocation.of(policy, PRICES, np.array(shares, float), cash, **options)


def test_from_cash_by_hand():
    """100 spent at 1 % buys 99; half of it each."""
    allocation = plan([0, 0.5, 0.5], [0, 0], 100)
    np.testing.assert_allclose(allocation.trades, [49.5 / 20, 49.5 / 40])
    assert allocation.cost == pytest.approx(1)
    assert allocation.cash_after == pytest.approx(0, abs=1e-9)


def test_from_one_asset_to_the_other_by_hand():
    """Selling 100 yields 99, which buys 98.01."""
    allocation = plan([0, 0, 1], [5, 0], 0)
    np.testing.assert_allclose(allocation.trades, [-5, 98.01 / 40])
    assert allocation.cost == pytest.approx(1.99)
    np.testing.assert_allclose(allocation.held, [0, 1, 0])


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("whole", [False, True])
def test_money_is_neither_made_nor_lost(seed, whole):
    rng = np.random.default_rng(seed)
    weights, shares, cash = rng.dirichlet(np.ones(3)), rng.integers(0, 50, 2), rng.uniform(1, 1e3)
    allocation = plan(weights, shares, cash, whole_shares=whole)
    after = shares + allocation.trades
    assert (after >= -1e-9).all()
    kept = after @ allocation.prices + allocation.cash_after + allocation.cost
    assert kept == pytest.approx(allocation.wealth)
    assert allocation.cash_after >= 0
    if whole:
        np.testing.assert_array_equal(allocation.trades, np.round(allocation.trades))
    else:  # weights are of what is left after costs
        left = allocation.wealth - allocation.cost
        np.testing.assert_allclose(after * allocation.prices / left, weights[1:], atol=1e-9)


def test_what_is_wanted_and_held_is_not_traded():
    allocation = plan([0.5, 0.25, 0.25], [25, 12.5], 1000)
    np.testing.assert_allclose(allocation.trades, 0, atol=1e-12)
    assert allocation.cost == pytest.approx(0, abs=1e-9)


def test_nothing_to_allocate():
    with pytest.raises(QfolioError, match="nothing to allocate"):
        plan([1, 0, 0], [0, 0], 0)


def test_prices_of_another_day():
    require_fresh(PRICES, "2024-12-31")
    require_fresh(PRICES, "2025-01-07")
    for day, message in (("2025-01-08", "stale"), ("2024-12-30", "after"), ("x", "must be a date")):
        with pytest.raises(QfolioError, match=message):
            require_fresh(PRICES, day)
