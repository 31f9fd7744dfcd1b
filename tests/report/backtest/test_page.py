"""What the page of a backtest says, from made-up track records."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.capacity import Capacity
from qfolio.portfolio.backtest.statistics.differences import Contrast
from qfolio.portfolio.backtest.statistics.verdict import verdicts
from qfolio.report.backtest.data import BacktestData, StrategySeries, shown_order
from qfolio.report.backtest.facts import key_facts
from qfolio.report.backtest.page import render_backtest
from qfolio.report.rendering import number, percent

from backtests import Page, make_data, of_returns_alone, usual


def plain(text: str) -> str:
    return " ".join(text.split())


def test_leads_with_the_verdicts_and_says_no_more(data: BacktestData, page: Page) -> None:
    said = verdicts(data.assessment)
    assert list(said) == ["DQN", "DQN-together", "pathwise"]
    places = [page.text.index(plain(each)) for name in said for each in said[name]]
    assert places == sorted(places)
    assert places[-1] < page.text.index("Mind the data") < page.text.index("Cumulative wealth")
    # Each claim is made once, and only the one that the corrected p-value allows.
    assert page.text.count("after costs:") == sum(map(len, said.values()))
    assert "No evidence that DQN beats equal weight in growth, Sharpe ratio or" in page.text
    assert "pathwise beats best of all in growth and Sharpe ratio after costs" in page.text


def test_says_what_the_test_is(page: Page) -> None:
    for sentence in (
        "made up: 4 assets, 1,234 rows from 1999-01-04",
        "The test covers 300 days, from 2001-01-02 to",
        "These assets are survivors.",
        "25 bp of the value of every purchase and every sale",
        "is carried out at the close of the next day",
        "1, walk-forward: training on a rolling window of 2y, then a test of 6m",
        "12: 2 agents × 3 seeds, 1 ensemble, and 5 earlier trials on these prices.",
        "after Holm’s correction for 24 comparisons",
        "no order of an agent or a baseline gives an asset more than 30.0%",
        "Market impact",
        "Taxes.",
        "cash earns nothing",
        "intervals of volatility and drawdown are too narrow",
        "Log growth less equal weight",
        "Volatility relative to equal weight",
        "those in volatility are relative to the other’s volatility: −50% is half of it.",
        "qfolio backtest --seeds 3",
        "DQN.settings.discount",
        "400 resampled histories",
    ):
        assert sentence in page.text, sentence
    assert "Exceptions" not in page.text


def test_the_users_own_strategies_are_no_baselines(data: BacktestData, page: Page) -> None:
    assert "Agents are in color" in page.text
    assert "The best baseline, best of all, is the one" in page.text
    own = replace(data.strategies["best of all"], kind="strategy")
    strategies = {**data.strategies, "best of all": own}
    text = Page(render_backtest(make_data(strategies, data.dates, data.assets))).text
    assert "Agents and your own strategies are in color" in text
    assert "The best strategy, best of all, is the one that grew most of your own and" in text
    assert "less that of the best strategy, best of all, is" in text
    assert "Log growth less best of all (best strategy)" in text
    assert "best baseline" not in text


def test_bars_have_the_color_of_their_strategy(data: BacktestData, page: Page) -> None:
    table = render_backtest(data).split('aria-label="Table of statistics"')[1]
    colors = re.findall(r"--own: var\(--(.*?)\)", table.split("</table>")[0])
    assert colors[:3] == ["agent-1", "agent-2", "agent-3"]
    assert colors == [each["color"] for each in page.data["strategies"][: len(colors)]]


def test_exceptions_are_apart_where_a_list_is_printed_in_one_line(data: BacktestData) -> None:
    notes = ["One is here.", "Another is there."]
    page = render_backtest(replace(data, notes=notes))
    assert re.search(r"<li>One is here.</li>\s+<li>Another is there.</li>", page)


def test_bands_over_seeds_need_seeds(page: Page) -> None:
    said = "bands span the worst to the best seed"
    assert said in page.text
    assert said not in Page(render_backtest(usual(30, seeds=1))).text


def test_says_how_assets_enter_and_leave_the_table(data: BacktestData, page: Page) -> None:
    assert "A table of assets that still trade" in page.text
    known = {"late_assets": 2, "delisted_assets": 1, "haircut": 0.3, "has_members": True}
    text = Page(render_backtest(replace(data, prices={**data.prices, **known}))).text
    for said in (
        "2 joined late",
        "1 delisted, a haircut of 30%",
        "bought only while members",
        "2 assets joined after the first row. 1 asset ended before the last row, and holdings "
        "became cash at the last price, with a haircut of 30%. An asset may be bought only while "
        "its membership lasts.",
    ):
        assert said in text, said
    assert "A table of assets that still trade" not in text


def test_short_sales_are_not_called_impossible(data: BacktestData) -> None:
    def said(mandate: Any) -> bool:
        page = render_backtest(replace(data, config={**data.config, "mandate": mandate}))
        return "Short sales and borrowing: weights are never negative" in page

    assert said(None)
    assert said({"assets": {"floor": {"A": 0.1}}, "cash": {"min": 0.0}})
    assert not said({"assets": {"floor": -0.1}})
    assert not said({"cash": {"min": -1.0}})


@pytest.mark.parametrize(
    ("calendar", "said"),
    [
        ("drift:0.03", "every day, but trade only if a weight wanted, that of cash included, is "
         "more than 3% of the wealth from the weight held; otherwise, holdings drift."),
        ("3", "the first day of the test and, after it, once in 3 days, counted from the table’s "
         "first row; between, holdings drift."),
        ("quarterly", "the first day of the test and, after it, on the first day of each quarter; "
         "between, holdings drift."),
    ],
)  # fmt: skip
def test_says_when_strategies_decide(data: BacktestData, calendar: str, said: str) -> None:
    config = {**data.config, "calendar": calendar}
    text = Page(render_backtest(replace(data, config=config))).text
    assert f"Agents and baselines decide on {said}" in text


def test_a_calendar_of_every_row_needs_no_sentence(data: BacktestData) -> None:
    text = Page(render_backtest(replace(data, config={**data.config, "calendar": "daily"}))).text
    assert "decide on the first" not in text


def test_the_terms_are_those_of_the_figures(data: BacktestData) -> None:
    assert "Annualized mean return over volatility." in Page(render_backtest(data)).text
    rate = np.full(len(data.dates), 1e-4)
    text = Page(render_backtest(replace(data, risk_free=rate))).text
    assert "Annualized mean return less what cash earns, over volatility." in text
    assert "less what cash earns, over downside deviation, which counts shortfalls alone." in text


def test_calls_nothing_a_limit_that_the_backtest_may_replace(data: BacktestData) -> None:
    mandate = {
        "benchmark": "SPY",
        "costs": {"fixed": 2.0},
        "trading": {"calendar": "weekly", "turnover": 0.4},
        "risk": {"tracking_error": 0.05, "benchmark": "SPY"},
    }
    page = Page(render_backtest(replace(data, config={**data.config, "mandate": mandate})))
    limits = "trading.turnover = 0.4; risk.tracking_error = 0.05; risk.benchmark = SPY"
    assert f"Every order of an agent or a baseline obeys these limits: {limits}." in page.text


def test_table_has_every_figure_with_its_intervals(data: BacktestData) -> None:
    page = render_backtest(data)
    table = page.split('aria-label="Table of statistics"')[1].split("</table>")[0]
    rows = re.findall(r"<tr class=\"(\w+)[^>]*><th[^>]*>(.*?)</th>(.*?)</tr>", table)
    assert [(kind, name) for kind, name, _ in rows] == [
        ("agent", "DQN"),
        ("agent", "DQN-together"),
        ("agent", "pathwise"),
        ("baseline", "equal weight"),
        ("baseline", "never"),
        ("baseline", "best of all"),
    ]
    others = page.split("Table of statistics of the other baselines")[1].split("</table>")[0]
    assert re.findall(r"<th scope=\"row\">(.*?)</th>", others) == ["third"]
    before, speeds = page.split("Table of speeds of rebalancing")
    assert ">slow<" not in before  # nor in any other place
    assert re.findall(r"<th scope=\"row\">(.*?)</th>", speeds.split("</table>")[0]) == [
        "equal weight", "slow", "never (best)"
    ]  # fmt: skip
    sharpe = data.assessment.strategies["DQN"].measures["sharpe"]
    assert sharpe.over_seeds is None  # of three
    cell = rows[0][2].split("<td>")[3].replace("\N{MINUS SIGN}", "-")
    low, high = sharpe.over_time
    left, right = min(sharpe.per_seed), max(sharpe.per_seed)
    assert cell.startswith(f"{sharpe.mean:.2f}<span")  # a bar of the interval over time
    assert f"</span><small>{low:.2f} … {high:.2f}</small>" in cell
    assert f'<small class="seeds">{left:.2f} … {right:.2f}</small>' in cell
    assert "seeds" not in rows[3][2]
    assert "the range over seeds, which are too few for an interval" in Page(page).text
    assert all(row.count("<td>") == 8 for _, _, row in rows)


def test_five_seeds_have_intervals() -> None:
    data = usual(days=30, seeds=5)
    growth = data.assessment.strategies["DQN"].measures["growth"]
    assert growth.over_seeds is not None
    page = render_backtest(data)
    ends = " … ".join(percent(end) for end in growth.over_seeds)
    assert f'<small class="seeds">{ends}</small>' in page
    assert "its interval over seeds" in Page(page).text


def test_only_the_corrected_verdict_is_marked() -> None:
    data = usual()
    entry = data.assessment.strategies["DQN"]
    assert entry.to_reference is not None
    growth = Contrast(0.01, (0.00004, 0.02), 0.01, 0.02, "better")
    near = replace(entry.to_reference, growth=growth)
    none = replace(near, growth=replace(growth, finding="none"))

    def first_cell(difference: Any) -> str:
        strategies = {**data.assessment.strategies, "DQN": replace(entry, to_reference=difference)}
        changed = replace(data, assessment=replace(data.assessment, strategies=strategies))
        table = render_backtest(changed).split('aria-label="Table of differences"')[1]
        return table.split("<td", 2)[1]

    assert first_cell(near).startswith(' class="better">▲ +1.0')
    assert "+0.004% … +2.0%" in first_cell(near)
    assert first_cell(none).startswith(' class="">+1.0')


def test_costs_by_kind_have_a_table() -> None:
    data = usual(60)
    assert "Table of costs by kind" not in render_backtest(data)
    paid = {"commission": 0.002, "impact": 0.0015, "interest and carry": -0.01}
    dqn = replace(data.strategies["DQN"], costs=paid)
    data = replace(data, strategies={**data.strategies, "DQN": dqn})
    data = replace(data, config={**data.config, "cost_model": "itemized(impact=1)"})
    page = render_backtest(data)
    table = page.split("Table of costs by kind")[1].split("</table>")[0]
    rows = dict(re.findall(r"<th scope=\"row\">(.*?)</th>(.*?)</tr>", table))
    cells = {name: re.findall(r"<td>(.*?)</td>", row) for name, row in rows.items()}
    shown = [percent(value, 2) for value in (*paid.values(), -0.0065)]
    assert cells["DQN"] == shown
    assert cells["equal weight"] == ["–"] * 4
    assert re.findall(r"<th scope=\"col\">(.*?)</th>", table)[1:] == [*paid, "Sum"]
    text = Page(page).text
    assert "that the cost model itemized(impact=1) leaves out" in text
    assert "cash earns nothing" not in text


@pytest.mark.parametrize(
    ("cost_model", "words"),
    [
        ("proportional", "of the value traded"),
        ("itemized(impact=1)", "of commission, itemized costs"),
        ("mine:Costs(fee=2)", "of commission, costs of mine:Costs"),
    ],
)
def test_key_facts_name_the_cost_model(cost_model: str, words: str) -> None:
    data = usual(60)
    facts = key_facts(replace(data, config={**data.config, "cost_model": cost_model}))
    assert f"25\N{NARROW NO-BREAK SPACE}bp {words}" in facts


def test_growth_by_cost_has_a_table() -> None:
    """At the cost of the backtest it is the growth that all figures of the page are from."""
    data = usual(60)
    table = render_backtest(data).split("Table of growth by cost")[1].split("</table>")[0]
    headings = re.findall(r"<th scope=\"col\">(.*?)</th>", table)[1:]
    assert [re.sub(r"\D", "", heading) for heading in headings] == ["0", "25", "50", "125", "250"]
    cells = re.findall(r"<td>(.*?)</td>", table)
    growth = data.assessment.strategies["DQN"].measures["growth"].mean
    assert cells[1] == percent(growth)
    falling = [float(cell.strip("%").replace("\N{MINUS SIGN}", "-")) for cell in cells[:5]]
    assert falling == sorted(falling, reverse=True)
    # Without costs there is nothing to multiply.
    free = {name: replace(each, cost=0 * each.cost) for name, each in data.strategies.items()}
    assert "Table of growth by cost" not in render_backtest(replace(data, strategies=free))


def test_growth_by_capital_has_a_table() -> None:
    data = usual(60)
    assert "Table of growth by capital" not in render_backtest(data)
    found = Capacity((1e4, 1e6), {"DQN": (0.1, -0.02), "equal weight": (0.05, 0.04)})
    page = render_backtest(replace(data, capacity=found))
    table = page.split("Table of growth by capital")[1].split("</table>")[0]
    assert re.findall(r"<th scope=\"col\">(.*?)</th>", table)[1:] == [
        number(1e4, 0),
        number(1e6, 0),
    ]
    assert re.findall(r"<td>(.*?)</td>", table)[:2] == [percent(0.1), percent(-0.02)]


def test_months_are_compounded() -> None:
    days = np.array(["2020-11-30", "2020-12-01", "2020-12-02", "2021-01-04"], "datetime64[s]")
    returns = np.array([[0.1, 0.1, 0.1, -0.5]])
    still = np.zeros((1, 4))
    weights = np.tile([0.0, 1.0], (4, 1))
    series = {"equal weight": StrategySeries("baseline", returns, still, still, weights)}
    page = render_backtest(make_data(series, days, ("A",)))
    table = page.split('data-months="0"')[1].split("</table>")[0].replace("\N{MINUS SIGN}", "-")
    rows = re.findall(r"<th scope=\"row\">(\d+)</th>(.*?)</tr>", table)
    cells = {year: re.findall(r"<td[^>]*>(.*?)</td>", row) for year, row in rows}
    assert cells["2020"] == [""] * 10 + ["10.0", "21.0", "33.1"]
    assert cells["2021"] == ["-50.0"] + [""] * 11 + ["-50.0"]
    assert "No agent was tested" in page


def test_total_loss_one_seed_and_the_shortest_test() -> None:
    data = usual(days=2, seeds=1)
    ruined = replace(data.strategies["DQN"], returns=np.array([[0.1, -1.0]]))
    strategies = {**data.strategies, "DQN": ruined}
    page = Page(render_backtest(make_data(strategies, data.dates, data.assets)))
    dqn = page.data["strategies"][0]
    assert dqn["wealth"] == [1, 1.1, None]
    assert dqn["band"] is None
    assert not re.search(r"\bnan\b", "".join(page.words).lower())


def test_what_does_not_fit_is_refused() -> None:
    data = usual(20)
    fewer = {name: s for name, s in data.strategies.items() if name != "third"}
    with pytest.raises(QfolioError, match="different strategies"):
        render_backtest(replace(data, strategies=fewer))
    with pytest.raises(QfolioError, match="do not fit 20 dates and 3 assets"):
        render_backtest(replace(data, assets=("A", "B", "C")))


def test_picture(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {"report.html", "wealth.png"}
    with Image.open(folder / "wealth.png") as image:
        assert image.width > 1000
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_page_is_repeatable(data: BacktestData) -> None:
    assert render_backtest(data) == render_backtest(data)


def test_strategies_of_returns_alone() -> None:
    """What is not known is a dash; their holdings cannot be chosen, and nothing is compared."""
    known = of_returns_alone()
    page = render_backtest(known)
    shown = Page(page)
    weights = shown.data["weights"]
    assert weights["reference"] is None
    assert [each is None for each in weights["series"]] == [
        name in ("equal weight", "third") for name in shown_order(known)
    ]
    chooser = page.split('id="weights-strategy"')[1].split("</select>")[0]
    assert "DQN" in chooser
    assert "third" not in chooser
    assert "nan" not in page.split("<script")[0].lower().split()
    statistics = page.split('aria-label="Table of statistics"')[1]
    row = statistics.split(">third</th>")[1].split("</tr>")[0]
    assert re.findall(r"<td>([^<]*)", row)[-2:] == ["–", "–"]


def test_figures_beside_the_reference(data: BacktestData) -> None:
    html = render_backtest(data)
    table = html.split('aria-label="Table of figures beside the reference"')[1].split("</table>")[0]
    for name in ("DQN", "best of all", "equal weight"):
        cells = re.findall(r"<td>([^<]*)", table.split(f">{name}</th>")[1].split("</tr>")[0])
        measured = data.assessment.strategies[name].relative
        if name == data.assessment.reference:
            assert cells == ["–"] * 7
        else:
            assert cells[0] == percent(measured["active_return"].mean)
            assert cells[3] == number(measured["beta"].mean, 2)
