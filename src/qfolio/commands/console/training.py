"""What training prints: a run before it starts, and the grades of its policies."""

import math
from typing import TYPE_CHECKING, Any

from qfolio.commands.console import print_table, say
from qfolio.core.statistics import FEWEST_SEEDS
from qfolio.core.text import amount, figure, four_digits
from qfolio.report.words import agent_name

if TYPE_CHECKING:
    from qfolio.experiments.budget import Budget
    from qfolio.experiments.run import Run


def describe_run(run: "Run", budget: "Budget") -> list[str]:
    """Lines with agent, task and seeds of a run, and its budget if rounding makes it larger."""
    config, planned = run.config, budget.planned(run.population)
    seeds = amount(config.seeds, "seed")
    lines = [
        f"{agent_name(config.agent)} on {config.task} · preset {config.preset or 'none'} · "
        f"{seeds} · {config.device}"
    ]
    if budget.steps and planned > budget.amount and budget.left(run.population):
        lines.append(
            f"{budget.amount:,} steps become {planned:,}: {agent_name(config.agent)} takes "
            f"{amount(run.agent.rollout_steps, 'step')} in each of "
            f"{amount(run.agent.num_envs, 'environment')} at once."
        )
    return lines


def print_result(seeds: list[int], result: dict[str, Any]) -> None:
    """A row for each seed and their mean, from ``Run.grade``."""
    heads = ("seed", "return", "optimum", "regret", "overestimation")
    returns, over = result["return_per_seed"], result["overestimation_per_seed"]
    regrets = result["regret_per_seed"] or [math.nan] * len(returns)
    optimum = four_digits(result["optimum"])
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
        ends = " to ".join(map(four_digits, result["return_ci95"]))
        say(f"95% interval of the mean return over seeds: {ends}")
    else:
        say(
            f"An interval over seeds needs a run with {FEWEST_SEEDS} seeds or more; "
            f"{len(returns)} {'is' if len(returns) == 1 else 'are'} too few."
        )


def _cells(optimum: str, value: float, regret: float, over: float | None) -> tuple[str, ...]:
    return four_digits(value), optimum, figure(regret, ",.2%"), four_digits(over)


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
