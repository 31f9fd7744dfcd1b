"""The looks of a backtest's strategies."""

from __future__ import annotations

from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.report.backtest.data import BacktestData
from qfolio.report.looks import Look

_DASHES = ("6 3", "2 2", "7 2 2 2", "9 3", "2 4", "7 2 2 2 2 2", "4 4")


def looks_of(names: list[str], data: BacktestData) -> dict[str, Look]:
    """The look of each strategy: agents and ensembles colored, most baselines thin and gray."""
    looks, agents, others = {}, 0, 1
    for name in names:
        if data.strategies[name].kind in JUDGED:
            looks[name] = Look.of_agent(agents, 2.2)
            agents += 1
        elif name == data.assessment.reference:
            looks[name] = Look("ink", width=1.6)
        elif name == data.assessment.best_baseline:
            looks[name] = Look("ink", _DASHES[0], 1.4)
        elif name == data.assessment.rebalanced:
            looks[name] = Look("muted", _DASHES[1], 1.5)
        else:
            others += 1
            looks[name] = Look("faint", _DASHES[others % len(_DASHES)], 1.1)
    return looks
