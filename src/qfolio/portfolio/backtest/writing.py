"""Writes the files of a finished backtest, except for its report."""

from collections.abc import Mapping

from qfolio.core.text import finite
from qfolio.experiments.log import add_result
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.folder import RISK_FREE, BacktestFolder
from qfolio.portfolio.backtest.folds import spell_all
from qfolio.portfolio.backtest.replay import Entry
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.statistics.assessment import Assessment
from qfolio.portfolio.backtest.statistics.verdict import verdicts


def write_tables(
    backtest: Backtest,
    entries: Mapping[str, Entry],
    assessed: Assessment,
    why: Why | None = None,
) -> None:
    """Writes returns.csv (a column per strategy and seed), weights.csv (means) and summary.json.

    If cash earns interest, returns.csv has a column of its returns. With attributions, it also
    writes why.json, and the diagnosis into summary.json.
    """
    assert backtest.folder is not None
    folder, dates, first = BacktestFolder(backtest.folder), backtest.dates, backtest.config.seed
    days = spell_all(dates, backtest.prices.dates)
    columns = {
        f"{name}/{first + i}" if name in backtest.agents else name: series
        for name, entry in entries.items()
        for i, series in enumerate(entry.simulation.returns)
    }
    if (cash := backtest.replay.growth[:, 0] - 1).any():
        columns.setdefault(RISK_FREE, cash)
    folder.write_returns(days, columns)
    weights = {
        name: entry.mean_weights
        for name, entry in entries.items()
        if entry.kind != "rebalancing" and entry.weighted
    }
    folder.write_weights(dates, days, backtest.prices.assets, weights)
    summary = {**assessed.to_json(), "verdicts": verdicts(assessed)}
    if why is not None:
        folder.write_why(why.to_json())
        summary["diagnosis"] = why.diagnosis
    folder.write_summary(summary)
    add_result(
        backtest.folder,
        {
            name: {key: finite(measure.mean) for key, measure in strategy.measures.items()}
            for name, strategy in assessed.strategies.items()
            if strategy.kind != "rebalancing"
        },
    )
