"""What the commands print: live progress and tables."""

import datetime
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import rich.progress
from rich.console import Console
from rich.table import Table

from qfolio.training import episode_steps

if TYPE_CHECKING:
    from qfolio.runs import Progress, Run

console = Console(highlight=False)


def say(text: str) -> None:
    print(text, flush=True)


def describe(run: "Run") -> str:
    config = run.config
    seeds = f"{config['seeds']} seed" + "s" * (config["seeds"] > 1)
    preset = config["preset"] or "none"
    return (
        f"{config['agent'].upper()} on {config['task']} · preset {preset} · {seeds} · "
        f"{config['device']}"
    )


def train(
    run: "Run",
    episodes: int | None,
    optimum: float | None,
    show: Callable[["Run"], None] | None = None,
) -> None:
    """Trains with a line for each point of the curve and a bar between them.

    episodes: those of the configuration where None. optimum: on the curve's start states.
    show: called with the run at each point of the curve.
    """
    steps = episode_steps(run.task, run.agent)
    value = "return" if steps == run.task.horizon else f"return/{steps}"  # of shorter episodes
    columns = ("episodes", value, "greedy", "optimum", "epsilon", "steps/s", "left")
    say("".join(f"{name:>11}" for name in columns))
    bar_columns = (
        rich.progress.BarColumn(bar_width=24),
        rich.progress.TextColumn("{task.description}"),
    )
    total = run.config["episodes"] if episodes is None else episodes
    with rich.progress.Progress(
        *bar_columns, console=console, transient=True, disable=not console.is_terminal
    ) as live:
        bar = live.add_task("compiling", total=total, completed=run.episodes)

        def note(now: "Progress") -> None:
            done, value = f"{now.episodes:,}", number(now.mean_return)
            epsilon, rate = f"{now.epsilon:.2f}", f"{now.steps_per_second:,.0f}"
            left = str(datetime.timedelta(seconds=round(now.seconds_left)))
            status = f"{done} episodes  return {value}  ε {epsilon}  {rate} steps/s  {left} left"
            live.update(bar, completed=min(now.episodes, total), description=status)
            if now.greedy_return is not None:
                cells = (done, value, number(now.greedy_return), number(optimum))
                say("".join(f"{cell:>11}" for cell in (*cells, epsilon, rate, left)))
                if show is not None:
                    show(run)

        run.train(episodes, note)


def print_result(seeds: list[int], result: dict[str, Any]) -> None:
    """A row for each seed and their mean, from ``Run.grade``."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("seed", "return", "optimum", "regret", "overestimation"):
        table.add_column(name, justify="right", min_width=9)
    returns, over = result["return_per_seed"], result["overestimation_per_seed"]
    regrets = result["regret_per_seed"] or [math.nan] * len(returns)
    optimum = number(result["optimum"])
    for seed, *values in zip(seeds, returns, regrets, over, strict=True):
        table.add_row(str(seed), *_cells(optimum, *values))
    table.add_section()
    means = (
        sum(x or math.nan for x in column) / len(column) for column in (returns, regrets, over)
    )
    table.add_row("mean", *_cells(optimum, *means))
    console.print(table)
    if result["return_ci95"]:
        low, high = result["return_ci95"]
        say(f"95 % interval of the mean return over seeds: {low:.1f} to {high:.1f}")
    else:
        say("One seed has no interval; train several with --seeds.")


def number(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:,.1f}"


def _cells(optimum: str, value: float, regret: float, over: float | None) -> tuple[str, ...]:
    return number(value), optimum, f"{regret:.2%}", number(over)
