"""The commands that check a price table and backtest agents on it."""

import dataclasses

from tyro.conf import Positional

from qfolio.commands.arguments import File, Name, prepare
from qfolio.commands.backtesting import DEFAULTS, Shared, basis_points
from qfolio.commands.parsing import Document, Failed, outcome
from qfolio.commands.tables import READING, Read
from qfolio.core.errors import QfolioError
from qfolio.core.registry import again


def prices(file: Positional[File] = None, *, reading: Read = READING) -> Document:
    """Check a price table and report errors, warnings and notes by row and column.

    Examples:
        qfolio prices prices.csv
        qfolio prices prices.csv --missing forward-fill --json

    Args:
        file: CSV or Parquet file, wide (a column per asset), long (date, asset, price) or as
            yfinance saves it, or a folder with a file for each asset (default: the 20 US stocks
            that come with skfolio).
    """
    from qfolio.commands.console.tables import print_findings, print_prices
    from qfolio.portfolio.prices.table import describe, inspect

    table, findings = inspect(file, **reading.reading)
    print_findings(findings)
    found: Document = {"findings": [dataclasses.asdict(finding) for finding in findings]}
    if table is None:
        raise Failed(found)
    facts = describe(table)
    print_prices(facts)
    return facts | found


def backtest(
    file: Positional[File] = None,
    *,
    options: Shared = DEFAULTS,
    title: Name = None,
) -> Document:
    """Train agents walk-forward on a price table and compare them with classical allocators.

    Examples:
        qfolio backtest prices.csv
        qfolio backtest prices.csv --agents tilts --cost-bps 5 --out runs/mine
        qfolio backtest --resume runs/mine
        qfolio backtest prices.csv --resume runs/mine

    Args:
        file: CSV or Parquet with prices, which qfolio prices checks (default: 20 US stocks that
            come with skfolio). With --resume, the backtest's table with more rows at its end, read
            with the same options: finished folds keep their policies, new ones are trained.
        title: Title of the report (default: the agents, the table and its years).
    """
    prepare(options.trust)
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.console.backtest import describe_backtest, print_assessment
    from qfolio.commands.progress import JobsProgress, stop
    from qfolio.core.files import read_json
    from qfolio.experiments.interrupts import resumable
    from qfolio.experiments.log import tracked
    from qfolio.portfolio.backtest.notes import beforehand
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.report.backtest.finish import finish

    executor, following = options.executor, trackers(options.track)
    if options.resume is None:
        folder = options.folder("backtest")
        run = Backtest.create(
            options.load(file),
            options.presets(),
            lag=options.lag,
            cost=basis_points("--cost-bps", options.cost_bps),
            title=title or "",
            out=folder,
            **options.settings(),
        )
    elif options.only_resumes(table=file is not None):
        run, folder = Backtest.open(options.resume), options.resume
        if file is not None:
            run = run.extended(options.like(run.prices).load(file))
    else:
        raise QfolioError(
            "--resume keeps the backtest's settings; add only --on, --track, --trust, or a table "
            "with more rows."
        )
    console.say(describe_backtest(run))
    for note in beforehand(run.config.agents, run.replay):
        console.tell(note)
    resume = again("qfolio backtest --resume", folder, *run.parts, on=options.on)
    status = "Replaying all strategies, explaining the agents and writing the report"
    with resumable(resume):
        with console.bar("compiling") as update, tracked(*following):
            run.run(JobsProgress(update), executor)
        if run.interrupted:
            stop(resume)
        with console.working(status):
            found = finish(run)
    print_assessment(found.assessment)
    for sentences in found.why.diagnosis.values():
        for sentence in sentences:
            console.tell(f"Diagnosis: {sentence}")
    return outcome(folder, read_json(folder / "summary.json"))
