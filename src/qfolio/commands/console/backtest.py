"""What a backtest prints: its extent before it starts, and its assessment."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from qfolio.commands.console import print_table, tell
from qfolio.core.text import amount, figure

if TYPE_CHECKING:
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.portfolio.backtest.statistics.assessment import Assessment
    from qfolio.portfolio.backtest.statistics.sampled import Measure


def describe_backtest(backtest: "Backtest") -> str:
    """What a backtest trains and tests, in a line; its memory, if that is large."""
    from qfolio.core.settings import called
    from qfolio.portfolio.backtest import memory
    from qfolio.portfolio.backtest.trading_terms import PROPORTIONAL
    from qfolio.portfolio.prices.findings import day

    config, size = backtest.config, memory.needed(backtest.prices, backtest.config)
    large = f" It needs about {size / 2**30:.1f} GiB of memory, beside what training takes."
    folds, seeds = amount(len(backtest.folds), "fold"), amount(config.seeds, "seed")
    first, last = backtest.dates[[0, -1]]
    kind = called(config.cost_model)[0]
    model = "" if kind == PROPORTIONAL else f" ({kind})"
    return (
        f"{folds} ({day(first)} to {day(last)}) · "
        f"{amount(len(backtest.prices.assets), 'asset')} · {' and '.join(backtest.agents)} · "
        f"{seeds} · {config.cost * 1e4:g} bp{model} · lag {config.lag} · {config.device}"
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

    first = f"against {assessment.reference}, a year"
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
