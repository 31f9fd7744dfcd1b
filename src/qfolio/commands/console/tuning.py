"""What a search prints: its space before it starts, and the best configuration."""

from typing import TYPE_CHECKING, Any

import numpy as np

from qfolio.commands.console import say, tell
from qfolio.core.settings import written
from qfolio.core.text import amount, figure, listed
from qfolio.experiments.tuning.search import own_value
from qfolio.report.words import agent_name

if TYPE_CHECKING:
    from qfolio.experiments.tuning.run import Tuning


def describe_search(work: "Tuning") -> list[str]:
    """A line with what a search trains, and one with the range and scale of each setting."""
    config, budget = work.config, work.config.budget
    seeds = amount(config.seeds, "seed")
    outside = [
        f"{dim.name}={written(value)}, which is outside {dim}"
        for dim in work.space
        if not dim.covers(value := own_value(work.agent, dim))
    ]
    lines = [
        f"{agent_name(config.agent)} on {config.task} · preset {config.preset} · "
        f"{config.trials} trials × {seeds} · {budget.amount:,} {budget.unit} · {config.device}",
        *(f"  {dim.name:<20} {dim}  ({dim.scale})" for dim in work.space),
    ]
    if outside:
        has = listed(outside)
        lines.append(f"The preset is no trial, because it has {has}; it is graded at the end.")
    return lines


def print_search(summary: dict[str, Any], verdicts: list[str]) -> None:
    """The best configuration beside the preset and the optimum, and the search's verdicts."""
    say("")
    for name, row in (("best", "return_per_seed"), ("preset", "preset_return_per_seed")):
        returns = np.array(summary[row], float)
        mean, worst = figure(returns.mean(), ".2f"), figure(returns.min(), ".2f")
        say(f"{name:<8}{mean:>9}   worst seed {worst}")
    if summary["optimum"] is not None:
        seeds = amount(len(returns), "fresh seed")
        say(f"optimum {figure(summary['optimum'], '.2f'):>9}   ({seeds}, graded starts)")
    say("")
    for sentence in verdicts:
        tell(sentence)
