"""What a backtest says besides its figures."""

import numpy as np
import pytest

from qfolio.portfolio.backtest import notes
from qfolio.portfolio.backtest.run import Backtest

from tables import price_table, random_walk
from tiny import PATHWISE

RATES = np.full((160, 2), 0.02)


@pytest.mark.parametrize(
    ("cost_model", "said"),
    [
        ("proportional", "No cost reads the columns 'rate', 'fee'; if rate is the rate that cash "
         'earns, add --cost-model "itemized(cash_rate=column:rate)".'),
        ("itemized(cash_rate=column:rate)", "No cost reads the column 'fee'; if it is the rate "
         'that cash earns, add --cost-model "itemized(cash_rate=column:fee)".'),
        ("itemized(cash_rate=column:rate, borrow_fee=column:fee)", None),
    ],
)  # fmt: skip
def test_columns_that_no_cost_reads(cost_model: str, said: str | None):
    prices = price_table(random_walk(160), market=RATES, market_names=("rate", "fee"))
    run = Backtest.create(
        prices, {"pathwise": PATHWISE}, train="80d", test="40d", baselines=[], cost_model=cost_model
    )
    assert notes.unread(run.replay) == [said] * (said is not None)


def test_a_table_without_such_columns():
    run = Backtest.create(
        price_table(random_walk(160)), {"pathwise": PATHWISE}, train="80d", test="40d", baselines=[]
    )
    assert notes.unread(run.replay) == []


@pytest.mark.parametrize(
    ("rate", "said"), [("0.05", None), ("-0.01", None), ("0.3", "30%"), ("column:rate", "30%")]
)
def test_a_rate_that_may_be_in_percent(rate: str, said: str | None):
    prices = price_table(random_walk(160), market=15 * RATES, market_names=("rate", "fee"))
    run = Backtest.create(
        prices, {"pathwise": PATHWISE}, train="80d", test="40d", baselines=[],
        cost_model=f"itemized(cash_rate={rate})",
    )  # fmt: skip
    assert [note[:17] for note in notes.generous(run.replay)] == [f"Cash earns {said} a "] * bool(
        said
    )


@pytest.mark.parametrize(("days", "said"), [(1, True), (30, False)])
def test_figures_a_year_of_a_short_test(days: int, said: bool):
    start = np.datetime64("2000-01-31")
    prices = price_table(random_walk(160), dates=start + days * np.arange(160))
    run = Backtest.create(prices, {"pathwise": PATHWISE}, train="80d", test="40d", baselines=[])
    found = notes.brief(run.replay)
    assert bool(found) is said
    if said:
        assert "where a year has about 365: figures a year are extrapolated" in found[0]
