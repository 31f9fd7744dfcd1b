"""The tear sheet of the page."""

from dataclasses import replace

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.statistics.tearsheet import contributions
from qfolio.report.backtest.page import render_backtest
from qfolio.report.backtest.tearsheet import BINS, LISTED, tear_sheet
from qfolio.report.rendering import number, percent

from backtests import Page, make_data, make_series, usual
from tables import weekdays


def test_figures_are_means_over_seeds() -> None:
    data = usual(300)
    sheet = tear_sheet(["DQN", "equal weight"], data)
    rows = {name: cells for _, group in sheet["groups"] for name, cells in group}
    returns = data.strategies["DQN"].returns
    assert rows["Best day"][0] == percent(float(returns.max(axis=1).mean()), sign=True)
    assert rows["Growth a year (CAGR)"][0] == percent(
        data.assessment.strategies["DQN"].measures["growth"].mean
    )
    assert rows["Value at risk, 95%, daily"][1] == percent(
        -float(np.quantile(data.strategies["equal weight"].returns, 0.05)), 2
    )
    assert rows["Sharpe ratio"][0] == number(
        data.assessment.strategies["DQN"].measures["sharpe"].mean, 2
    )
    assert rows["Alpha a year, beside equal weight before costs"][1][0] == "−"  # its costs
    assert rows["Gross leverage"][0] == number(
        float((1 - data.strategies["DQN"].weights[:, 0]).mean()), 2
    )
    assert len(rows) == 34  # without net exposure, as nothing is sold short


@pytest.mark.parametrize(("months", "counted"), [(1, 29), (3, 29), (12, 27)])
def test_long_rows_have_no_figures_of_shorter_times(months: int, counted: int) -> None:
    """A monthly value at risk of quarterly rows would be the quarterly one."""
    data = usual(60)
    dates = (np.datetime64("2001-01") + months * np.arange(60)).astype("datetime64[s]")
    test = replace(data.assessment, periods_per_year=12 / months)
    data = replace(data, dates=dates, assessment=test)
    rows = [name for _, group in tear_sheet(["DQN"], data)["groups"] for name, _ in group]
    assert len(set(rows)) == len(rows) == counted
    assert any("month" in row for row in rows) == (months == 1)
    assert ("Best year" in rows) == (months < 12)


def test_a_record_begins_with_the_first_trade() -> None:
    returns = np.array([[-0.1, 0.05, 0.2]])
    dates = np.array(["2002-01-31", "2002-02-28", "2002-03-31"], "datetime64[s]")
    data = replace(usual(3), dates=dates, begin=np.datetime64("2001-12-31", "s"))
    one = replace(data.strategies["third"], returns=returns)
    data = replace(data, strategies={**data.strategies, "third": one})
    (fall, *_) = tear_sheet(["third"], data)["each"][0]["drawdowns"]
    assert fall[:3] == ["2001-12-31", "2002-01-31", "2002-03-31"]


def test_value_at_risk_is_the_same_everywhere() -> None:
    data = usual(300)
    series = data.strategies["DQN"]
    wild = replace(series, returns=series.returns * np.array([[1.0], [2.0], [5.0]]))
    sheet = tear_sheet(["DQN"], replace(data, strategies={**data.strategies, "DQN": wild}))
    rows = {name: cells for _, group in sheet["groups"] for name, cells in group}
    label = sheet["each"][0]["histogram"]["label"]
    assert rows["Value at risk, 95%, daily"][0] in label
    assert rows["CVaR, 95%, daily"][0] in label


def test_interest_on_cash_is_no_alpha() -> None:
    data, rate = usual(300), np.full(300, 0.05 / 252)
    market = data.strategies["equal weight"]
    gross = (1 + market.returns) / (1 - market.cost) - 1
    half = replace(market, returns=(gross + rate) / 2)
    data = replace(data, strategies={**data.strategies, "third": half}, risk_free=rate)
    sheet = tear_sheet(["third"], data)
    rows = {name: cells for _, group in sheet["groups"] for name, cells in group}
    assert rows["Alpha a year, beside equal weight before costs"] == ["0.00%"]


def test_the_costs_of_the_reference_are_no_alpha() -> None:
    data = usual(300)
    market = data.strategies["equal weight"]
    cost = np.full_like(market.cost, 0.001)
    idle = replace(market, returns=(1 + market.returns) / (1 - cost) - 1, cost=0 * cost)
    data = replace(data, strategies={"equal weight": replace(market, cost=cost), "DQN": idle})
    sheet = tear_sheet(["DQN", "equal weight"], data)
    rows = {name: cells for _, group in sheet["groups"] for name, cells in group}
    skilled, paying = rows["Alpha a year, beside equal weight before costs"]
    assert skilled == "0.00%"
    assert paying.startswith("−2")  # 0.1% a day is 25% a year


def test_net_exposure_of_short_positions() -> None:
    data = usual(300)
    series = data.strategies["DQN"]
    short = series.weights.copy()
    short[:, :3] = [1.0, 0.6, -0.6]
    short[:, 3:] = 0
    data = replace(data, strategies={**data.strategies, "DQN": replace(series, weights=short)})
    sheet = tear_sheet(["DQN", "equal weight"], data)
    rows = {name: cells for _, group in sheet["groups"] for name, cells in group}
    assert (rows["Gross leverage"][0], rows["Net exposure"][0]) == ("1.20", "0.00")
    assert rows["Net exposure"][1] == rows["Gross leverage"][1]


def test_drawdowns_have_dates() -> None:
    days = np.array(["2020-01-01", "2020-01-02", "2020-01-03", "2020-01-06"], "datetime64[s]")
    series = make_series(np.random.default_rng(0), "baseline", 1, 4, 1, 0.0)
    series = replace(series, returns=np.array([[-0.1, 0.2, -0.5, 0.1]]))
    data = make_data({"equal weight": series}, days, ("A",))
    (only,) = tear_sheet(["equal weight"], data)["each"]
    assert only["drawdowns"] == [
        ["2020-01-02", "2020-01-03", "not yet", "50.0%", "2 days"],
        ["2019-12-31", "2020-01-01", "2020-01-02", "10.0%", "2 days"],
    ]


def test_histogram_counts_every_return() -> None:
    data = usual(300)
    histogram = tear_sheet(["DQN"], data)["each"][0]["histogram"]
    heights = np.array([height for _, height in histogram["bars"]])
    assert len(heights) == BINS
    assert heights.max() <= 100
    shares = heights * float(histogram["highest"].split("%")[0]) / heights.max()
    assert 80 < shares.sum() < 120  # the highest is rounded


def test_contributions_add_up_on_the_page() -> None:
    rng = np.random.default_rng(0)
    names = tuple(f"asset {i}" for i in range(40))
    series = make_series(rng, "baseline", 1, 100, 40, 0.001)
    moves = 0.01 * rng.normal(size=(100, 40))
    data = make_data({"equal weight": series}, weekdays(100), names, moves=moves)
    rows = tear_sheet(["equal weight"], data)["each"][0]["assets"]
    assert len(rows) == LISTED + 3
    assert [row["name"] for row in rows[-3:]] == [
        "28 others", "Costs and interest", "Mean return a year",
    ]  # fmt: skip
    parts, rest = contributions(series.returns, series.weights, moves, 252)
    assert rows[0]["value"] == percent(parts.max(), sign=True)
    assert rows[-2]["value"] == percent(rest, sign=True)
    assert rows[-1]["value"] == percent(252 * series.returns.mean())
    with pytest.raises(QfolioError, match="assets' returns do not fit 100 dates"):
        render_backtest(replace(data, moves=moves[1:]))


def test_a_thousand_assets_keep_the_page_small() -> None:
    rng = np.random.default_rng(0)
    names = tuple(f"a rather long name of asset {i}" for i in range(1000))
    series = {
        name: make_series(rng, kind, 2 if kind == "agent" else 1, 600, 1000, 0.0003)
        for name, kind in {
            "equal weight": "baseline", "agent": "agent", "agent-together": "ensemble",
            **{f"baseline {i}": "baseline" for i in range(12)},
        }.items()
    }  # fmt: skip
    moves = 0.01 * rng.normal(size=(600, 1000))
    page = render_backtest(make_data(series, weekdays(600), names, moves=moves))
    assert len(page.encode()) < 7e6
    assert "988 others" in Page(page).text


def test_few_returns_have_no_value_at_risk() -> None:
    each = tear_sheet(["DQN"], usual(15))["each"][0]["histogram"]
    assert each["marks"] == []
    assert each["label"] == "15 returns, too few for a value at risk"
    assert 'x1="nan' not in render_backtest(usual(15))
