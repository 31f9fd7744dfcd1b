"""Calendars, and that nothing trades between their rows."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.presets import preset
from qfolio.portfolio.backtest.attribution.explain import explain
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.calendars import decision_rows
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

DAYS = np.array(
    ["2023-12-28", "2023-12-29", "2024-01-02", "2024-01-05", "2024-01-08", "2024-02-01",
     "2024-03-28", "2024-04-01", "2024-04-07", "2024-04-08"],
    "datetime64[s]",
)  # fmt: skip


def table(rows: int = 700) -> Prices:
    rng = np.random.default_rng(0)
    days = np.busday_offset("2019-01-01", np.arange(rows), roll="forward")
    values = 50 * np.exp(np.cumsum(0.01 * rng.normal(size=(rows, 4)), 0))
    return Prices(days.astype("datetime64[s]"), tuple("ABCD"), values)


@pytest.mark.parametrize(
    ("calendar", "rows"),
    [
        ("", range(10)),
        ("weekly", [0, 2, 4, 5, 6, 7, 9]),
        ("monthly", [0, 2, 5, 6, 7]),
        ("quarterly", [0, 2, 7]),
        ("yearly", [0, 2]),
        ("4", [0, 4, 8]),
    ],
)
def test_rows_of_decisions(calendar: str, rows: list[int]) -> None:
    assert np.flatnonzero(decision_rows(calendar, DAYS)).tolist() == list(rows)


def test_later_rows_decide_nothing() -> None:
    for calendar in ("weekly", "monthly", "quarterly", "yearly", "3"):
        whole = decision_rows(calendar, DAYS)
        for end in range(len(DAYS)):
            assert (decision_rows(calendar, DAYS[:end]) == whole[:end]).all()


@pytest.mark.parametrize("calendar", ["daily", "0", "-3", "2.5", "Monthly"])
def test_unknown_calendars(calendar: str) -> None:
    with pytest.raises(QfolioError, match="weekly, monthly, quarterly, yearly or a number of rows"):
        Portfolio.of(table(), calendar=calendar)


def test_between_decisions_the_target_is_what_is_held() -> None:
    prices = table()
    task = Portfolio.of(prices, window=5, horizon=10, calendar="monthly")
    decides = decision_rows("monthly", prices.dates)
    held, wanted = jnp.eye(5)[1], jnp.eye(5)[2]
    for row in range(200, 260):
        target = task.target(jnp.array(row), held, wanted)
        assert (target == (wanted if decides[row] else held)).all()
    last = jnp.array(len(prices) - 1)
    assert (task.target(last, held, wanted) == wanted).all()


def test_every_strategy_of_a_backtest_keeps_to_the_calendar() -> None:
    prices = table()
    agents = {
        "tilts": preset("fast", "portfolio", "tilts"),
        "dqn": preset("fast", "portfolio", "dqn"),
    }
    backtest = Backtest.create(
        prices,
        agents,
        train="1y",
        test="6m",
        seeds=2,
        episodes=2,
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
