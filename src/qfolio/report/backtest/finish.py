"""The last step of a backtest: its results, written to its folder."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from qfolio.core.errors import QfolioError, require_type
from qfolio.portfolio.backtest.attribution.explain import explain
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.replay import Entry
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.statistics.assessment import Assessment
from qfolio.portfolio.backtest.writing import write_tables
from qfolio.report.backtest.collect import backtest_data
from qfolio.report.backtest.page import write_backtest_report


class Finished(NamedTuple):
    """The results of a backtest."""

    entries: dict[str, Entry]  # the replay of each strategy
    assessment: Assessment  # their statistics and verdicts
    why: Why  # the attribution of the agents' returns


def finish(backtest: Backtest) -> Finished:
    """Replay all strategies, and write the results of ``qfolio backtest`` to its folder.

    These are returns.csv, weights.csv, why.json, report.html, wealth.png and summary.json;
    ``qfolio allocate`` reads the last.

    Raises:
        QfolioError: The backtest has no folder, or is not finished.
    """
    wanted = "a backtest, such as qfolio.Backtest.open(folder)"
    require_type("backtest", backtest, Backtest, wanted)
    if backtest.folder is None:
        raise QfolioError("The backtest has no folder to write to; create it with out=FOLDER.")
    entries, notes = backtest.entries()
    with ThreadPoolExecutor(1) as thread:
        explained = thread.submit(explain, backtest, entries)
        assessment = backtest.assess(entries)
        why = explained.result()
    write_tables(backtest, entries, assessment, why)
    write_page(backtest, entries, assessment, notes, why)
    return Finished(entries, assessment, why)


def write_page(
    backtest: Backtest,
    entries: dict[str, Entry],
    assessment: Assessment,
    notes: list[str],
    why: Why | None,
) -> None:
    """Write the report into the backtest's folder."""
    assert backtest.folder is not None
    data = backtest_data(backtest, entries, assessment, notes, why)
    write_backtest_report(backtest.folder, data)
