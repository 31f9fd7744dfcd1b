"""The numbers behind the charts of a backtest's report."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qfolio.report.backtest.charts import POINTS
from qfolio.report.backtest.data import BacktestData, shown_order
from qfolio.report.backtest.holdings import BLOCKS, NAMED
from qfolio.report.backtest.page import render_backtest, write_backtest_report
from qfolio.report.backtest.wealth import draw_wealth
from qfolio.report.figures.style import LEAD

from backtests import Page, make_data, make_series, usual
from tables import weekdays


def test_numbers_of_the_charts(data: BacktestData, page: Page) -> None:
    chart = page.data
    assert len(chart["dates"]) == 301  # the start and every day
    assert chart["dates"][:2] == ["2001-01-01", "2001-01-02"]
    dqn, _, pathwise, equal, *_ = chart["strategies"]
    series = data.strategies["DQN"]
    wealth = np.prod(1 + series.returns, axis=1)
    assert dqn["wealth"][0] == 1
    assert dqn["wealth"][-1] == pytest.approx(np.median(wealth), rel=1e-3)
    assert dqn["band"]["low"][-1] == pytest.approx(wealth.min(), rel=1e-3)
    assert dqn["band"]["high"][-1] == pytest.approx(wealth.max(), rel=1e-3)
    assert dqn["cost"][-1] == pytest.approx(1 - np.prod(1 - series.cost, axis=1).mean(), rel=0.01)
    january = data.trades.astype("datetime64[M]") == np.datetime64("2001-01")
    traded = series.turnover[:, january].sum(axis=1) - series.turnover[:, 0]
    assert dqn["turnover"][0] == pytest.approx(traded.mean(), rel=1e-3)
    assert min(equal["drawdown"]) < 0 == max(equal["drawdown"])
    assert equal["band"] is None
    # Told apart without colors, too.
    looks = [(s["symbol"], s["dash"]) for s in chart["strategies"]]
    assert len(set(looks)) == len(looks)
    assert dqn["width"] == pathwise["width"] > max(s["width"] for s in chart["strategies"][3:])


def test_the_first_purchase_does_not_flatten_the_turnover() -> None:
    """Each seed buys on another day; a month that has only this day is left open."""
    data = usual(60)
    january = data.trades.astype("datetime64[M]") == data.trades[0].astype("datetime64[M]")
    traded = np.full_like(data.strategies["DQN"].turnover, 0.001)
    for seed, first in enumerate((0, 1, 3)):
        traded[seed, :first], traded[seed, first] = 0, 1
    dqn = replace(data.strategies["DQN"], turnover=traded)
    shown = replace(data, strategies={**data.strategies, "DQN": dqn})
    turnover = Page(render_backtest(shown)).data["strategies"][0]["turnover"]
    traded_days = january.sum() - np.array([1, 2, 4])
    assert turnover[0] == pytest.approx(0.001 * traded_days.mean(), rel=1e-3)
    assert max(turnover) < 0.03
    late = replace(data, begin=data.dates[0] - np.timedelta64(60, "D"))
    turnover = Page(render_backtest(late)).data["strategies"][3]["turnover"]
    assert [each is None for each in turnover[:2]] == [True, False]


def test_a_long_name_leaves_the_picture_its_room() -> None:
    data = usual(60)
    long = "A strategy of our own with a long name, which was revised in the autumn by the desk"
    series = {long if name == "DQN" else name: each for name, each in data.strategies.items()}
    figure = draw_wealth(make_data(series, data.dates, data.assets), LEAD)
    figure.draw_without_rendering()
    assert figure.axes[0].get_position().width > 0.6
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert long in [name.replace("\n", " ") for name in names]


def test_weights_are_grouped_and_add_up() -> None:
    rng = np.random.default_rng(0)
    series = {
        "agent": make_series(rng, "agent", 2, 40, 30, 0.0),
        "equal weight": make_series(rng, "baseline", 1, 40, 30, 0.0),
    }
    weights = np.zeros((40, 31))
    weights[:, 0] = 0.25
    weights[:, 7] = 0.75
    series["agent"] = replace(series["agent"], weights=weights)
    assets = tuple(f"asset {i}" for i in range(1, 31))
    shown = Page(render_backtest(make_data(series, weekdays(40), assets))).data
    for entry in shown["weights"]["series"]:
        assert len(entry["names"]) == NAMED + 2 == len(entry["values"])
        assert entry["names"][-1] == f"{30 - NAMED} others"
        np.testing.assert_allclose(np.sum(entry["values"], axis=0), 1, atol=0.01)
    agent = shown["weights"]["series"][0]
    assert agent["names"][:2] == ["Cash", "asset 7"]
    assert [row[0] for row in agent["values"][:2]] == [0.25, 0.75]


def test_troughs_survive_thinning() -> None:
    data = usual(2 * POINTS + 1)
    series = data.strategies["equal weight"]
    returns = np.zeros_like(series.returns)
    returns[0, 1000], returns[0, 1001] = -0.5, 1.0
    strategies = {**data.strategies, "equal weight": replace(series, returns=returns)}
    chart = Page(render_backtest(replace(data, strategies=strategies))).data
    assert len(chart["dates"]) <= POINTS + 1
    assert len(chart["weights"]["dates"]) <= BLOCKS
    assert chart["dates"][-1] == str(data.dates[-1])[:10]
    assert min(chart["strategies"][3]["drawdown"]) == -0.5


def test_page_of_a_long_backtest_stays_small(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    kinds = ["agent"] * 2 + ["baseline"] * 8
    series = {
        "equal weight" if i == 2 else f"strategy {i}": make_series(
            rng, kind, 5 if kind == "agent" else 1, 7000, 20, 0.0004
        )
        for i, kind in enumerate(kinds)
    }
    assets = tuple(f"asset {i}" for i in range(20))
    write_backtest_report(tmp_path, make_data(series, weekdays(7000, "1995-01-02"), assets))
    size = (tmp_path / "report.html").stat().st_size
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert size < 8e6
    assert len(page.scripts[0]) < 1e6


def test_only_what_matters_is_bright_at_first() -> None:
    """Agents, the reference and the best baseline; lists have the others."""
    rng = np.random.default_rng(2)
    kinds = {"agent": "agent", "equal weight": "baseline", "slow": "rebalancing"}
    kinds |= {f"other {i}": "baseline" for i in range(4)}
    series = {
        name: make_series(rng, kind, 1, 40, 2, 0.01 if name == "other 0" else 0.0)
        for name, kind in kinds.items()
    }
    data = make_data(series, weekdays(40), ("A", "B"))
    page = Page(render_backtest(data))
    names = shown_order(data)
    assert data.assessment.best_baseline == "other 0"
    bright = [name for place, name in enumerate(names) if place not in page.data["hidden"]]
    assert bright == ["agent", "equal weight", "other 0"]
    pressed = [
        attributes["aria-pressed"] for tag, attributes in page.tags if "aria-pressed" in attributes
    ]
    assert pressed[: len(names)] == [str(name in bright).lower() for name in names]
    looks = {name: page.data["strategies"][names.index(name)] for name in names}
    assert looks["equal weight"]["color"] == looks["other 0"]["color"] == "ink"
    assert looks["equal weight"]["dash"] != looks["other 0"]["dash"]
    assert looks["other 1"]["color"] == "faint"
    assert "3 other baselines" in page.text
    assert f"{len(names) - 3} more" in page.text


def test_holdings_are_weights_against_the_reference() -> None:
    rng = np.random.default_rng(0)
    series = {
        "agent": make_series(rng, "agent", 2, 40, 3, 0.0),
        "equal weight": make_series(rng, "baseline", 1, 40, 3, 0.0),
    }
    held = {"agent": [0.5, 0.0, 0.1, 0.4], "equal weight": [0.25, 0.25, 0.25, 0.25]}
    series = {
        name: replace(each, weights=np.tile(held[name], (40, 1))) for name, each in series.items()
    }
    data = make_data(series, weekdays(40), ("A", "B", "C"))
    shown = Page(render_backtest(data)).data["weights"]
    agent, reference = shown["series"]
    assert agent["names"] == ["Cash", "A", "B", "C"]
    assert [row[0] for row in agent["active"]] == [0.25, -0.25, -0.15, 0.15]
    assert [row[-1] for row in agent["values"]] == [0.5, 0, 0.1, 0.4]
    assert agent["effective"][0] == 1.47  # 0.5² / (0.1² + 0.4²)
    assert shown["effective"][0] == reference["effective"][0] == 3
    assert shown["reference"] == 1
    assert reference["active"] == reference["values"]


def test_rolling_figures_begin_after_a_year() -> None:
    data = usual(400)
    chart = Page(render_backtest(data)).data
    dqn, equal = chart["strategies"][0], chart["strategies"][3]
    assert dqn["sharpe"][:252] == [None] * 252
    assert len(dqn["sharpe"]) == len(chart["dates"]) == 401
    last = data.strategies["DQN"].returns[:, -252:]
    ratio = np.mean(np.sqrt(252) * last.mean(axis=1) / last.std(axis=1, ddof=1))
    assert dqn["sharpe"][-1] == pytest.approx(ratio, rel=1e-2)
    assert equal["beta"][-1] == 1
    free = np.full(400, 0.0002)
    over = Page(render_backtest(replace(data, risk_free=free))).data["strategies"][0]
    ratio = np.mean(np.sqrt(252) * (last.mean(axis=1) - 0.0002) / last.std(axis=1, ddof=1))
    assert over["sharpe"][-1] == pytest.approx(ratio, rel=1e-2)
    assert over["beta"] == dqn["beta"]
    assert "sharpe" not in Page(render_backtest(usual(300))).data["strategies"][0]
