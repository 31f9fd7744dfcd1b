"""Collects the data of a report from a finished backtest."""

from collections.abc import Sequence

import msgspec

from qfolio.core.text import listed
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.capacity import capacity
from qfolio.portfolio.backtest.replay import Entry
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.simulation import Simulation
from qfolio.portfolio.backtest.statistics.assessment import Assessment
from qfolio.portfolio.prices.findings import day
from qfolio.report import rendering
from qfolio.report.backtest.convergence import FoldTraining
from qfolio.report.backtest.data import BacktestData, StrategySeries


def backtest_data(
    backtest: Backtest,
    entries: dict[str, Entry],
    assessment: Assessment,
    notes: Sequence[str],
    why: Why | None = None,
) -> BacktestData:
    """Collects everything ``write_backtest_report`` needs."""
    config, dates = backtest.config, backtest.prices.dates
    shift = config.lag + 1
    date = lambda row: day(dates[row])  # noqa: E731
    tested = rendering.years(*(str(backtest.dates[i]) for i in (0, -1)))
    table = str(config.prices["source"]).rpartition(": ")[2]  # without its vendor
    named = f"{listed(list(backtest.agents))} on {table}, {tested}"
    return BacktestData(
        title=config.title or named,
        command=config.command,
        assessment=assessment,
        dates=backtest.dates,
        assets=backtest.prices.assets,
        strategies={
            name: StrategySeries(
                entry.kind,
                entry.simulation.returns,
                entry.simulation.turnover,
                entry.simulation.cost,
                entry.mean_weights,
                _costs(entry.simulation, backtest.prices.periods_per_year),
            )
            for name, entry in entries.items()
        },
        prices={**config.prices, "haircut": backtest.prices.haircut},
        config={
            key: value
            for key, value in msgspec.to_builtins(config).items()
            if key not in ("prices", "assets")
        },
        folds=[
            {
                "name": fold.name,
                "train_first": date(fold.train.start),
                "train_last": date(fold.train.stop - 1),
                "test_first": date(fold.decisions.start + shift),
                "test_last": date(fold.decisions.stop - 1 + shift),
            }
            for fold in backtest.folds
        ],
        notes=list(notes),
        moves=backtest.replay.growth[:, 1:] - 1,
        risk_free=backtest.replay.growth[:, 0] - 1,
        begin=backtest.prices.dates[backtest.replay.rows[0]],
        training={name: folds for name in backtest.agents if (folds := _training(backtest, name))},
        why=why,
        capacity=capacity(backtest.replay, entries, assessment.reference),
    )


def _costs(simulation: Simulation, year: float) -> dict[str, float]:
    """Costs per year by kind, as shares of the wealth; interest or carry earned is negative."""
    costs = {kind: year * float(paid.mean()) for kind, paid in simulation.costs.items()}
    if simulation.financing is not None:
        costs["interest and carry"] = -year * float(simulation.financing.mean())
    return costs


def _training(backtest: Backtest, agent: str) -> list[FoldTraining]:
    """An agent's training in each fold; empty if a fold's records are missing."""
    records = (backtest.records(agent, fold.name) for fold in backtest.folds)
    folds = [FoldTraining.of(rows.column("return"), rows.column("episode")) for rows in records]
    known = [fold for fold in folds if fold is not None]
    return known if len(known) == len(folds) else []
