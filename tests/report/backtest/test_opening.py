"""The first screen of the page: conclusion, tiles, verdicts in a line, the best strategy."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics.differences import Finding
from qfolio.report.backtest.data import BacktestData, followed_names
from qfolio.report.backtest.opening import (
    best_sentence,
    conclusion,
    lead_name,
    rival_name,
    standing,
    tiles,
    verdict_lines,
)
from qfolio.report.backtest.page import render_backtest
from qfolio.report.rendering import number, percent

from backtests import make_data, usual


def found(data: BacktestData, **findings: tuple[Finding, Finding]) -> BacktestData:
    """The same backtest with other findings of growth and Sharpe ratio, by agent.

    They hold against the reference and at its best speed.
    """
    strategies = dict(data.assessment.strategies)
    for name, entry in strategies.items():
        if name not in followed_names(data):
            continue
        growth, sharpe = findings.get(name.removesuffix("-together"), ("none", "none"))
        assert entry.to_reference is not None
        assert entry.to_rebalanced is not None
        changed: dict[str, Any] = {
            field: replace(
                difference,
                growth=replace(difference.growth, finding=growth),
                sharpe=replace(difference.sharpe, finding=sharpe),
            )
            for field, difference in (
                ("to_reference", entry.to_reference),
                ("to_rebalanced", entry.to_rebalanced),
            )
        }
        strategies[name] = replace(entry, **changed)
    return replace(data, assessment=replace(data.assessment, strategies=strategies))


def growth(data: BacktestData, name: str) -> str:
    return percent(data.assessment.strategies[name].measures["growth"].mean)


@pytest.fixture(scope="module")
def plain() -> BacktestData:
    return usual()


def test_the_agents_are_those_that_allocate_follows(plain: BacktestData) -> None:
    assert followed_names(plain) == ["DQN-together", "pathwise"]


def test_the_conclusion_says_who_beats_the_reference(plain: BacktestData) -> None:
    data = found(plain, pathwise=("better", "better"))
    assert lead_name(data) == "pathwise"
    assert conclusion(data) == (
        "pathwise beats equal weight, however it is rebalanced, in growth and Sharpe ratio: it "
        f"grew {growth(data, 'pathwise')} a year after costs, against {growth(data, 'never')} for "
        "never."
    )
    both = found(plain, pathwise=("better", "none"), DQN=("better", "none"))
    assert conclusion(both).startswith(
        "DQN-together and pathwise beat equal weight, however it is rebalanced, in growth: "
        "DQN-together grew "
    )
    risk = found(plain, DQN=("none", "better"))
    assert conclusion(risk).startswith(
        "DQN-together beats equal weight, however it is rebalanced, in return for the risk, but "
        "not clearly in growth: it grew"
    )
    less = found(plain, DQN=("worse", "better"))
    assert lead_name(less) == "pathwise"  # but the sentence is not about it
    assert conclusion(less) == (
        "DQN-together beats equal weight, however it is rebalanced, in return for the risk, but "
        f"not in growth: it grew {growth(less, 'DQN-together')} a year after costs, against "
        f"{growth(less, 'never')} for never."
    )


def test_the_conclusion_says_that_nobody_does(plain: BacktestData) -> None:
    data = found(plain, pathwise=("worse", "none"))
    assert lead_name(data) == "DQN-together"  # not the one that grew most: that may be luck
    assert conclusion(data).startswith(
        "No agent clearly beats the best rebalancing of equal weight: DQN-together grew"
    )
    worse = found(plain, pathwise=("worse", "worse"), DQN=("worse", "none"))
    assert conclusion(worse).startswith(
        "All agents fall short of the best rebalancing of equal weight: "
    )


def with_findings(data: BacktestData, alone: Finding, rebalanced: Finding) -> BacktestData:
    """Pathwise with other findings of growth: to the reference, and to its best rebalancing."""
    changed = found(data, pathwise=(alone, "none"))
    entry = changed.assessment.strategies["pathwise"]
    assert entry.to_rebalanced is not None
    slower = replace(
        entry.to_rebalanced, growth=replace(entry.to_rebalanced.growth, finding=rebalanced)
    )
    strategies = {
        **changed.assessment.strategies,
        "pathwise": replace(entry, to_rebalanced=slower),
    }
    return replace(changed, assessment=replace(changed.assessment, strategies=strategies))


def line_of(name: str, data: BacktestData) -> tuple[str, list[dict[str, Any]]]:
    lines = verdict_lines(data)["agents"]
    return next((other, cells) for each, other, cells in lines if each == name)


def test_better_than_the_reference_only_as_it_was_rebalanced(plain: BacktestData) -> None:
    data = with_findings(plain, "better", "none")
    lines = verdict_lines(data)
    assert standing("pathwise", "growth", data.assessment) == "none"
    assert lines["mixed"] == ["pathwise in growth"]
    assert lines["slower"]
    assert not verdict_lines(found(plain, pathwise=("better", "none")))["mixed"]


def test_all_stand_beside_the_reference_of_the_verdict(plain: BacktestData) -> None:
    """Headline, figures and intervals, though the agent beats what the verdict is not about."""
    test = plain.assessment
    assert (test.reference, test.rebalanced) == ("equal weight", "never")
    entry = test.strategies["pathwise"]
    assert entry.to_reference is not None
    assert entry.to_rebalanced is not None
    for alone, rebalanced, other, to in (
        ("none", "worse", "never", entry.to_rebalanced),
        ("none", "none", "never", entry.to_rebalanced),
        ("worse", "none", "equal weight", entry.to_reference),
    ):
        data = with_findings(plain, alone, rebalanced)  # type: ignore[arg-type]
        cell = line_of("pathwise", data)[1][0]
        assert cell["value"] == percent(to.growth.value, sign=True)
        assert rival_name(found(plain)) == "never"
        alone_tested = replace(
            data, strategies={n: s for n, s in data.strategies.items() if "DQN" not in n}
        )
        assert rival_name(alone_tested) == other
        assert conclusion(alone_tested).endswith(f", against {growth(plain, other)} for {other}.")
        assert all(tile["other"].startswith(other) for tile in tiles(alone_tested))
    # Where the others are not the same, each line names its own.
    assert verdict_lines(data)["against"] == ""
    assert line_of("pathwise", data)[0] == "equal weight"
    assert line_of("DQN", data)[0] == "never"
    assert verdict_lines(plain)["against"] == "never"


def test_a_bar_that_excludes_zero_without_evidence_is_explained(plain: BacktestData) -> None:
    data = found(plain, pathwise=("better", "better"), DQN=("none", "none"))
    assert not verdict_lines(data)["apart"]
    assert verdict_lines(found(plain))["apart"]  # pathwise grew much more


def test_a_total_loss_leads_to_no_numbers(plain: BacktestData) -> None:
    series = {n: s for n, s in plain.strategies.items() if n != "pathwise" and "DQN" not in n}
    lost = plain.strategies["pathwise"].returns.copy()
    lost[:, 100] = -1
    lost[:, 101:] = 0
    series["pathwise"] = replace(plain.strategies["pathwise"], returns=lost)
    data = make_data(series, plain.dates, plain.assets)
    assert conclusion(data) == "pathwise was wiped out: it lost everything."
    (cell, _) = line_of("pathwise", data)[1]
    assert (cell["word"], cell["value"], cell["span"]) == ("lost everything", "–", None)
    page = render_backtest(data).split("</header>")[0]
    assert "∞" not in page
    assert "pathwise was wiped out: it lost everything.</p>" in page


def test_tiles_stand_beside_the_reference(plain: BacktestData) -> None:
    data = found(plain, pathwise=("better", "none"))
    shown = {tile["name"]: tile for tile in tiles(data)}
    own, other = (data.assessment.strategies[n].measures for n in ("pathwise", "never"))
    assert shown["Sharpe ratio"]["value"] == number(own["sharpe"].mean, 2)
    assert shown["Sharpe ratio"]["other"] == f"never: {number(other['sharpe'].mean, 2)}"
    assert shown["Deepest drawdown"]["value"] == percent(own["drawdown"].mean)
    assert shown["Turnover a year"]["value"] == f"{number(own['turnover'].mean)}\N{NO-BREAK SPACE}×"
    assert [tile["side"] for tile in shown.values()] == ["better", "none", "", "", ""]


def test_each_agent_has_one_line_of_two_verdicts(plain: BacktestData) -> None:
    lines = verdict_lines(found(plain, pathwise=("better", "none")))
    assert [name for name, *_ in lines["agents"]] == ["DQN", "DQN-together", "pathwise"]
    pathwise = lines["agents"][2][2]
    assert [cell["word"] for cell in pathwise] == ["better", "no evidence"]
    left, width, middle = pathwise[0]["span"]
    assert lines["zeros"][0] < left < middle < left + width <= 100


def test_the_best_strategies_are_named(plain: BacktestData) -> None:
    assert best_sentence(plain).startswith("Best of all 8 strategies, seen in hindsight: pathwise,")


def test_a_speed_of_the_reference_can_be_the_best(plain: BacktestData) -> None:
    """Also one that is not drawn, because it is not the best rebalancing in growth."""
    calm = replace(plain.strategies["never"], returns=np.full((1, 300), 1e-4))
    calm.returns[0, ::2] += 1e-6
    strategies = {**plain.strategies, "never": calm}
    data = make_data(strategies, plain.dates, plain.assets)
    said = best_sentence(data)
    assert "pathwise in growth" in said
    assert ", never in Sharpe ratio" in said


def test_without_agents_the_reference_leads(plain: BacktestData) -> None:
    series = {n: s for n, s in plain.strategies.items() if s.kind == "baseline"}
    alone = make_data(series, plain.dates, plain.assets)
    assert lead_name(alone) is None
    assert conclusion(alone).startswith("No agent was tested")
    assert all(tile["other"] == "" for tile in tiles(alone))
