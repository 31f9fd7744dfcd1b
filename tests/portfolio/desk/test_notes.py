"""What is said of an allocation's orders."""

import datetime

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.costs import Proportional
from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.ledger import Record
from qfolio.portfolio.desk.notes import (
    aged,
    dear,
    lookback,
    not_traded,
    other_capital,
    waiting,
)
from qfolio.portfolio.desk.untrained import Rule
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from fixed import Fixed
from planted import Known, planted

MONTHS = np.arange("2024-01", "2025-01", dtype="datetime64[M]").astype("datetime64[D]")
WEEKS = np.datetime64("2024-01-05") + 7 * np.arange(10)
DAYS = np.datetime64("2024-01-05") + np.arange(10)


@pytest.mark.parametrize(
    ("dates", "lag", "said"),
    [
        (MONTHS, 1, "1 row later, after about 31 days; if you trade at once"),
        (WEEKS, 2, "2 rows later, after about 14 days; if you trade at once"),
        (MONTHS, 0, ""), (DAYS, 1, ""), (DAYS[:1], 1, ""),
    ],
)  # fmt: skip
def test_orders_that_wait_for_weeks_are_named(dates, lag, said):
    found = " ".join(waiting(Prices(dates, ("A",), np.ones((len(dates), 1))), lag))
    assert said in found
    assert bool(found) == bool(said)


def test_prices_of_several_times_a_day_say_how_old_they_are():
    hours = np.datetime64("2024-01-05T09", "s") + np.arange(4) * np.timedelta64(1, "h")
    table, daily = (Prices(dates, ("A",), np.ones((len(dates), 1))) for dates in (hours, DAYS))
    assert not aged(table, datetime.timedelta(hours=2))
    (said,) = aged(table, datetime.timedelta(hours=3))
    assert said.startswith("The latest prices, of 2024-01-05 12:00:00, are 3 hours old if their ")
    assert said.endswith("times are in UTC; the orders are made at them.")
    assert not aged(daily, datetime.timedelta(days=7))


def account(shares, trades, number):
    """A record of holdings and orders in A and B."""
    weights = [1.0, 0.0, 0.0]
    return Record(
        number=number, made="", version="", agent="x", policy=None, digests={}, date="2024-01-02",
        whole_shares=False, assets=["A", "B"], prices=[1.0, 1.0], shares=shares, cash=9.0,
        trades=trades, cash_after=9.0, weights_before=weights, target=weights,
        weights_after=weights, costs={},
    )  # fmt: skip


def holding(shares, cash):
    """An allocation from these shares of A and B, and cash."""
    prices = Prices(DAYS[:1], ("A", "B"), np.ones((1, 2)))
    return Allocation.of(Fixed([1, 0, 0], Proportional(0.0)), prices, np.array(shares, float), cash)


@pytest.mark.parametrize(
    ("shares", "number"),
    [([0, 0], 1), ([5, 0], 2), ([5, 3], None), ([0, 8], 3), ([4, 4], None)],
)
def test_holdings_from_before_any_earlier_orders_are_noticed(shares, number):
    """Record 3 sees what record 2 sold in part only; record 4 orders nothing."""
    earlier = [
        account([0, 0], [5, 0], 1), account([5, 0], [0, 3], 2), account([0, 8], [5, -5], 3),
        account([5, 3], [0, 0], 4),
    ]  # fmt: skip
    said = " ".join(not_traded(holding(shares, 9.0), earlier))
    assert (f"those of record {number} before its trades" in said) == (number is not None)
    assert bool(said) == (number is not None)


def test_trades_too_small_to_tell_are_no_sign():
    """The holdings are those before such trades, and those after them."""
    assert not not_traded(holding([5, 0], 9.0), [account([5, 0], [5e-6, 0], 1)])


@pytest.mark.parametrize(("cash", "said"), [(9.0, True), (9.01, True), (4.0, False), (18.0, False)])
def test_other_cash_alone_is_another_account(cash, said):
    found = not_traded(holding([0, 0], cash), [account([0, 0], [5, 0], 1)])
    assert bool(found) == said


@pytest.mark.parametrize(
    ("name", "train", "expanding", "rows"),
    [
        ("equal-weight", "100d", True, 0), ("minimum-variance", "100d", True, 500),
        ("minimum-variance", "100d", False, 101), ("momentum", "100d", True, 361),
        ("momentum", "100d", False, 101),
    ],
)  # fmt: skip
def test_a_baseline_looks_back_on_its_window(name, train, expanding, rows):
    """A month of this table has 30 rows."""
    prices = planted(500)
    task, rule = Portfolio.of(prices, window=2), baseline(name)
    followed = Rule(name, rule, prices.assets, task, train=train, expanding=expanding, cap=1.0)
    what = name if rows else ""
    assert lookback(followed, prices.dates, prices.month) == (what, rows)


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"anchor": "equal-weight"}, ("", 0)),
        ({"anchor": "minimum-variance"}, ("the agent's anchor", 300)),
        (
            {"mandate": {"risk": {"volatility": 0.2, "rows": 100}}},
            ("the mandate's limit on risk", 101),
        ),
    ],
)
def test_an_agent_looks_back_with_its_anchor_and_its_limits(settings, found):
    prices = planted(300)
    task = Portfolio.of(prices, window=2, **settings)
    policy = Policy(task, Known("momentum"), jnp.array([0.5]), prices.assets)
    assert lookback(policy, prices.dates, prices.month) == found


@pytest.mark.parametrize(
    ("weight", "said"),
    [
        (0.0, ""), (0.6, ""),  # 10 of 600
        (0.1, "The expected cost is 10.1% of the value traded, 99.00: fees weigh less on larger"),
    ],
)  # fmt: skip
def test_an_order_that_fees_eat_is_named(weight, said):
    prices = Prices(DAYS[:2], ("A",), np.ones((2, 1)))
    policy = Fixed([1 - weight, weight], Itemized(0.0, fixed=10.0, capital=1000.0))
    found = " ".join(dear(Allocation.of(policy, prices, np.zeros(1), 1000.0)))
    assert said in found
    assert bool(found) == bool(said)


@pytest.mark.parametrize(
    ("wealth", "model", "said"),
    [
        (5000.0, Itemized(fixed=2.0, capital=5e4), True), (3e5, Itemized(impact=1.0), False),
        (1e5, Itemized(impact=1.0), True), (1e7, Itemized(minimum=1.0), True),
        (1e4, Itemized(fixed=2.0, capital=4e4), False), (100.0, Itemized(), False),
        (100.0, Proportional(), False),
    ],
)  # fmt: skip
def test_an_account_far_from_the_capital_on_which_costs_depend_is_named(wealth, model, said):
    found = " ".join(other_capital(wealth, model))
    assert bool(found) == said
    if said:
        assert f"is worth {wealth:,.2f}, but the backtest began with a capital of" in found
        assert f"run it with capital={wealth:.0f} in --cost-model" in found
