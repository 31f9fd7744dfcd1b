"""The look of a backtest's strategies, the same in every figure of its report."""

from __future__ import annotations

from dataclasses import dataclass

from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.report import palette
from qfolio.report.backtest.data import BacktestData

_DASHES = ("6 3", "2 2", "7 2 2 2", "9 3", "2 4", "7 2 2 2 2 2", "4 4")

SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon")


@dataclass(frozen=True)
class Look:
    """The line style of a strategy: agents and ensembles colored, most baselines thin and gray."""

    color: str  # a key of palette.LIGHT and palette.DARK
    width: float
    dash: str  # lengths as in SVG; '' is solid
    symbol: int | None  # index in SYMBOLS; None for baselines


def looks_of(names: list[str], data: BacktestData) -> dict[str, Look]:
    """The look of each strategy."""
    looks, agents, others = {}, 0, 1
    for name in names:
        if data.strategies[name].kind in JUDGED:
            dash = "" if agents < palette.AGENTS else "8 3"
            color = f"agent-{agents % palette.AGENTS + 1}"
            looks[name] = Look(color, 2.2, dash, agents % len(SYMBOLS))
            agents += 1
        elif name == data.assessment.reference:
            looks[name] = Look("ink", 1.6, "", None)
        elif name == data.assessment.best_baseline:
            looks[name] = Look("ink", 1.4, _DASHES[0], None)
        elif name == data.assessment.rebalanced:
            looks[name] = Look("muted", 1.5, _DASHES[1], None)
        else:
            others += 1
            looks[name] = Look("faint", 1.1, _DASHES[others % len(_DASHES)], None)
    return looks
