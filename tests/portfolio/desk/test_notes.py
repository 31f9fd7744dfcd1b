"""What is said of an allocation's orders."""

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.costs import Proportional
from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.notes import dear, lookback, other_capital, waiting
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
