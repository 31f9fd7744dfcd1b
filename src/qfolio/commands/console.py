"""Output of the commands: live progress and tables."""

import contextlib
import math
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from textwrap import fill
from typing import TYPE_CHECKING, Any, Literal

import rich.progress
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qfolio.core.registry import short
from qfolio.core.statistics import FEWEST_SEEDS
from qfolio.core.text import amount, figure, printable

if TYPE_CHECKING:
    from qfolio.experiments.budget import Budget
    from qfolio.experiments.run import Run
    from qfolio.experiments.tuning.run import Tuning
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.portfolio.backtest.statistics.assessment import Assessment
    from qfolio.portfolio.backtest.statistics.sampled import Measure
    from qfolio.portfolio.desk.allocation import Allocation
    from qfolio.portfolio.desk.follow import Following
    from qfolio.portfolio.desk.standing import Standing
    from qfolio.portfolio.prices.findings import Finding
    from qfolio.portfolio.study.folder import Result, Variant
    from qfolio.portfolio.study.pooling import Active, Pooled
    from qfolio.portfolio.study.run import Study

console = Console(highlight=False)
if not console.is_terminal:
    console.width = 10_000  # files and pipes have no width: nothing is folded there


def say(text: str) -> None:
    """Prints lines; control characters are escaped."""
    print("\n".join(map(printable, text.split("\n"))), flush=True)


def tell(sentences: str) -> None:
    """Prints sentences; a terminal breaks them between words."""
    if console.is_terminal:
        sentences = fill(sentences, console.width, break_long_words=False, break_on_hyphens=False)
    say(sentences)


@contextlib.contextmanager
def bar(text: str, total: float = 1.0, done: int = 0) -> Iterator[Callable[..., None]]:
    """A bar with text beside it, on terminals only, removed at the end.

    Yields the function that moves it: ``update(completed=…)``, with ``description=…`` for new text.
    """
    columns = (
        rich.progress.BarColumn(bar_width=24),
        rich.progress.TextColumn("{task.description}"),
    )
    with rich.progress.Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as live:
        yield partial(live.update, live.add_task(text, total=total, completed=done))


def print_table(
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    bold: Container[str] = (),
    width: int = 0,
) -> None:
    """A table; its first column names the rows, and numbers in the others are aligned.

    Args:
        heads: The columns' names.
        rows: Their cells.
        bold: Names of the rows to emphasize.
        width: Characters that each column has at least.
    """
    table = Table(box=None, header_style="bold", pad_edge=False)
    for i, head in enumerate(heads):
        side: Literal["left", "right"] = "right" if i else "left"
        # On a narrow terminal names are folded, so that no digit is cut off.
        whole = i > 0
        name = Text(printable(head))
        table.add_column(name, justify=side, no_wrap=whole, overflow="fold", min_width=width)
    for row in rows:
        cells = (Text(printable(cell)) for cell in row)
        table.add_row(*cells, style="bold" if row[0] in bold else None)
    console.print(table)


def describe_run(run: "Run", budget: "Budget") -> str:
    """Agent, task and seeds of a run, and its budget if rounding makes it larger."""
    config, planned = run.config, budget.planned(run.population)
    seeds = amount(config.seeds, "seed")
    return (
        f"{short(config.agent).upper()} on {config.task} · preset {config.preset or 'none'} · "
        f"{seeds} · {config.device}"
    ) + (
        f"\n{budget.amount:,} steps become {planned:,}: {short(config.agent)} takes "
        f"{amount(run.agent.rollout_steps, 'step')} in each of "
        f"{amount(run.agent.num_envs, 'environment')} at once."
        if budget.steps and planned > budget.amount and budget.left(run.population)
        else ""
    )


def print_result(seeds: list[int], result: dict[str, Any]) -> None:
    """A row for each seed and their mean, from ``Run.grade``."""
    heads = ("seed", "return", "optimum", "regret", "overestimation")
    returns, over = result["return_per_seed"], result["overestimation_per_seed"]
    regrets = result["regret_per_seed"] or [math.nan] * len(returns)
    optimum = number(result["optimum"])
    rows = [
        (str(seed), *_cells(optimum, *values))
        for seed, *values in zip(seeds, returns, regrets, over, strict=True)
    ]
    means = (
        sum(math.nan if x is None else x for x in column) / len(column)
        for column in (returns, regrets, over)
    )
    print_table(heads, [*rows, ("mean", *_cells(optimum, *means))], width=9)
    if result["return_ci95"]:
        low, high = result["return_ci95"]
        say(f"95% interval of the mean return over seeds: {number(low)} to {number(high)}")
    else:
        say(
            f"An interval over seeds needs {FEWEST_SEEDS} seeds or more (--seeds); "
            f"{len(returns)} {'is' if len(returns) == 1 else 'are'} too few."
        )


def number(value: float | None) -> str:
    """One decimal, or four significant digits for small numbers."""
    return figure(value, ",.1f" if not value or abs(value) >= 10 else "#.4g")


def _cells(optimum: str, value: float, regret: float, over: float | None) -> tuple[str, ...]:
    return number(value), optimum, figure(regret, ",.2%"), number(over)


def print_rule(rule: dict[str, Any]) -> None:
    """The numbers of the learned policies beside the exact ones, from ``Run.grade``."""
    from qfolio.report.rule import rows

    print_table(
        ("rule", "exact", "learned, mean", "farthest seed"),
        [
            (name, *("none" if value is None else figure(value, ".4f") for value in values))
            for name, *values in rows(rule)
        ],
    )


def print_findings(findings: "list[Finding]") -> None:
    """The findings on a price table, errors first, then warnings and notes."""
    severities = ("error", "warning", "note")
    for finding in sorted(findings, key=lambda finding: severities.index(finding.severity)):
        tell(f"{finding.severity}: {finding}. {finding.advice}".rstrip())
    if findings:
        counts = (sum(f.count for f in findings if f.severity == kind) for kind in severities)
        said = (amount(n, kind) for n, kind in zip(counts, severities, strict=True))
        say(f"{', '.join(said)}.")


def print_warnings(file: str, findings: "list[Finding]") -> None:
    """The warnings on a price table, each with the name of its file."""
    for finding in findings:
        if finding.severity == "warning":
            tell(f"Warning: {file}, {finding}. {finding.advice}".rstrip())


def print_prices(facts: dict[str, Any]) -> None:
    """The content of a price table, from ``prices.describe``."""
    say(
        f"{printable(facts['source'])}: {amount(facts['rows'], 'row')} of "
        f"{amount(facts['assets'], 'asset')}, "
        f"{facts['first']} to {facts['last']}, about {facts['periods_per_year']:g} a year."
    )
    if facts["features"]:
        say(f"Features: {printable(', '.join(facts['features']))}.")
    if facts["columns"]:
        say(f"Columns of the market: {printable(', '.join(facts['columns']))}.")
    if facts["note"]:
        say(f"Note: {facts['note']}")


def describe_search(work: "Tuning") -> str:
    """What a search trains, in a line, and each searched setting with its range and scale."""
    config, budget = work.config, work.config.budget
    seeds = amount(config.seeds, "seed")
    space = "\n".join(f"  {dim.name:<20} {dim}  ({dim.scale})" for dim in work.space)
    return (
        f"{short(config.agent).upper()} on {config.task} · preset {config.preset} · "
        f"{config.trials} trials × {seeds} · {budget.amount:,} {budget.unit} · "
        f"{config.device}\n{space}"
    )


def print_search(summary: dict[str, Any], verdicts: list[str]) -> None:
    """The best configuration beside the preset and the optimum, and the search's verdicts."""
    say("")
    for name, row in (("best", "return_per_seed"), ("preset", "preset_return_per_seed")):
        returns = [math.nan if x is None else x for x in summary[row]]
        mean = sum(returns) / len(returns)
        worst = figure(min(returns), ".2f")
        say(f"{name:<8}{figure(mean, '.2f'):>9}   worst seed {worst}")
    if summary["optimum"] is not None:
        seeds = amount(len(returns), "fresh seed")
        say(f"optimum {figure(summary['optimum'], '.2f'):>9}   ({seeds}, graded starts)")
    say("")
    for sentence in verdicts:
        tell(sentence)


def describe_backtest(backtest: "Backtest") -> str:
    """What a backtest trains and tests, in a line; its memory, if that is large."""
    from qfolio.portfolio.backtest import memory
    from qfolio.portfolio.prices.findings import day

    config, size = backtest.config, memory.needed(backtest.prices, backtest.config)
    large = f" It needs about {size / 2**30:.1f} GiB of memory, beside what training takes."
    folds, seeds = amount(len(backtest.folds), "fold"), amount(config.seeds, "seed")
    first = backtest.prices.dates[backtest.folds[0].decisions.start]
    return (
        f"{folds} ({day(first)} to {day(backtest.dates[-1])}) · "
        f"{amount(len(backtest.prices.assets), 'asset')} · {' and '.join(backtest.agents)} · "
        f"{seeds} · {config.cost * 1e4:g} bp · lag {config.lag} · {config.device}"
        + (f".{large}" if size > memory.MENTIONED else "")
    )


def print_assessment(assessment: "Assessment") -> None:
    """A row for each strategy, those of interest beside the benchmark, and the verdicts."""
    from qfolio.portfolio.backtest.statistics.assessment import JUDGED
    from qfolio.portfolio.backtest.statistics.verdict import bound_sentence, verdicts

    heads = ("a year, net", "growth", "vol.", "Sharpe", "drawdown", "turnover", "cost drag")
    shown = {
        "growth": ".2%",
        "volatility": ".1%",
        "sharpe": ".2f",
        "drawdown": ".1%",
        "turnover": ".1f",
        "cost_drag": ".2%",
    }
    entries = {
        name: strategy
        for name, strategy in assessment.strategies.items()
        if strategy.kind != "rebalancing" or name == assessment.rebalanced
    }
    print_table(
        heads,
        [(name, *_written(entry.measures, shown)) for name, entry in entries.items()],
        bold=[name for name, entry in entries.items() if entry.kind in JUDGED],
    )
    _print_relative(assessment)
    if bound := bound_sentence(assessment):
        tell(bound)
    for sentences in verdicts(assessment).values():
        for sentence in sentences:
            tell(sentence)


def _print_relative(assessment: "Assessment") -> None:
    """A row for agents, the user's own strategies and the best baseline, beside the benchmark."""
    from qfolio.portfolio.backtest.statistics.assessment import JUDGED

    first = f"to {assessment.reference}, a year"
    shown = {
        "active_return": "+.2%",
        "tracking_error": ".1%",
        "information_ratio": ".2f",
        "beta": ".2f",
        "up_capture": ".0%",
        "down_capture": ".0%",
        "active_share": ".0%",
    }
    print_table(
        (first, "active", "tracking", "IR", "beta", "up", "down", "share"),
        [
            (name, *_written(entry.relative, shown))
            for name, entry in assessment.strategies.items()
            if entry.relative and (entry.kind in JUDGED or name == assessment.best_baseline)
        ],
    )


def _written(measures: "Mapping[str, Measure]", formats: dict[str, str]) -> list[str]:
    """The means of some measures; a dash for what is not known."""
    return [figure(measures[key].mean, form) for key, form in formats.items()]


def describe_study(study: "Study") -> str:
    """Tables, variants and agents of a study, and why tables are left out."""
    config = study.config
    variants = amount(len(config.variants), "variant")
    tables = amount(len(config.tables), "table")
    left_out = (f"{name} is left out: {why}" for name, why in config.left_out.items())
    about = f"{tables} · {variants} · {' and '.join(config.agents)} · {config.device}"
    return "\n".join([about, *left_out])


def spell(variant: "Variant") -> str:
    """A variant of a study in words: lag 1, 10 bp."""
    return f"lag {variant.lag}, {variant.bps:g} bp"


def print_study(result: "Result") -> None:
    """A row for each table and each variant pooled, by agent, and the verdicts."""
    from qfolio.portfolio.study.verdict import decimal, looks_sentence

    main, *_ = result.variants
    for agent, pools in main.agents.items():
        rows: list[tuple[str, ...]] = []
        for name, known in pools.evidence.items():
            active = known.to_reference
            ratios = (active.information_ratio, active.t, known.to_rebalanced.t, known.sharpe)
            rows.append((name, *_growth(active), *map(decimal, ratios)))
        for entry in result.variants:
            found = entry.agents[agent]
            numbers = (found.to_reference.z, found.to_rebalanced.z, found.sharpe.difference)
            cells = (*_growth(found.to_reference), "", *map(decimal, numbers))
            rows.append((_pooled(entry.variant), *cells))
        heads = (agent, "a year", "95% interval", "IR", "t", "rebal.", "Sharpe")
        print_table(heads, rows, bold=[_pooled(main.variant)])
    say(
        "Growth is what exceeds the benchmark's, t against it (pooled: Stouffer's z), rebal. the t "
        "(or z) against its best rebalancing, Sharpe the ratio less that of the best baseline."
    )
    for sentences in result.verdicts.values():
        for sentence in sentences:
            tell(sentence)
    tell(looks_sentence(result))


def _pooled(variant: "Variant") -> str:
    return f"pooled, {spell(variant)}"


def _growth(entry: "Active | Pooled") -> tuple[str, str]:
    """An active growth and its interval."""
    growth, low, high = (figure(x, "+.1%") for x in (entry.growth, entry.low, entry.high))
    return growth, f"{low.removesuffix('%')} … {high}"


def print_allocation(
    allocation: "Allocation", standing: "Standing", trained: str | None, *, shares: bool
) -> None:
    """What is followed and what its backtest found, the trades, and their cost.

    trained: the date of the last row that the policy has learned from, if it has. shares: whether
    the prices are those of shares.
    """
    kind = standing.kind.capitalize()
    say(f"{kind}: {standing.agent}" + (f", trained on prices up to {trained}." if trained else "."))
    found = f"In its backtest: {standing.verdict or 'not finished, so there is no verdict.'}"
    if standing.worse:
        console.print(Text(f"WARNING. {printable(found)}", style="bold red"))
    else:
        tell(found)
    heads = ("asset", "price", "weight now", "target", "after", "trade, money", "trade, shares")
    rows: list[tuple[str, ...]] = []
    held, targets, after = allocation.held, allocation.weights, allocation.reached
    for i, asset in enumerate(allocation.assets):
        trade, price = allocation.trades[i], allocation.prices[i]
        if held[1 + i] or targets[1 + i] or trade:
            weights = (figure(float(x[1 + i]), ".2%") for x in (held, targets, after))
            money = figure(trade * price, "+,.2f")
            quoted, count = "–", "–"
            if shares:
                quoted = figure(price, ",.2f" if price >= 1 else ".4g")
                count = figure(trade, "+,.4g")
            rows.append((asset, quoted, *weights, money, count))
    cash = (figure(float(x[0]), ".2%") for x in (held, targets, after))
    print_table(heads, [*rows, ("cash", "", *cash, "", "")])
    kinds = ", ".join(f"{kind} {figure(money, ',.2f')}" for kind, money in allocation.costs.items())
    say(
        f"After the close of {allocation.date}: wealth {figure(allocation.wealth, ',.2f')}, "
        f"expected cost {figure(allocation.cost, ',.2f')}"
        f"{f' ({kinds})' if len(allocation.costs) > 1 else ''}, "
        f"cash left {figure(allocation.cash_after, ',.2f')}. "
        "Assets that are neither held nor wanted are not shown."
    )


def print_following(following: "Following") -> None:
    """A row for live, the benchmark and the backtest, and what is to be said of them."""
    forms = (".1%", ".1%", ".1%", ".2f", ".1%")
    print_table(
        ("net", "growth", "a year", "volatility", "Sharpe", "drawdown"),
        [
            (name, *map(figure, found.values() if found else [None] * len(forms), forms))
            for name, found in following.rows().items()
        ],
    )
    for sentence in following.sentences():
        if sentence.startswith("ALARM"):
            console.print(Text(printable(sentence), style="bold red"))
        else:
            tell(sentence)
