"""The top of the page: a conclusion, the figures of one agent, and each agent's verdicts."""

from __future__ import annotations

import math
from typing import Any, Literal

from qfolio.core.text import listed
from qfolio.portfolio.backtest.assessment import JUDGED, StrategyAssessment
from qfolio.portfolio.backtest.estimates import Measured
from qfolio.report.backtest.data import BacktestData, followed_names, shown_order
from qfolio.report.backtest.verdicts import ticks_around
from qfolio.report.rendering import number, percent

Standing = Literal["better", "mixed", "none", "worse"]

WORDS: dict[Standing, str] = {
    "better": "better",
    "mixed": "better, not at every speed",
    "none": "no evidence",
    "worse": "worse",
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


def standing(entry: StrategyAssessment, key: Measured) -> Standing:
    """The verdict on an agent in one measure, against the reference at every speed."""
    assert entry.to_reference is not None  # only the reference itself has none
    alone = entry.to_reference.contrasts()[key].finding
    main = (entry.to_rebalanced or entry.to_reference).contrasts()[key].finding
    if "worse" in (alone, main):
        return "worse"
    if main == "better":
        return "better"
    return "mixed" if alone == "better" else "none"


def lead_name(data: BacktestData) -> str | None:
    """The agent at the top of the page: the first with the best verdict; None without agents.

    It is not chosen by growth over the test, which would favor luck.
    """
    ranks = {"better": 0, "mixed": 1, "none": 2, "worse": 3}

    def rank(name: str) -> tuple[int, int]:
        entry = data.assessment.strategies[name]
        growth, sharpe = (ranks[standing(entry, key)] for key in ("growth", "sharpe"))
        return growth, sharpe

    return min(followed_names(data), key=rank, default=None)


def conclusion(data: BacktestData) -> str:
    """The result of the backtest in one sentence."""
    lead, reference = lead_name(data), data.assessment.reference
    if lead is None:
        return "No agent was tested; these are the baselines alone."
    entries, names = data.assessment.strategies, followed_names(data)
    found = {
        key: {name: standing(entries[name], key) for name in names} for key in ("growth", "sharpe")
    }

    def which(key: str, verdict: Standing) -> list[str]:
        return [name for name in names if found[key][name] == verdict]

    own, other = entries[lead].measures, entries[reference].measures

    def told(subject: str) -> str:
        who = "it" if subject == lead else lead
        return (
            f"{who} grew {percent(own['growth'].mean)} a year after costs, {reference} "
            f"{percent(other['growth'].mean)}"
        )

    if winners := which("growth", "better"):
        verb = "beats" if len(winners) == 1 else "beat"
        also = " and Sharpe ratio" if winners == which("sharpe", "better") else ""
        return f"{listed(winners)} {verb} {reference} in growth{also}: {told(listed(winners))}."
    if winners := which("sharpe", "better"):
        verb = "beats" if len(winners) == 1 else "beat"
        return (
            f"{listed(winners)} {verb} {reference} in return for the risk, but not in growth: "
            f"{told(listed(winners))}."
        )
    subject = lead if len(names) == 1 else ""
    if len(which("growth", "worse")) == len(names):
        who = f"{lead} falls" if len(names) == 1 else "All agents fall"
        return f"{who} short of {reference}: {told(subject)}."
    who = f"{lead} does not clearly beat" if len(names) == 1 else "No agent clearly beats"
    return f"{who} {reference}: {told(subject)}."


def best_sentence(data: BacktestData) -> str:
    """Which strategy was best over the days of the test, by growth and by Sharpe ratio."""
    measured = {name: data.assessment.strategies[name].measures for name in shown_order(data)}

    def best(key: str) -> str:
        return max(measured, key=lambda name: (measured[name][key].mean, name))

    by_growth, by_sharpe = best("growth"), best("sharpe")
    growth = percent(measured[by_growth]["growth"].mean)
    sharpe = number(measured[by_sharpe]["sharpe"].mean, 2)
    if by_growth == by_sharpe:
        return (
            f"Best of all {len(measured)} strategies, seen in hindsight: {by_growth}, in growth "
            f"({growth} a year) and Sharpe ratio ({sharpe})."
        )
    return (
        f"Best of all {len(measured)} strategies, seen in hindsight: {by_growth} in growth "
        f"({growth} a year), {by_sharpe} in Sharpe ratio ({sharpe})."
    )


def tiles(data: BacktestData) -> list[dict[str, str]]:
    """The main figures of the agent at the top of the page, or of the reference without agents."""
    test, lead = data.assessment, lead_name(data)
    shown = test.reference if lead is None else lead
    own, other = (test.strategies[name].measures for name in (shown, test.reference))

    def written(key: str, value: float) -> str:
        if key == "turnover" and not math.isnan(value):
            return f"{number(value)} ×"
        if key == "cost_drag":
            return percent(value, 2)
        return number(value, 2) if key == "sharpe" else percent(value)

    side = {
        key: "" if lead is None else standing(test.strategies[lead], key)
        for key in ("growth", "sharpe")
    }
    return [
        {
            "name": name,
            "value": written(key, own[key].mean),
            "other": "" if lead is None else written(key, other[key].mean),
            "side": side.get(key, ""),
        }
        for key, name in TILES.items()
    ]


def verdict_lines(data: BacktestData) -> dict[str, Any]:
    """For each agent, the verdicts on growth and Sharpe ratio, with intervals on two axes."""
    test = data.assessment
    names = [name for name in shown_order(data) if test.strategies[name].kind in JUDGED]
    columns = [_column(key, names, data) for key in ("growth", "sharpe")]
    return {
        "mixed": any(cell["side"] == "mixed" for column in columns for cell in column["cells"]),
        "zeros": [column["zero"] for column in columns],
        "agents": [
            (name, [column["cells"][place] for column in columns])
            for place, name in enumerate(names)
        ],
    }


def _column(key: Measured, names: list[str], data: BacktestData) -> dict[str, Any]:
    entries = [data.assessment.strategies[name] for name in names]
    contrasts = [entry.to_reference.contrasts()[key] for entry in entries if entry.to_reference]
    ends = [e for c in contrasts for e in (c.value, *c.interval) if math.isfinite(e)]
    ticks, _ = ticks_around(min(ends, default=0.0), max(ends, default=0.0))
    low, high = min(*ends, *ticks, 0.0), max(*ends, *ticks, 0.0)
    width = (high - low) or 1.0

    def place(value: float) -> float:
        return round(100 * min(max((value - low) / width, 0.0), 1.0), 2)

    def written(value: float) -> str:
        return number(value, 2, sign=True) if key == "sharpe" else percent(value, sign=True)

    cells = []
    for entry, contrast in zip(entries, contrasts, strict=True):
        verdict = standing(entry, key)
        left, right = contrast.interval
        known = all(map(math.isfinite, (contrast.value, left, right)))
        cells.append(
            {
                "side": verdict,
                "word": WORDS[verdict],
                "value": written(contrast.value),
                "span": (place(left), round(place(right) - place(left), 2), place(contrast.value))
                if known
                else None,
                "label": f"{written(contrast.value)}, 95% interval "
                f"{written(left)} to {written(right)}",
            }
        )
    return {"cells": cells, "zero": place(0.0)}
