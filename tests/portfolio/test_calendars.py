"""Calendars, and that nothing trades between their rows."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.presets import preset
from qfolio.portfolio.backtest.attribution.explain import explain
from qfolio.portfolio.backtest.baselines import History
from qfolio.portfolio.backtest.baselines.equal_weight import EqualWeight
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.orders import AT_EVERY_ROW, orders
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.calendars import decision_rows
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk, weekdays
from tiny import PATHWISE

DAYS = np.array(
    ["2023-12-28", "2023-12-29", "2024-01-02", "2024-01-05", "2024-01-08", "2024-02-01",
     "2024-03-28", "2024-04-01", "2024-04-07", "2024-04-08"],
    "datetime64[s]",
)  # fmt: skip


def table(rows: int = 700) -> Prices:
    return price_table(random_walk(rows, 4), dates=weekdays(rows, "2019-01-01"))


@pytest.mark.parametrize(
    ("calendar", "rows"),
    [
        ("", range(10)),
        ("daily", range(10)),
        ("weekly", [0, 2, 4, 5, 6, 7, 9]),
        ("monthly", [0, 2, 5, 6, 7]),
        ("quarterly", [0, 2, 7]),
        ("yearly", [0, 2]),
        ("4", [0, 4, 8]),
        ("drift:0.05", range(10)),
    ],
)
def test_rows_of_decisions(calendar: str, rows: list[int]) -> None:
    assert np.flatnonzero(decision_rows(calendar, DAYS)).tolist() == list(rows)


def test_a_day_of_several_rows_decides_once() -> None:
    hours = np.datetime64("2024-01-05T22", "s") + np.arange(6) * np.timedelta64(1, "h")
    assert np.flatnonzero(decision_rows("daily", hours)).tolist() == [0, 2]


def test_later_rows_decide_nothing() -> None:
    for calendar in ("daily", "weekly", "monthly", "quarterly", "yearly", "3"):
        whole = decision_rows(calendar, DAYS)
        for end in range(len(DAYS)):
            assert (decision_rows(calendar, DAYS[:end]) == whole[:end]).all()


@pytest.mark.parametrize(
    "calendar",
    ["hourly", "0", "-3", "2.5", "9" * 30, "Monthly", "drift:", "drift:0", "drift:1", "drift:nan"],
)
def test_unknown_calendars(calendar: str) -> None:
    with pytest.raises(QfolioError) as raised:
        Portfolio.of(table(), calendar=calendar)
    said = str(raised.value)
    assert "daily, weekly, monthly, quarterly, yearly, a number of rows, or drift:" in said
    assert "leave it out to trade at every row" in said


def test_between_decisions_the_target_is_what_is_held() -> None:
    prices = table()
    task = Portfolio.of(prices, window=5, horizon=10, calendar="monthly")
    decides = decision_rows("monthly", prices.dates)
    held, wanted = jnp.eye(5)[1], jnp.eye(5)[2]
    for row in range(200, 260):
        target = task.target(jnp.array(row), task.hold(held), wanted)
        assert (target == (wanted if decides[row] else held)).all()
    last = jnp.array(len(prices) - 1)
    assert (task.target(last, task.hold(held), wanted) == wanted).all()


def test_tomorrows_weights_may_be_asked_for_on_any_day() -> None:
    task = Portfolio.of(price_table(random_walk(50)), calendar="monthly", window=5, horizon=10)
    assert np.flatnonzero(task.decides).tolist() == [0, 31, 49]


def test_orders_wait_for_drift_beyond_the_band() -> None:
    task = Portfolio.of(table(), window=5, horizon=10, calendar="drift:0.05")
    rng, row = np.random.default_rng(1), jnp.array(200)
    traded = 0
    for _ in range(100):
        held, other = (jnp.asarray(rng.dirichlet(np.ones(5)), jnp.float32) for _ in range(2))
        wanted = held + 0.2 * (other - held)
        target = task.target(row, task.hold(held), wanted)
        beyond = bool(abs(wanted - held).max() > 0.05)
        assert (target == (wanted if beyond else held)).all()
        traded += beyond
    assert 20 < traded < 80


def test_equal_weights_wait_for_drift_as_in_a_ledger_of_shares() -> None:
    prices, test = table(400), range(100, 399)
    fold = Fold("only", slice(0, 100), slice(test.start, test.stop), slice(0, 100))
    rule, equal = type("Once", (EqualWeight,), {"calendar": "fold"})(), np.full(4, 0.25)
    for band in np.random.default_rng(2).uniform(0.005, 0.05, 20):
        terms = AT_EVERY_ROW._replace(band=band)
        found = orders("x", rule, [fold], prices.dates, prices.values, terms=terms).decisions
        shares = np.zeros(4)
        for row, order in zip(test, found, strict=True):
            worth = shares * prices.values[row]
            held = worth / max(worth.sum(), 1e-9)
            assert np.isnan(order[0]) == (row > test.start and abs(held - equal).max() <= band)
            shares = shares if np.isnan(order[0]) else order[1:] / prices.values[row]
        assert 1 < (~np.isnan(found[:, 0])).sum() < len(test) / 2


@pytest.mark.parametrize(
    ("every", "apart"), [(1, 21), (4, 20), (5, 20), (8, 24), (13, 26), (21, 21), (30, 30)]
)
def test_a_monthly_baseline_decides_on_rows_of_the_calendar_about_a_month_apart(every, apart):
    class Monthly(EqualWeight):
        calendar = "month"

        def decide(self, history: History, held: np.ndarray) -> np.ndarray:
            asked.append(len(history.prices) - 1)
            return super().decide(history, held)

    asked: list[int] = []
    prices, decides = table(400), np.zeros(400, bool)
    decides[100::every] = True
    fold = Fold("", slice(0, 100), slice(100, 390), slice(0, 100))
    terms = AT_EVERY_ROW._replace(decides=decides)
    orders("x", Monthly(), [fold], prices.dates, prices.values, terms=terms)
    assert asked[0] == 100
    assert set(np.diff(asked)) == {apart}


def test_a_fold_without_a_row_of_the_calendar_buys_nothing() -> None:
    class Asked(EqualWeight):
        def decide(self, history: History, held: np.ndarray) -> np.ndarray:
            seen.append(held)
            return super().decide(history, held)

    seen: list[np.ndarray] = []
    prices, decides = table(60), np.zeros(60, bool)
    decides[45] = True
    folds = [Fold("", slice(0, 21), slice(s, s + 10), slice(0, 21)) for s in (20, 30, 40)]
    terms = AT_EVERY_ROW._replace(decides=decides)
    found = orders("x", Asked(), folds, prices.dates, prices.values, terms=terms).decisions
    assert np.flatnonzero(~np.isnan(found[:, 0])).tolist() == [25]
    np.testing.assert_array_equal(seen, np.tile(np.eye(5)[0], (3, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("mandate", [None, {"assets": {"cap": 0.3}}])
def test_drift_is_that_of_an_independent_ledger(mandate: dict | None) -> None:
    prices, band = table(450), 0.02
    backtest = Backtest.create(
        prices,
        {"pathwise": PATHWISE},
        train="1y",
        test="6m",
        seeds=2,
        mandate=mandate,
        calendar=f"drift:{band}",
        cost_model="itemized(fixed=1)",
        baselines=("minimum-variance", "buy-and-hold"),
    )
    backtest.run()
    entries, _ = backtest.entries()
    first = backtest.folds[0].decisions.start
    for name, entry in entries.items():
        for decisions, turnover in zip(entry.decisions, entry.simulation.turnover, strict=True):
            shares, cash, orders = np.zeros(4), 1.0, 0
            for day, target in enumerate(decisions):
                now = prices.values[first + day]
                wealth = cash + shares @ now
                held = np.append(cash, shares * now) / wealth
                off = 1.0
                if name == "equal-weight":
                    off = abs(held - np.array([0, 0.25, 0.25, 0.25, 0.25])).max()
                    assert np.isnan(target[0]) == (off <= band)
                if np.isnan(target[0]):
                    assert turnover[day] == 0  # not even rounding errors, which would cost fees
                    continue
                assert abs(target - held).max() > band - 1e-5, (name, day)
                shares, cash = wealth * target[1:] / now, wealth * target[0]
                orders += 1
            assert 1 <= orders < len(decisions) / 2, name


@pytest.mark.slow
def test_every_strategy_of_a_backtest_keeps_to_the_calendar() -> None:
    prices = table()
    agents = {
        "pathwise": PATHWISE,
        "dqn": preset("fast", "portfolio", "dqn")._replace(episodes=64),
    }
    backtest = Backtest.create(
        prices,
        agents,
        train="1y",
        test="6m",
        seeds=2,
        calendar="quarterly",
        cost_model="itemized(cash_rate=0.05)",
        baselines=("minimum-variance", "momentum", "buy-and-hold"),
    )
    backtest.run()
    entries, _ = backtest.entries()
    first = backtest.folds[0].decisions.start
    allowed = decision_rows("quarterly", prices.dates)[first:]
    allowed[0] = True
    some = 0
    for entry in entries.values():
        trades = entry.simulation.turnover > 0
        assert not trades[:, ~allowed[: trades.shape[1]]].any()
        some += int(trades[:, 1:].any())
    assert some > 5  # most trade more than once

    # What follows from the orders leaves out the rows without one, and Sharpe ratios the interest.
    json.dumps(explain(backtest, entries).to_json(), allow_nan=False)
    interest = backtest.replay.growth[:, 0] - 1
    days = np.diff(prices.dates[-len(interest) - 1 :]) / np.timedelta64(1, "D")
    np.testing.assert_allclose(interest, np.expm1(0.05 * days / 365), rtol=1e-9)
    assessed = backtest.assess(entries)
    over_cash = entries["buy-and-hold"].simulation.returns - interest
    sharpe = over_cash.mean() / over_cash.std(ddof=1) * np.sqrt(assessed.periods_per_year)
    assert assessed.strategies["buy-and-hold"].measures["sharpe"].mean == pytest.approx(sharpe)
