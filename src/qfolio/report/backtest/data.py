"""The data of a backtest's report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.capacity import Capacity
from qfolio.portfolio.backtest.folder import followed
from qfolio.portfolio.backtest.statistics.assessment import JUDGED, Assessment
from qfolio.report.backtest.convergence import FoldTraining


@dataclass(frozen=True)
class StrategySeries:
    """The results of one strategy on D days, with S seeds (1 for a baseline) and N assets.

    Attributes:
        kind: 'agent', 'ensemble', 'strategy', 'baseline' or 'rebalancing'.
        returns: Simple returns net of costs, shape (S, D).
        turnover: Value bought plus value sold as a share of the wealth, shape (S, D).
        cost: Cost of each day's trade as a share of the wealth, shape (S, D).
        weights: Weights after the trade, cash first, mean over the seeds, shape (D, N + 1);
            NaN, like turnover and cost, where only returns are known.
        costs: Costs per year by kind, as shares of the wealth, means over the seeds; income is
            negative.
    """

    kind: str
    returns: Floats
    turnover: Floats
    cost: Floats
    weights: Floats
    costs: dict[str, float] = field(default_factory=dict)

    @property
    def weighted(self) -> bool:
        """Whether weights are known."""
        return not bool(np.isnan(self.weights).any())


@dataclass(frozen=True)
class BacktestData:
    """Everything the report of a backtest shows.

    Attributes:
        title: Heading of the page.
        command: Command line that repeats the backtest; may have several lines.
        assessment: The statistics of these strategies on these days.
        dates: Days on which the returns were earned, shape (D,), strictly increasing.
        assets: Names of the N assets, in the order of the weights.
        strategies: The strategies, by the same names as in the assessment.
        prices: The origin of the prices: source, rows, assets, first and last (dates), note (a
            caveat to show with every result on them, such as survivorship; may be empty) and
            digest; where they are known, also late_assets and delisted_assets (numbers of those
            that start or end within the table), haircut (the share of a holding that is lost when
            its asset ends) and has_members.
        config: All settings of the backtest but prices and assets, a nested dictionary.
        folds: For each fold name, train_first, train_last, test_first and test_last (ISO dates); at
            least one.
        notes: Problems of the backtest, in sentences.
        moves: Simple returns of the assets on these days, shape (D, N), 0 before an asset's start.
        risk_free: Simple returns of cash on these days, shape (D,).
        begin: The date of the first trade, from which the first return was earned.
        training: The training of each fold, by agent; empty if records are missing.
        why: The attribution of the agents' returns; without it, the page has no such section.
        capacity: Growth by capital, if costs depend on it.
    """

    title: str
    command: str
    assessment: Assessment
    dates: NDArray[np.datetime64]
    assets: tuple[str, ...]
    strategies: dict[str, StrategySeries]
    prices: dict[str, Any]
    config: dict[str, Any]
    folds: list[dict[str, Any]]
    notes: list[str]
    moves: Floats
    risk_free: Floats
    begin: np.datetime64
    training: dict[str, list[FoldTraining]] = field(default_factory=dict)
    why: Why | None = None
    capacity: Capacity | None = None

    @property
    def trades(self) -> NDArray[np.datetime64]:
        """The dates of the trades before each return, shape (D,)."""
        return np.append(self.begin, self.dates[:-1])


def require_fit(data: BacktestData) -> None:
    """Raise QfolioError if strategies, assessment, dates and assets do not match."""
    explained = set() if data.why is None else set(data.why.agents)
    if set(data.strategies) != set(data.assessment.strategies) or explained - set(data.strategies):
        raise QfolioError(
            "The series and the statistics are of different strategies; report one backtest."
        )
    days = (len(data.dates),)
    for name, series in data.strategies.items():
        shape = series.returns.shape
        fits = shape[1:] == days and series.turnover.shape == series.cost.shape == shape
        if not fits or series.weights.shape != (*days, len(data.assets) + 1):
            raise QfolioError(
                f"The series of {name} do not fit {days[0]} dates and {len(data.assets)} assets."
            )
    if data.moves.shape != (*days, len(data.assets)):
        raise QfolioError(
            f"The assets' returns do not fit {days[0]} dates and {len(data.assets)} assets."
        )


def followed_names(data: BacktestData) -> list[str]:
    """The strategies that ``allocate`` follows: an agent's ensemble, or the agent without one."""
    names = data.strategies
    return list(dict.fromkeys(followed(n, names) for n, s in names.items() if s.kind == "agent"))


def main_names(data: BacktestData) -> list[str]:
    """Agents and ensembles, and the strategies that they are compared with."""
    test = data.assessment
    agents = [name for name, series in data.strategies.items() if series.kind in JUDGED]
    return list(dict.fromkeys([*agents, test.reference, test.rebalanced, test.best_baseline]))


def shown_order(data: BacktestData) -> list[str]:
    """The main names, then the other baselines."""
    kinds = {name: series.kind for name, series in data.strategies.items()}
    others = [name for name, kind in kinds.items() if kind == "baseline"]
    return list(dict.fromkeys([*main_names(data), *others]))


def best_word(name: str, data: BacktestData) -> str:
    """What to call the best of the baselines and the user's own strategies."""
    return "best strategy" if data.strategies[name].kind == "strategy" else "best baseline"


def faint_names(data: BacktestData) -> list[str]:
    """All but the agents, the reference and the best baseline; charts hide them at first."""
    test = data.assessment
    bright = (test.reference, test.best_baseline)
    kinds = {name: series.kind for name, series in data.strategies.items()}
    return [n for n in shown_order(data) if kinds[n] not in JUDGED and n not in bright]
