"""The commands about prices: check a table, backtest agents on it, and allocate for tomorrow."""

import datetime
import inspect
import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from qfolio.commands.arguments import (
    Assignments,
    Count,
    File,
    Folder,
    Modules,
    Name,
    Names,
    again,
)
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError

if TYPE_CHECKING:
    from qfolio.experiments.presets import Preset
    from qfolio.portfolio.backtest.run import Backtest

Missing = Literal["error", "drop-asset", "forward-fill"]
Late = Literal["error", "drop-asset", "trim", "join"]

BASIS_POINT = 1e-4


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
    from qfolio.portfolio.prices.table import check, describe, load

    options: dict[str, Any] = dict(missing=missing, late=late, features=features, date=date)
    findings = check(file, **options)
    console.print_findings(findings)
    if any(finding.severity == "error" for finding in findings):
        sys.exit(2)
    console.print_prices(describe(load(file, **options)))


def backtest(
    file: Positional[File] = None,
    *,
    agents: str = "dqn,pathwise",
    preset: str = "fast",
    cost_bps: float = 10.0,
    lag: int = 1,
    train: str = "5y",
    test: str = "1y",
    rolling: bool = False,
    cap: float = 1.0,
    cost_model: str = "proportional",
    signals: Name = None,
    baselines: Name = None,
    seeds: Count = None,
    seed: int = 0,
    episodes: Count = None,
    trials: int = 0,
    assignments: Assignments = (),
    out: Folder = None,
    resume: Folder = None,
    trust: Modules = (),
    missing: Missing = "error",
    late: Late = "error",
    features: Names = (),
    date: Name = None,
) -> None:
    """Train agents walk-forward on a price table and compare them with classical allocators.

    Args:
        file: CSV or Parquet with prices, which qfolio prices checks (default: 20 US stocks that
            come with skfolio).
        agents: Agents, separated by commas: dqn, pathwise, ppo, a2c, reinforce, sac, ddpg, td3, or
            your own as module:Name.
        preset: Preset of the agents.
        cost_bps: Cost of buying or selling, in basis points of the value traded.
        lag: Rows between the close that a decision sees and the close at which it trades.
        train: Length of the first training window: 5y, 6m, 8w or 500d (d counts rows).
        test: Length of a fold, after which agents are retrained.
        rolling: Train on a window of fixed length instead of all rows so far.
        cap: Largest weight of one asset, from 0 to 1.
        cost_model: Cost of trading and holding: proportional, or your own as module:Name.
        signals: Signals that agents observe beside returns, separated by commas, each with the rows
            that it looks back on and those that it skips: momentum:252-21,volatility:21, or your
            own as module:Name (default: none).
        baselines: Baselines, separated by commas, by name or your own as module:Name; equal-weight
            is always among them (default: all of qfolio's).
        seeds: Agents of each kind (default: the preset's number).
        seed: First seed; the others follow it.
        episodes: Training episodes of each agent in a fold (default: the preset's number).
        trials: Earlier trials on these prices, for the deflated Sharpe ratio; known trials on the
            default table are added to them.
        assignments: Hyperparameters of all agents that have them (learning_rate=1e-3) or of one
            (dqn.discount=0.9), or of the task (window=20 reward=crra).
        out: New folder for the backtest (default: one in runs/).
        resume: Folder of a backtest to resume.
        trust: Modules of your own code that the folder may name (default: none).
        missing: How to treat missing prices.
        late: How to treat assets that start later than the table.
        features: Columns that hold features for agents instead of prices.
        date: Column of dates (default: found by its name).
    """
    options = dict(locals())
    from qfolio.core import devices

    devices.configure()
    registry.trust(trust)
    from qfolio.commands import console
    from qfolio.commands.progress import BacktestProgress, stop
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.portfolio.prices.table import load

    if not 0 <= cost_bps <= 2000:
        raise QfolioError(f"--cost-bps is {cost_bps:g}; it must be from 0 to 2000.")
    if resume is None:
        table = load(file, missing=missing, late=late, features=features, date=date)
        chosen = {name: _preset(agent, preset, episodes) for name, agent in _split(agents).items()}
        observed = {} if signals is None else {"signals": signals}
        chosen = _assign(chosen, observed | settings.parse(assignments))
        folder = out or Path("runs") / f"backtest-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        run = Backtest.create(
            table,
            chosen,
            train=train,
            test=test,
            expanding=not rolling,
            lag=lag,
            cost=cost_bps * BASIS_POINT,
            cap=cap,
            cost_model=_known("cost", cost_model),
            baselines=list(registry.BASELINES)
            if baselines is None
            else [_known("baseline", name) for name in _split(baselines).values()],
            seeds=max((p.seeds for p in chosen.values()), default=1) if seeds is None else seeds,
            seed=seed,
            trials=trials,
            command=shlex.join(["qfolio", *sys.argv[1:]]),
            out=folder,
        )
    else:
        defaults = inspect.signature(backtest).parameters
        kept = defaults.keys() - {"resume", "trust"}
        if any(options[name] != defaults[name].default for name in kept):
            raise QfolioError("--resume keeps the backtest's settings; add only --trust.")
        run, folder = Backtest.open(resume), resume
    console.say(console.describe_backtest(run))
    with console.bar("compiling") as update:
        run.run(BacktestProgress(update))
    if run.interrupted:
        stop(again("qfolio backtest --resume", folder, *run.parts))
    _report(run, folder)


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


def _split(text: str) -> dict[str, str]:
    """The names in a comma-separated option, by their short names in the backtest."""
    agents = [name.strip() for name in text.split(",") if name.strip()]
    names = {registry.short(agent): agent for agent in agents}
    if len(names) < len(agents):
        raise QfolioError(f"{text} names one twice.")
    return names


def _known(kind: registry.Kind, name: str) -> str:
    """The name of a part that a user has typed; imports its module."""
    registry.find(kind, name)
    return name


def _named(setting: str, value: str) -> list[tuple[registry.Kind, str]]:
    """The parts that a setting of the task names."""
    from qfolio.portfolio.signals import COLUMN, names

    if setting == "signals":
        return [("signal", name) for name in names(value)]
    if setting == "anchor" and value and not value.startswith(COLUMN):
        return [("baseline", value)]
    return [("reward", value)] if setting == "reward" else []


def _preset(name: str, preset: str, episodes: int | None) -> "Preset":
    from qfolio.experiments import presets

    registry.find("agent", name)
    chosen = presets.preset(preset, "portfolio", name)
    return chosen if episodes is None else chosen._replace(episodes=episodes)


def _assign(presets: dict[str, "Preset"], chosen: dict[str, str]) -> dict[str, "Preset"]:
    """Presets with changed settings: of one agent (dqn.discount), of all that have it, or of the
    task. Imports the modules of parts that they name."""
    from qfolio.portfolio.task import Portfolio

    used = set()
    changed = {}
    own_options = {"lag", "cost", "cost_model", "max_weight"}
    for name, preset in presets.items():
        kind = registry.find("agent", preset.agent)
        own, task = {}, {}
        for key, value in chosen.items():
            who, dot, rest = key.rpartition(".")
            if dot and who != name:
                continue
            if rest in settings.names(kind):
                own[rest] = value
            elif rest in settings.names(Portfolio) - own_options:
                for part, named in _named(rest, value):
                    registry.find(part, named)
                task[rest] = value
            else:
                continue
            used.add(key)
        changed[name] = preset._replace(
            settings={**preset.settings, **settings.convert(kind, own)},
            task={**preset.task, **settings.convert(Portfolio, task)},
        )
    for key in chosen.keys() - used:
        raise QfolioError(
            f"--set {key}: none of {', '.join(presets)} has this setting, nor the portfolio task "
            "(its lag, costs and cap have options of their own)."
        )
    return changed


def _report(run: "Backtest", folder: Path) -> None:
    from qfolio.commands import console
    from qfolio.report.backtest.page import write_backtest_report
    from qfolio.report.collect import backtest_data

    with console.console.status("Replaying all strategies, drawing histories, writing the report"):
        entries, notes = run.entries()
        assessment = run.assess(entries)
        run.write_tables(entries, assessment)
        write_backtest_report(folder, backtest_data(run, entries, assessment, notes))
    console.print_assessment(assessment)
    console.say(f"Report: {folder / 'report.html'}")
