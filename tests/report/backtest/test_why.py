"""What the page says about why an agent earned what it earned."""

import json
from dataclasses import replace

import pytest
from msgspec.structs import replace as replace_in

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.attribution.decomposition import AssetPart
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.report.backtest.page import render_backtest
from qfolio.report.backtest.why import headline, why_sections
from qfolio.report.rendering import percent

from backtests import Page, made_up_why, usual


@pytest.fixture(scope="module")
def explained():
    return usual(60, why=made_up_why())


def test_the_page_says_where_the_return_came_from(explained):
    text = Page(render_backtest(explained)).text
    for sentence in (
        "DQN-together earned 14.2% a year: 13.1% from equal weights, +0.4% from constant tilts "
        "and +1.1% from timing (t = 1.7 for the two together), less 0.4% in costs.",
        "Diagnosis: DQN-together traded once and never again.",
        "with constant tilts, t = 1.7",
        "Net returns less those of equal weight before its costs, regressed on factors made from "
        "the table. R² 31%",
        "Worth: 3 shuffles of each signal, the mean of all seeds, 10 replays in all.",
        "The linear rule explains 64% of the active weights",
        "volatility:21 shared by all assets",
    ):
        assert sentence in text, sentence


def test_of_many_assets_the_largest_parts_are_listed_and_the_rest_added_up(explained):
    names = tuple(f"A{j}" for j in range(100))
    why = made_up_why(assets=names)
    parts = why.agents["DQN-together"].decomposition.assets
    parts[60] = AssetPart("A59", 0.1, -0.2, 0.0)
    (section,) = why_sections(replace(explained, why=why))
    rows = section["assets"]
    assert [row["name"] for row in rows[:2]] == ["cash", "A59"]
    assert (len(rows), rows[-1]["name"]) == (22, "80 others")
    assert rows[-1]["cells"] == [
        percent(16),
        percent(2.4, 2, sign=True),
        percent(0.16, 2, sign=True),
    ]
    assert "and the sum of all others" in Page(render_backtest(replace(explained, why=why))).text
    assert len(why_sections(explained)[0]["assets"]) == 5  # a small table has all


def test_without_attributions_there_is_no_such_section():
    page = render_backtest(usual(60))
    assert 'id="why"' not in page
    assert "Diagnosis" not in page
    assert ".multiples" not in page


def test_the_section_is_made_again_from_its_file(explained):
    again = Why.read(json.loads(json.dumps(explained.why.to_json())))
    assert why_sections(replace(explained, why=again)) == why_sections(explained)


def test_signals_are_ordered_by_their_worth(explained):
    (section,) = why_sections(explained)
    names = [row["name"] for row in section["signals"]]
    assert names == ["momentum:20", "volatility:21", "all together"]
    first, second, _ = (row["bar"] for row in section["signals"])
    assert (first["side"], second["side"]) == ("gain", "loss")
    assert first["left"] == first["zero"] == second["left"] + second["width"]
    assert first["whisker"][0] + first["whisker"][1] == 100  # the longest
    assert section["signals"][0]["pull"]["sign"] == "▲"
    assert section["signals"][1]["term"] is None


@pytest.mark.parametrize("ignored", [False, True])
def test_signals_that_change_nothing_are_folded_up(explained, ignored):
    agents = explained.why.agents
    agent = agents["DQN-together"]
    agent = replace_in(agent, importance=replace_in(agent.importance, ignored=ignored))
    why = replace_in(explained.why, agents={**agents, "DQN-together": agent})
    page = render_backtest(replace(explained, why=why))
    folded = "<summary>Figures of each signal, and slices of the policy</summary>"
    assert (folded in page) == ignored
    said = "No signal changes what it decides, so no rule of signals describes it."
    assert page.count(said) == ignored
    assert page.count("<details") == page.count("</details>")


def test_a_rule_of_drift_is_not_said_to_be_learned(explained):
    agent = explained.why.agents["DQN-together"]
    pulls = [replace_in(pull, size=1e-6) for pull in agent.gradients.pulls]
    faint = replace_in(agent, gradients=replace_in(agent.gradients, whole=2e-6, pulls=pulls))
    said = "the rule describes how weights drift between trades, not what the agent learned."
    for shown, drifts in ((agent, False), (faint, True)):
        why = replace_in(explained.why, agents={"DQN-together": shown})
        (section,) = why_sections(replace(explained, why=why))
        widths = [row["pull"]["width"] for row in section["signals"] if row["pull"]]
        assert (max(widths) == 0) == drifts
        assert any(said in each for each in section["told"]) == drifts


def test_small_parts_have_more_digits(explained):
    parts = made_up_why().agents["DQN-together"].decomposition
    small = type(parts)(0.1315, 0.131, 0.001, 0.0001, 0.1, 0.0006, [], [])
    assert "+0.10% from constant tilts" in headline("x", small)
    assert "less 0.06% in costs" in headline("x", small)
    assert "less 0.4% in costs" in headline("x", parts)


def test_a_weight_that_never_changes_has_a_scale_with_round_ends(explained):
    """As that of a single asset, which is 100% or nearly so at every value of a signal."""
    (agent, why), *_ = explained.why.agents.items()
    flat = [[1.0, 1.0 - 1e-7, 1.0]]
    signals = [replace_in(each, x=[0.0, 0.5, 1.0], lines=flat, above=[]) for each in
               why.slices.signals]  # fmt: skip
    changed = replace_in(why, slices=replace_in(why.slices, signals=signals))
    data = replace(explained, why=replace_in(explained.why, agents={agent: changed}))
    panels = why_sections(data)[0]["slices"]["signals"]
    assert {panel["y"] for panel in panels} == {("99.0%", "100.0%")}


@pytest.mark.parametrize("line", [[1.1, 1.2, 1.4], [-0.3, -0.2, -0.1], [-0.2, 0.5, 1.3]])
def test_weights_of_loans_and_shorts_lie_within_their_axes(explained, line):
    (agent, why), *_ = explained.why.agents.items()
    signals = [replace_in(each, lines=[line], above=[]) for each in why.slices.signals]
    holding = replace_in(why.slices.holding, x=line, lines=[line])
    slices = replace_in(why.slices, signals=signals, holding=holding)
    changed = replace_in(why, slices=slices)
    data = replace(explained, why=replace_in(explained.why, agents={agent: changed}))
    panels = why_sections(data)[0]["slices"]
    for panel in (panels["holding"], *panels["signals"]):
        low, high = (float(end.replace("−", "-").rstrip("%")) / 100 for end in panel["y"])
        assert low <= line[0] + 1e-9
        assert high >= line[-1] - 1e-9


def test_attributions_of_another_backtest_are_refused(explained):
    with pytest.raises(QfolioError, match="one backtest"):
        render_backtest(replace(explained, why=made_up_why("another")))
