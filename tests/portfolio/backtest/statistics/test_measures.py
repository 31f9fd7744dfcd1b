"""Measures of track records, against hand calculations and at their edges."""

import math

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.statistics.bootstrap import bootstrap_measures
from qfolio.portfolio.backtest.statistics.measures import (
    MEASURES,
    drawdown,
    growth_at,
    measures,
    monthly,
)


def test_growth_at_other_costs_by_hand() -> None:
    """A day that gained 10% before a cost of 1%, and one that gained nothing and cost nothing."""
    returns, cost = np.array([[1.1 * 0.99 - 1, 0.0]]), np.array([[0.01, 0.0]])
    found = [growth_at(multiple, returns, cost, 2) for multiple in (0, 1, 2, 200)]
    assert found == pytest.approx([0.1, 1.1 * 0.99 - 1, 1.1 * 0.98 - 1, -1])
    assert growth_at(0, np.array([[-1.0, 0.5]]), cost, 2) == -1  # ruin stays ruin


def test_measures_by_hand() -> None:
    # Wealth 1.1, 0.88, 1.144, 1.0296 in half-year periods, so two years in all.
    table = measures([0.1, -0.2, 0.3, -0.1], [1.0, 0.0, 0.5, 0.1], [0.01, 0, 0.005, 0], 2)
    mean = 0.1 / 4
    spread = math.sqrt((0.075**2 + 0.225**2 + 0.275**2 + 0.125**2) / 3)
    growth = math.sqrt(1.0296) - 1
    expected = {
        "growth": growth,
        "volatility": spread * math.sqrt(2),
        "sharpe": mean / spread * math.sqrt(2),
        "sortino": mean / math.sqrt((0.04 + 0.01) / 4) * math.sqrt(2),
        "drawdown": 0.2,
        "calmar": growth / 0.2,
        "turnover": 0.8,
        "cost_drag": math.sqrt(1.0296 / (0.99 * 0.995)) - math.sqrt(1.0296),
    }
    assert set(table) == set(MEASURES)
    for name, value in expected.items():
        np.testing.assert_allclose(table[name], value, rtol=1e-12, err_msg=name)


def test_measures_keep_the_leading_shape() -> None:
    rng = np.random.default_rng(0)
    returns, turnover, cost = rng.random((3, 2, 4, 9)) / 10
    table = measures(returns, turnover, cost, 252)
    one = measures(returns[1, 2], turnover[1, 2], cost[1, 2], 252)
    for name in MEASURES:
        assert table[name].shape == (2, 4)
        np.testing.assert_allclose(table[name][1, 2], one[name], rtol=1e-12)


def test_drawdown_counts_from_the_start() -> None:
    # Wealth 0.5, 0.75, 1.5, 0.3, 0.
    series = drawdown([-0.5, 0.5, 1.0, -0.8, -1.0])
    np.testing.assert_allclose(series, [0.5, 0.25, 0, 0.8, 1], atol=1e-15)


def test_cash_is_all_zeros() -> None:
    table = measures(np.zeros(5), np.zeros(5), np.zeros(5), 252)
    assert {name: float(value) for name, value in table.items()} == dict.fromkeys(MEASURES, 0)


@pytest.mark.parametrize("rate", [0.01, 0.1, 1 / 3])
def test_equal_gains_have_no_volatility(rate: float) -> None:
    table = measures(np.full(7, rate), np.zeros(7), np.zeros(7), 1)
    assert table["volatility"] == table["drawdown"] == 0
    assert table["sharpe"] == table["sortino"] == table["calmar"] == math.inf
    assert table["growth"] == pytest.approx(rate)
    loss = measures(np.full(7, -rate), np.zeros(7), np.zeros(7), 1)
    assert loss["sharpe"] == -math.inf
    assert loss["sortino"] == pytest.approx(-1)


def test_total_loss() -> None:
    table = measures([0.1, -1.0, 0.1], np.zeros(3), np.full(3, 0.01), 252)
    assert table["growth"] == -1
    assert table["drawdown"] == 1
    assert table["calmar"] == -1
    assert table["cost_drag"] == 0  # nothing was left to lose


def test_a_single_period() -> None:
    table = measures([[0.02]], [[0.5]], [[0.01]], 12)
    assert math.isnan(table["volatility"].item())
    assert math.isnan(table["sharpe"].item())
    np.testing.assert_allclose(table["growth"], 1.02**12 - 1)
    np.testing.assert_allclose(table["cost_drag"], (1.02 / 0.99) ** 12 - 1.02**12)
    assert measures([1e6], [0], [0], 252)["growth"] == math.inf


def test_doubled_cost_doubles_the_logarithm_of_the_drag() -> None:
    # The same gross path +10% a year, a trade of 1% or 1.99% = 1 − 0.99² of wealth each year.
    once = measures(np.full(3, 1.1 * 0.99 - 1), np.ones(3), np.full(3, 0.01), 1)
    twice = measures(np.full(3, 1.1 * 0.99**2 - 1), np.ones(3), np.full(3, 0.0199), 1)
    assert once["cost_drag"] == pytest.approx(1.1 * 0.01)
    assert twice["cost_drag"] == pytest.approx(1.1 * 0.0199)


@pytest.mark.parametrize(
    ("returns", "turnover", "cost", "message"),
    [
        ([0.1, math.nan], [0, 0], [0, 0], "returns of the track record hold missing"),
        ([0.1, math.inf], [0, 0], [0, 0], "missing or infinite"),
        ([0.1, -1.01], [0, 0], [0, 0], "at least −1"),
        ([0.1, 0], [0, -0.1], [0, 0], "turnover of"),
        ([0.1, 0], [0, 0], [0, 1], "below 1"),
        ([0.1, 0], [0, 0], [0, -0.1], "cost of"),
        ([0.1, 0], [0], [0, 0], "same shape"),
        ([], [], [], "at least one period"),
        (0.1, 0, 0, "at least one period"),
        (["a"], [0], [0], "table of numbers"),
    ],
)
def test_measures_refuse(returns: object, turnover: object, cost: object, message: str) -> None:
    with pytest.raises(QfolioError, match=message):
        measures(returns, turnover, cost, 252)  # type: ignore[arg-type]


def test_monthly_by_hand() -> None:
    dates = ["1969-11-30", "1969-12-01", "1969-12-31", "1971-01-04", "1971-02-01", "1971-02-02"]
    years, table = monthly([[0.1, 0.2, -0.5, 0.3, 0.1, -1.0]], dates)
    assert years == [1969, 1970, 1971]
    expected = np.full((1, 3, 12), np.nan)
    expected[0, 0, 10:] = [0.1, 1.2 * 0.5 - 1]
    expected[0, 2, :2] = [0.3, -1]
    np.testing.assert_allclose(table, expected)


@pytest.mark.parametrize(
    "dates", [["2001-01-02", "2001-01-01"], ["2001-01-01"] * 2, ["2001-01-01"], ["x", "y"]]
)
def test_monthly_refuses_dates(dates: list[str]) -> None:
    with pytest.raises(QfolioError, match="date"):
        monthly([0.1, 0.2], dates)


def test_ratios_leave_out_what_cash_earns() -> None:
    # Over cash: 3% and −1%, of mean 1% and standard deviation √8%; the downside is √(1/2) %.
    table = measures([0.04, 0.01], [0, 0], [0, 0], 4, risk_free=[0.01, 0.02])
    assert table["sharpe"] == pytest.approx(2 / math.sqrt(8))
    assert table["sortino"] == pytest.approx(2 * math.sqrt(2))
    assert table["volatility"] == pytest.approx(2 * math.sqrt(0.00045))
    free = [0.001, 0.002, 0.0015]
    cash = measures(free, [0, 0, 0], [0, 0, 0], 4, risk_free=free)
    assert cash["sharpe"] == cash["sortino"] == 0
    same = measures([0.04, 0.01], [0, 0], [0, 0], 4)
    assert measures([0.04, 0.01], [0, 0], [0, 0], 4, risk_free=[0, 0]) == same


def test_each_return_needs_its_risk_free_return() -> None:
    with pytest.raises(QfolioError, match="each return needs one"):
        measures([0.04, 0.01], [0, 0], [0, 0], 4, risk_free=[0.01])


def test_resampled_ratios_leave_out_what_cash_earns() -> None:
    rng = np.random.default_rng(0)
    returns, none = 0.01 * rng.normal(size=(2, 300)), np.zeros((2, 300))
    free = 1e-4 * rng.random(300)
    one, other = (
        bootstrap_measures(each, none, none, 252, 5, 50, np.random.default_rng(1), of_cash)
        for each, of_cash in ((returns, free), (returns - free, None))
    )
    np.testing.assert_allclose(one["sharpe"], other["sharpe"], rtol=1e-10)
    np.testing.assert_allclose(one["sortino"], other["sortino"], rtol=1e-10)
