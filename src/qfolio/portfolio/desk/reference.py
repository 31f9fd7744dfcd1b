"""What a backtest's benchmark has earned over the live rows of a ledger."""

from pathlib import Path

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.folds import latest
from qfolio.portfolio.backtest.own import Own, place
from qfolio.portfolio.backtest.own_tables import read_own
from qfolio.portfolio.backtest.replay import Entry, Replay
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices


def reference(
    desk: Desk, table: Prices, first: int, count: int, source: Path | None
) -> tuple[np.ndarray, str]:
    """The benchmark's net returns, under the run's costs, calendar and mandate.

    A baseline learns from the rows up to the first decision. A strategy of the user's own is read
    from the backtest, or from ``source``.

    Args:
        desk: The run.
        table: The prices.
        first: Row of the first decision.
        count: Number of returns; the first ends at row ``first`` + lag + 1.
        source: Latest table of a benchmark that is a strategy of the user's own.

    Returns:
        Returns of shape (count,), and a sentence on what is unusual about them, or "".

    Raises:
        QfolioError: A source is given for a baseline, cannot be read, or is not known on all rows.
    """
    run, name = desk.run, desk.run.config.benchmark
    own = desk.own
    if source is not None and name not in own:
        raise QfolioError(
            f"The benchmark {name} is a baseline, which needs no table; leave out --benchmark."
        )
    if not count:
        return np.zeros(0), ""
    config = run.config
    fold = latest(name, table.dates[: first + 1], config.train, config.expanding)
    fold = fold._replace(decisions=slice(first, first + count))
    task = run.any_task.on(table).deciding_at(first)
    replay = Replay(table, [fold], task, config.cap)
    if name not in own:
        return _earned(replay.baseline("baseline", name, run.baselines[name])[0]), ""
    try:
        each = own[name] if source is None else read_own(name, source, table)
        placed = place(name, each, table, fold.decisions, task, config.cap)
    except QfolioError as error:
        raise QfolioError(
            f"The benchmark cannot be followed: {error} Give its latest table with --benchmark."
        ) from None
    return _earned(replay.own("baseline", placed)), _ended(name, each, table.dates[first])


def _earned(entry: Entry) -> np.ndarray:
    return np.asarray(entry.simulation.returns[0])


def _ended(name: str, own: Own, start: np.datetime64) -> str:
    """A note if a rebalanced strategy has had no order since the first allocation; else ""."""
    if own.kind != "weights" or len(own.dates) == 1 or own.dates[-1] >= start:
        return ""
    return (
        f"The last order of {name} is of {day(own.dates[-1])}, and its holding has drifted since; "
        "give later orders with --benchmark."
    )
