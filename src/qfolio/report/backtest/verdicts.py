"""The verdicts at the head of the page, and their intervals on a common axis."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.portfolio.backtest.statistics.differences import Difference
from qfolio.portfolio.backtest.statistics.verdict import claims, evidence
from qfolio.report.backtest.data import BacktestData
from qfolio.report.rendering import percent, place


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
    at = partial(place, low=low - margin, high=high + margin)

    def row(claim: str, each: Difference) -> dict[str, Any]:
        growth, interval = each.growth.value, each.growth.interval
        left, right = map(at, interval)
        known = _tested(each) and all(map(math.isfinite, (growth, *interval)))
        return {
            "finding": claim,
            "numbers": f"{numbers}." if (numbers := evidence(each, test)) else "",
            "span": (left, round(right - left, 2), at(growth)) if known else None,
            "label": f"{percent(growth, sign=True)}, 95% interval "
            + " to ".join(percent(end, sign=True) for end in interval),
        }

    return {
        "agents": [
            (name, [row(claim, each) for claim, each in claimed]) for name, claimed in agents
        ],
        "ticks": [(percent(tick, digits, sign=True), at(tick)) for tick in ticks],
        "zero": at(0),
    }


def _tested(difference: Difference) -> bool:
    """Whether a verdict is on growth, of which the axis is."""
    return difference.growth.p is not None


def ticks_around(low: float, high: float) -> tuple[list[float], int]:
    """Round numbers around an interval and zero, and the decimals that they need in percent."""
    ticks = _ticks(min(low, 0), max(high, 0))
    return ticks, _digits(ticks)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers around an interval that contains zero, at most six."""
    width = max(high - low, 1e-4)
    power = 10 ** math.floor(math.log10(width))
    step = next(k * power for k in (0.2, 0.5, 1, 2, 5, 10) if width / (k * power) <= 4)
    return [k * step for k in range(math.ceil(low / step - 0.5), math.floor(high / step + 0.5) + 1)]


def _digits(ticks: list[float]) -> int:
    """The decimals with which these fractions are exact percentages."""
    return next(
        (d for d in range(5) if all(abs(100 * t - round(100 * t, d)) < 1e-9 for t in ticks)), 5
    )
