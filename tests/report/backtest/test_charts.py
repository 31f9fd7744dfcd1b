"""The numbers behind the charts of a backtest's report."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qfolio.report.backtest.charts import AREAS, NAMED, POINTS
from qfolio.report.backtest.data import DISTINCT, BacktestData
from qfolio.report.backtest.page import render_backtest, write_backtest_report

from backtests import Page, make_data, make_series, usual, weekdays


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
    january = data.dates.astype("datetime64[M]") == np.datetime64("2001-01")
    traded = series.turnover[:, january].sum(axis=1).mean()
    assert dqn["turnover"][0] == pytest.approx(traded, rel=1e-3)
    assert min(equal["drawdown"]) < 0 == max(equal["drawdown"])
    assert equal["band"] is None
    # Told apart without colours, too.
    looks = [(s["symbol"], s["dash"]) for s in chart["strategies"]]
    assert len(set(looks)) == len(looks)
    assert dqn["width"] == pathwise["width"] > max(s["width"] for s in chart["strategies"][3:])


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
    shown = Page(render_backtest(make_data(series, weekdays("2020-01-01", 40), assets))).data
    for entry in shown["weights"]["series"]:
        assert len(entry["names"]) == NAMED + 2 == len(entry["values"])
        assert entry["names"][-1] == f"{30 - NAMED} others"
        np.testing.assert_allclose(np.sum(entry["values"], axis=0), 1, atol=0.01)
        assert sum(entry["average"]) == pytest.approx(1)
    agent = shown["weights"]["series"][0]
    assert agent["names"][:2] == ["Cash", "asset 7"]
    assert agent["average"][:2] == [0.25, 0.75]


def test_troughs_survive_thinning() -> None:
    data = usual(2 * POINTS + 1)
    series = data.strategies["equal weight"]
    returns = np.zeros_like(series.returns)
    returns[0, 1000], returns[0, 1001] = -0.5, 1.0
    strategies = {**data.strategies, "equal weight": replace(series, returns=returns)}
    chart = Page(render_backtest(replace(data, strategies=strategies))).data
    assert len(chart["dates"]) <= POINTS + 1
    assert len(chart["weights"]["dates"]) <= AREAS
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
    write_backtest_report(tmp_path, make_data(series, weekdays("1995-01-02", 7000), assets))
    size = (tmp_path / "report.html").stat().st_size
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert size < 8e6
    assert len(page.scripts[0]) < 1e6


def test_many_baselines_are_hidden_at_first() -> None:
    """But in the tables and in the lists they stand, one select away."""
    rng = np.random.default_rng(2)
    kinds = {"agent": "agent", "equal weight": "baseline", "slow": "rebalancing"}
    kinds |= {f"other {i}": "baseline" for i in range(DISTINCT + 2)}
    series = {
        name: make_series(rng, kind, 1, 40, 2, 0.01 if name == "other 0" else 0.0)
        for name, kind in kinds.items()
    }
    data = make_data(series, weekdays("2020-01-01", 40), ("A", "B"))
    page = Page(render_backtest(data))
    main = 2 + (data.assessment.rebalanced == "slow") + 1  # other 0 is the best baseline
    assert data.assessment.best_baseline == "other 0"
    assert page.data["hidden"] == list(range(main, main + DISTINCT + 1))
    assert len(page.data["strategies"]) == main + DISTINCT + 1
    pressed = [
        attributes["aria-pressed"] for tag, attributes in page.tags if "aria-pressed" in attributes
    ]
    assert pressed[: main + 1] == ["true"] * main + ["false"]
    assert "7 other baselines" in page.text
    assert "The other baselines are hidden at first" in page.text
    del series["other 1"]
    fewer = Page(render_backtest(make_data(series, data.dates, data.assets)))
    assert fewer.data["hidden"] == []
