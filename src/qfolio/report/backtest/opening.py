"""The top of the page: a conclusion, the figures of one agent, and each agent's verdicts.

All of it compares an agent with one other strategy: the one of its first verdict.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from qfolio.core.text import listed
from qfolio.portfolio.backtest.statistics.assessment import JUDGED, Assessment
from qfolio.portfolio.backtest.statistics.differences import Difference
from qfolio.portfolio.backtest.statistics.estimates import Measured
from qfolio.portfolio.backtest.statistics.verdict import (
    at_any_speed,
    at_best_speed,
    claims,
    comparable,
    p_text,
    wiped_out,
)
from qfolio.report.axis import Axis, ticks_around
from qfolio.report.backtest.data import BacktestData, best_word, followed_names, shown_order
from qfolio.report.rendering import number, percent

Standing = Literal["better", "none", "worse", "ruined"]

WORDS: dict[Standing, str] = {
    "better": "better",
    "none": "no evidence",
    "worse": "worse",
    "ruined": "lost everything",
}
"""Verdicts on one measure, in words."""

TILES = {
    "growth": "Growth a year",
    "sharpe": "Sharpe ratio",
    "drawdown": "Deepest drawdown",
    "turnover": "Turnover a year",
    "cost_drag": "Cost a year",
}
"""Names of the figures at the top of the page, by measure."""


MEASURES: dict[Measured, str] = {"growth": "growth", "sharpe": "Sharpe ratio"}
"""Measures whose verdicts have a column."""


def against(name: str, test: Assessment) -> Difference:
    """The difference of an agent's first verdict, to the reference or its best rebalancing."""
    return claims(name, test)[0][1]


def standing(name: str, key: Measured, test: Assessment) -> Standing:
    """The verdict on an agent in one measure."""
    if wiped_out(test.strategies[name]):
        return "ruined"
    return against(name, test).contrasts()[key].finding or "none"


def lead_name(data: BacktestData) -> str | None:
    """The agent at the top of the page: the first with the best verdict; None without agents.

    It is not chosen by growth over the test, which would favor luck.
    """
    ranks = list(WORDS)

    def rank(name: str) -> tuple[int, int]:
        growth, sharpe = (ranks.index(standing(name, key, data.assessment)) for key in MEASURES)
        return growth, sharpe

    return min(followed_names(data), key=rank, default=None)


def rival_name(data: BacktestData) -> str:
    """The strategy beside the agent at the top of the page."""
    lead, test = lead_name(data), data.assessment
    return test.reference if lead is None else against(lead, test).reference


def conclusion(data: BacktestData) -> str:
    """The result of the backtest in one sentence."""
    lead, test, names = lead_name(data), data.assessment, followed_names(data)
    if lead is None:
        return "No agent was tested; these are the baselines alone."
    claim, difference = claims(lead, test)[0]
    if not comparable("growth", difference.growth):
        return f"{claim}."

    def which(key: Measured, *found: Standing) -> list[str]:
        return [name for name in names if standing(name, key, test) in found]

    def told(agents: list[str]) -> str:
        """How much one of some agents grew: the one at the top of the page, if it is of them."""
        agent = lead if lead in agents else agents[0]
        who, other = "it" if agents == [agent] else agent, against(agent, test).reference
        own, theirs = (test.strategies[name].measures["growth"].mean for name in (agent, other))
        return (
            f"{who} grew {percent(own)} a year after costs, against {percent(theirs)} for {other}"
        )

    if winners := which("growth", "better"):
        verb = "beats" if len(winners) == 1 else "beat"
        also = " and Sharpe ratio" if winners == which("sharpe", "better") else ""
        other = _others(winners, test, better=True)
        return f"{listed(winners)} {verb} {other} in growth{also}: {told(winners)}."
    if winners := which("sharpe", "better"):
        verb = "beats" if len(winners) == 1 else "beat"
        than = _others(winners, test, better=True)
        clearly = "" if set(winners) & set(which("growth", "worse", "ruined")) else "clearly "
        return (
            f"{listed(winners)} {verb} {than} in return for the risk, but not {clearly}in growth: "
            f"{told(winners)}."
        )
    if len(which("growth", "worse", "ruined")) == len(names):
        who = f"{lead} falls" if len(names) == 1 else "All agents fall"
        return f"{who} short of {_others(names, test)}: {told(names)}."
    who = f"{lead} does not clearly beat" if len(names) == 1 else "No agent clearly beats"
    return f"{who} {_others([lead], test)}: {told(names)}."


def _others(names: list[str], test: Assessment, better: bool = False) -> str:
    """What the first verdicts on some agents compare them with, in words."""
    slower = (at_any_speed if better else at_best_speed)(test.reference)
    said = [
        slower if against(name, test) is test.strategies[name].to_rebalanced else test.reference
        for name in names
    ]
    return " or ".join(dict.fromkeys(said))


def best_sentence(data: BacktestData) -> str:
    """Which strategy was best over the days of the test, by growth and by Sharpe ratio.

    Each speed of rebalancing the reference is one. With the difference in Sharpe ratio of the agent
    at the top of the page to the best baseline.
    """
    measured = {name: found.measures for name, found in data.assessment.strategies.items()}

    def best(key: str) -> str:
        return max(measured, key=lambda name: (measured[name][key].mean, name))

    by_growth, by_sharpe = best("growth"), best("sharpe")
    growth = percent(measured[by_growth]["growth"].mean)
    sharpe = number(measured[by_sharpe]["sharpe"].mean, 2)
    subject = f"Best of all {len(measured)} strategies, seen in hindsight:"
    if by_growth == by_sharpe:
        said = f"{subject} {by_growth}, in growth ({growth} a year) and Sharpe ratio ({sharpe})."
    else:
        said = (
            f"{subject} {by_growth} in growth ({growth} a year), {by_sharpe} in Sharpe ratio "
            f"({sharpe})."
        )
    test, lead = data.assessment, lead_name(data)
    if lead is None or (rival := to_best_sharpe(lead, test)) is None:
        return said
    low, high = (number(end, 2, sign=True) for end in rival.sharpe.interval)
    p = rival.sharpe.p_holm
    corrected = "" if p is None else f"; corrected p {p_text(p)}"
    return (
        f"{said} The Sharpe ratio of {lead} less that of the "
        f"{best_word(rival.reference, data)}, {rival.reference}, is "
        f"{number(rival.sharpe.value, 2, sign=True)} (95% interval {low} to {high}{corrected})."
    )


def to_best_sharpe(name: str, test: Assessment) -> Difference | None:
    """The difference to the baseline with the highest Sharpe ratio; None if that is the reference.

    None, too, if the ratios have no difference, as after a total loss.
    """
    entry = test.strategies[name]
    for each in (entry.to_best_sharpe, entry.to_best_baseline):
        if each is not None and each.reference == test.best_sharpe:
            return each if comparable("sharpe", each.sharpe) else None
    return None


def tiles(data: BacktestData) -> list[dict[str, str]]:
    """The main figures of the agent at the top of the page, or of the reference without agents."""
    test, lead, rival = data.assessment, lead_name(data), rival_name(data)
    own, other = (test.strategies[name].measures for name in (lead or rival, rival))

    def written(key: str, value: float) -> str:
        if key == "turnover" and not math.isnan(value):
            return f"{number(value)}\N{NO-BREAK SPACE}×"
        if key == "cost_drag":
            return percent(value, 2)
        return number(value, 2) if key == "sharpe" else percent(value)

    side: dict[str, str] = {key: standing(lead, key, test) for key in MEASURES if lead}
    return [
        {
            "name": name,
            "value": written(key, own[key].mean),
            "other": "" if lead is None else f"{rival}: {written(key, other[key].mean)}",
            "side": side.get(key, ""),
        }
        for key, name in TILES.items()
    ]


def verdict_lines(data: BacktestData) -> dict[str, Any]:
    """For each agent, the verdicts on growth and Sharpe ratio, with intervals on two axes.

    Intervals are those of the differences that the verdicts are about: ``against`` names the other
    strategy, or is empty if it is not the same for all agents, whose lines then name it.
    """
    test = data.assessment
    names = [name for name in shown_order(data) if test.strategies[name].kind in JUDGED]
    columns = [_column(key, names, data) for key in MEASURES]
    others = [against(name, test).reference for name in names]
    same = len(set(others)) == 1
    return {
        "against": others[0] if same else "",
        "slower": any(other != test.reference for other in others),
        "mixed": [said for name in names if (said := _only_here(name, test))],
        "apart": any(cell["apart"] for column in columns for cell in column["cells"]),
        "zeros": [column["zero"] for column in columns],
        "agents": [
            (name, "" if same else other, [column["cells"][place] for column in columns])
            for place, (name, other) in enumerate(zip(names, others, strict=True))
        ],
    }


def _only_here(name: str, test: Assessment) -> str:
    """The measures in which an agent beats the reference as it is, but not at every speed."""
    alone = test.strategies[name].to_reference
    assert alone is not None  # only the reference itself has none
    found = [
        word
        for key, word in MEASURES.items()
        if alone.contrasts()[key].finding == "better" and standing(name, key, test) == "none"
    ]
    return f"{name} in {listed(found)}" if found else ""


def _column(key: Measured, names: list[str], data: BacktestData) -> dict[str, Any]:
    test = data.assessment
    verdicts = [standing(name, key, test) for name in names]
    contrasts = [against(name, test).contrasts()[key] for name in names]
    known = [
        verdict != "ruined" and all(map(math.isfinite, (each.value, *each.interval)))
        for verdict, each in zip(verdicts, contrasts, strict=True)
    ]
    ends = [
        end
        for each, shown in zip(contrasts, known, strict=True)
        if shown
        for end in (each.value, *each.interval)
    ]
    ticks, _ = ticks_around(min(ends, default=0.0), max(ends, default=0.0))
    axis = Axis(min(*ends, *ticks, 0.0), max(*ends, *ticks, 0.0))

    def written(value: float) -> str:
        return number(value, 2, sign=True) if key == "sharpe" else percent(value, sign=True)

    cells: list[dict[str, Any]] = []
    for verdict, contrast, shown in zip(verdicts, contrasts, known, strict=True):
        cell = {"side": verdict, "word": WORDS[verdict], "apart": False}
        if not shown:
            cells.append({**cell, "value": "–", "span": None, "label": WORDS[verdict]})
            continue
        left, right = contrast.interval
        cells.append(
            {
                **cell,
                "apart": verdict == "none" and not left <= 0 <= right,
                "value": written(contrast.value),
                "span": axis.span(contrast.value, contrast.interval),
                "label": f"{written(contrast.value)}, 95% interval "
                f"{written(left)} to {written(right)}",
            }
        )
    return {"cells": cells, "zero": axis.at(0.0)}
