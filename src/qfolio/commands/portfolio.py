"""The commands about prices: check a table, backtest agents on it, and allocate for tomorrow."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from qfolio.commands.arguments import File, Modules, Name, Names, again
from qfolio.commands.backtesting import (
    DEFAULTS,
    Late,
    Missing,
    Shared,
    basis_points,
    write_report,
)
from qfolio.core import registry
from qfolio.core.errors import QfolioError


def prices(
    file: Positional[File] = None,
    *,
    missing: Missing = "error",
    late: Late = "error",
    features: Names = (),
    date: Name = None,
) -> None:
    """Check a price table and report errors, warnings and notes by row and column.

    Args:
        file: CSV or Parquet file, wide (a column per asset), long (date, asset, price) or as
            yfinance saves it (default: the 20 US stocks that come with qfolio).
        missing: How to treat missing prices.
        late: How to treat assets that start later than the table.
        features: Columns that hold features instead of prices.
        date: Column of dates (default: found by its name).
    """
    from qfolio.commands import console
    from qfolio.portfolio.prices.table import describe, inspect

    table, findings = inspect(file, missing=missing, late=late, features=features, date=date)
    console.print_findings(findings)
    if table is None:
        sys.exit(2)
    console.print_prices(describe(table))


def backtest(file: Positional[File] = None, *, options: Shared = DEFAULTS) -> None:
    """Train agents walk-forward on a price table and compare them with classical allocators.

    Args:
        file: CSV or Parquet with prices, which qfolio prices checks (default: 20 US stocks that
            come with skfolio).
    """
    from qfolio.core import devices

    devices.configure()
    registry.trust(options.trust)
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.progress import JobsProgress, stop
    from qfolio.experiments.log import tracked
    from qfolio.experiments.machines.choice import on
    from qfolio.portfolio.backtest.attribution.explain import explain
    from qfolio.portfolio.backtest.results import write_tables
    from qfolio.portfolio.backtest.run import Backtest

    executor, following = on(options.on), trackers(options.track)
    if options.resume is None:
        folder = options.folder("backtest")
        run = Backtest.create(
            options.load(file),
            options.presets(),
            lag=options.lag,
            cost=basis_points("--cost-bps", options.cost_bps),
            out=folder,
            **options.settings(),
        )
    elif file is None and options.only_resumes:
        run, folder = Backtest.open(options.resume), options.resume
    else:
        raise QfolioError(
            "--resume keeps the backtest's settings; add only --on, --track and --trust."
        )
    console.say(console.describe_backtest(run))
    with console.bar("compiling") as update, tracked(*following):
        run.run(JobsProgress(update), executor)
    if run.interrupted:
        stop(again("qfolio backtest --resume", folder, *run.parts, on=options.on))
    with console.console.status("Replaying all strategies, drawing histories, writing the report"):
        entries, notes = run.entries()
        assessment = run.assess(entries)
        why = explain(run, entries)
        write_tables(run, entries, assessment, why)
        write_report(run, entries, assessment, notes, why)
    console.print_assessment(assessment)
    for sentences in why.diagnosis.values():
        for sentence in sentences:
            console.say(f"Diagnosis: {sentence}")
    console.say(f"Report: {folder / 'report.html'}")


def allocate(
    folder: Positional[Path],
    *,
    prices: File = None,
    holdings: File = None,
    capital: Annotated[float | None, arg(metavar="X", help_behavior_hint="")] = None,
    agent: Name = None,
    anyway: bool = False,
    whole_shares: bool = False,
    as_of: Annotated[str | None, arg(metavar="DATE", help_behavior_hint="")] = None,
    update: bool = False,
    trust: Modules = (),
    missing: Missing = "error",
    features: Names = (),
    date: Name = None,
    as_json: Annotated[bool, arg(name="json")] = False,
) -> None:
    """Compute tomorrow's target weights, and the trades to reach them.

    The verdict of the backtest on the agent is printed, too. If the first agent did worse than
    equal weights, nothing is allocated without --agent or --anyway.

    Args:
        folder: Folder of a backtest; its policies are also trained on the latest rows.
        prices: Latest prices, CSV or Parquet, of the assets of the backtest (default: the prices
            of the backtest).
        holdings: Table with a column of assets (asset, symbol, ticker) and one of shares (shares,
            quantity, qty); a row "cash" holds money (default: all is cash).
        capital: Cash, unless the holdings include it.
        agent: Agent to follow (default: the first of the backtest).
        anyway: Allocate even if the backtest is not finished, or found the agent worse than equal
            weights.
        whole_shares: Trade whole shares only.
        as_of: Day of the allocation; prices may be up to a week older (default: today).
        update: Update the policy on the new rows first, and store the updated policy.
        trust: Modules of your own code that the folder may name (default: none).
        missing: How to treat missing prices.
        features: Columns that hold features (default: those of the backtest).
        date: Column of dates (default: found by its name).
        as_json: Print JSON instead of a table.
    """
    import numpy as np

    from qfolio.core import devices

    devices.configure()
    registry.trust(trust)
    from qfolio.commands import console
    from qfolio.portfolio.allocation import Allocation, require_fresh
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.portfolio.backtest.standing import Standing
    from qfolio.portfolio.holdings import read_holdings
    from qfolio.portfolio.prices.findings import day
    from qfolio.portfolio.prices.table import load

    run = Backtest.open(folder)
    name = next(iter(run.agents)) if agent is None else agent
    standing = Standing.of(folder, name)
    if not anyway:
        standing.require_sound(folder, named=agent is not None)
    policy = run.policy(name)
    table = run.prices
    if prices is not None:
        # The policy looks at the last rows only; assets may start at any row before.
        known = features or tuple(run.config.feature_names)
        options: dict[str, Any] = dict(missing=missing, features=known, date=date)
        table = policy.table(load(prices, late="join", **options))
    require_fresh(table, as_of)
    shares, cash = read_holdings(holdings, table.assets, capital)
    if update:
        policy = policy.update(table)
    allocation = Allocation.of(policy, table, shares, cash, whole_shares=whole_shares)
    trained = None if np.isnat(policy.learned) else day(policy.learned)
    if as_json:
        of = {"agent": name, "trained_until": trained, "verdict": standing.verdict or None}
        print(json.dumps({**of, **allocation.to_json()}, indent=2))
    else:
        console.print_allocation(allocation, standing, trained or "an unknown date")
    if update:
        run.keep(name, policy)
