"""The verdicts at the head of the page, and their intervals on a common axis."""

from __future__ import annotations

import math
from typing import Any

from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.portfolio.backtest.statistics.differences import Difference
from qfolio.portfolio.backtest.statistics.verdict import claims, evidence
from qfolio.report.axis import Axis, ticks_around
from qfolio.report.backtest.data import BacktestData
from qfolio.report.rendering import percent


def verdict_rows(names: list[str], data: BacktestData) -> dict[str, Any]:
    """Return each agent's verdicts, and their intervals' positions on a common axis (in %)."""
    test = data.assessment
    agents = [(name, claims(name, test)) for name in names if test.strategies[name].kind in JUDGED]
    ends = [
        end
        for _, claimed in agents
        for _, each in claimed
        if _tested(each)
        for end in (each.growth.value, *each.growth.interval)
        if math.isfinite(end)
    ]
    low, high = min(ends, default=0.0), max(ends, default=0.0)
    ticks, digits = ticks_around(low, high)
    low, high = min(low, ticks[0]), max(high, ticks[-1])
    margin = 0.04 * (high - low) or 1.0  # any positive width, if there is nothing to show
    axis = Axis(low - margin, high + margin)

    def row(claim: str, each: Difference) -> dict[str, Any]:
        growth, interval = each.growth.value, each.growth.interval
        known = _tested(each) and all(map(math.isfinite, (growth, *interval)))
        return {
            "finding": claim,
            "numbers": f"{numbers}." if (numbers := evidence(each, test)) else "",
            "span": axis.span(growth, interval) if known else None,
            "label": f"{percent(growth, sign=True)}, 95% interval "
            + " to ".join(percent(end, sign=True) for end in interval),
        }

    return {
        "agents": [
            (name, [row(claim, each) for claim, each in claimed]) for name, claimed in agents
        ],
        "ticks": [(percent(tick, digits, sign=True), axis.at(tick)) for tick in ticks],
        "zero": axis.at(0),
    }


def _tested(difference: Difference) -> bool:
    """Whether a verdict is on growth, of which the axis is."""
    return difference.growth.p is not None
