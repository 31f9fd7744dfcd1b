"""The command that searches hyperparameters and shows how much each matters."""

import datetime
import math
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from qfolio.commands.arguments import Assignments, Count, Folder, Modules, Name, again
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError

if TYPE_CHECKING:
    from qfolio.experiments.tuning.run import Progress, Tuning

Ranges = Annotated[tuple[str, ...], arg(metavar="NAME=RANGE …", help_behavior_hint="")]


def tune(
    task: Positional[Name] = None,
    *,
    agent: Name = None,
    preset: Name = None,
    trials: Count = None,
    seeds: Count = None,
    episodes: Count = None,
    steps: Count = None,
    batch: Count = None,
    search: Ranges = (),
    assignments: Assignments = (),
    out: Folder = None,
    join: Folder = None,
    trust: Modules = (),
) -> None:
    """Search an agent's hyperparameters, many at once, and report how much each matters.

    Args:
        task: What to learn: pendulum (the default), or any other that qfolio train knows.
        agent: Which algorithm; the first that has presets for the task otherwise.
        preset: Where the search starts, fast otherwise; it gives what is not searched.
        trials: Configurations in all, 64 otherwise.
        seeds: Agents that each configuration is judged by, 2 otherwise.
        episodes: Training episodes of each agent; the preset says otherwise. Where it is changed,
            learning_rate_steps changes in proportion unless it is set.
        steps: Instead of episodes, steps of each agent's environments.
        batch: Configurations trained at once, 16 otherwise.
        search: What to search, for example --search learning_rate=1e-4..1e-2 hidden=64,64|128,128;
            otherwise the settings that usually matter, from a tenth to ten times the preset's.
            Scales are logarithmic where the ends are a factor of 10 apart, from 0 or from 1;
            discount=linear:0.9..0.99, log: and near-one: say otherwise.
        assignments: Settings that are not searched but differ from the preset's.
        out: A new folder for the search; runs/… otherwise.
        join: Work on the search in this folder, beside other processes or after them; with
            --trials, up to a new number of trials.
        trust: Modules of your own code that the folder may name (default: none).
    """
    from qfolio.core import devices

    devices.configure()
    registry.trust(trust)
    tuning = _tuning()
    from qfolio.commands import console
    from qfolio.commands.progress import stop
    from qfolio.experiments import presets

    given: list[Any] = [task, agent, preset, seeds, episodes, steps, out]
    asked = {name: n for name, n in (("episodes", episodes), ("steps", steps)) if n is not None}
    if len(asked) > 1:
        raise QfolioError("--episodes and --steps both say how far to train; give one of them.")
    if join is None:
        task = task or "pendulum"
        agent = agent or presets.default_agent(task)
        work = _new(task, agent, preset or "fast", trials, seeds, asked, batch, search,
                    assignments, out)  # fmt: skip
    elif search or assignments or any(x is not None for x in given):
        raise QfolioError(
            "--join keeps what the search was started with; add only --trials or --batch."
        )
    else:
        work = tuning.Tuning.open(join, trials=trials, batch=batch)
    console.say(_describe(work))
    _run(work)
    if work.interrupted:
        stop(_join(work))
    if count := work.journal.in_hand():
        console.say(
            f"Other processes have {count} trials in hand; the last to finish writes the report."
        )
        return
    _conclude(work)


def _tuning() -> Any:
    try:
        import qfolio.experiments.tuning.run
    except ModuleNotFoundError as error:
        if error.name != "optuna":
            raise
        raise QfolioError(
            "qfolio tune chooses configurations with Optuna; pip install 'qfolio[tune]'."
        ) from None
    return qfolio.experiments.tuning.run


def _new(
    task_name: str,
    agent_name: str,
    preset_name: str,
    trials: int | None,
    seeds: int | None,
    asked: dict[str, int],
    batch: int | None,
    ranges: tuple[str, ...],
    assignments: tuple[str, ...],
    out: Path | None,
) -> "Tuning":
    from qfolio.experiments import presets
    from qfolio.experiments.budget import Budget
    from qfolio.experiments.tuning import search
    from qfolio.experiments.tuning.run import Tuning

    task_class = registry.find("task", task_name)
    agent_class = registry.find("agent", agent_name)
    preset = presets.preset(preset_name, task_name, agent_name)
    chosen = settings.parse(assignments)
    task_settings = {name: chosen.pop(name) for name in settings.names(task_class) & chosen.keys()}
    space = search.parse(ranges, agent_class)
    if both := [dim.name for dim in space if dim.name in chosen]:
        raise QfolioError(f"{both[0]} is both set and searched; name it in one of the two.")
    budget = Budget(**asked) if asked else preset.budget
    unit, amount = budget.unit, budget.amount
    scheduled: dict[str, Any] = {}
    if "learning_rate_steps" in preset.settings and unit == preset.budget.unit:
        updates = preset.settings["learning_rate_steps"] * amount / preset.budget.amount
        scheduled = {"learning_rate_steps": round(updates, 1)}
    agent = preset.build(**{**scheduled, **chosen})
    now = f"{datetime.datetime.now():%Y%m%d-%H%M%S}"
    name = f"tune-{re.sub('[/:]', '-', task_name)}-{registry.short(agent_name)}-{now}"
    return Tuning.create(
        settings.build(task_class, {**preset.task, **task_settings}),
        agent,
        space or [dim for dim in search.usual(agent) if dim.name not in chosen],
        trials=64 if trials is None else trials,
        seeds=2 if seeds is None else seeds,
        **budget.to_json(),
        batch=16 if batch is None else batch,
        fresh_seeds=preset.seeds,
        preset=preset_name,
        out=out or Path("runs") / name,
    )


def _join(work: "Tuning") -> str:
    return again("qfolio tune --join", work.folder, work.task, work.agent)


def _describe(work: "Tuning") -> str:
    config = work.config
    seeds = f"{config['seeds']} seed" + "s" * (config["seeds"] > 1)
    space = "\n".join(f"  {dim.name:<20} {dim}  ({dim.scale})" for dim in work.space)
    agent = registry.short(config["agent"]).upper()
    return (
        f"{agent} on {config['task']} · preset {config['preset']} · "
        f"{config['trials']} trials × {seeds} · {far(work)} · "
        f"{config['device']}\n{space}"
    )


def far(work: "Tuning") -> str:
    """How far each agent is trained, in words."""
    ((unit, amount),) = work.budget.items()
    return f"{amount:,} {unit}"


def _run(work: "Tuning") -> None:
    """Trains with a line for each batch and a bar within it."""
    from qfolio.commands.console import bar, number, say

    say("".join(f"{name:>11}" for name in ("trials", "diverged", "best", "preset", "an hour")))
    with bar("training a batch") as update:

        def note(now: "Progress") -> None:
            best, own = (number(x and x.value) for x in (now.best, now.preset))
            rate = f"{3600 * now.trials / now.seconds:,.0f}"
            cells = (f"{now.done}/{now.total}", str(now.diverged), best, own, rate)
            say("".join(f"{cell:>11}" for cell in cells))

        work.run(note, lambda done: update(completed=done))


def _conclude(work: "Tuning") -> None:
    from qfolio.commands.console import console, say
    from qfolio.report.tuning import sweep, write_tuning_report

    with console.status("Training the best and the preset with fresh seeds, to grade them"):
        summary = work.conclude()
    with console.status("Writing the report"):
        data = sweep(work, summary, command(work, summary["best"]))
        write_tuning_report(work.folder, data)
    say("")
    for name, row in (("best", "return_per_seed"), ("preset", "preset_return_per_seed")):
        returns = [math.nan if x is None else x for x in summary[row]]
        mean = sum(returns) / len(returns)
        say(f"{name:<8}{mean:>9.2f}   worst seed {min(returns):.2f}")
    if summary["optimum"] is not None:
        say(f"optimum {summary['optimum']:>9.2f}   ({len(returns)} fresh seeds, graded starts)")
    say("")
    for sentence in data.verdicts:
        say(sentence)
    say(f"\nTrain the best with:\n{data.command.splitlines()[0]}")
    say(f"Report: {work.folder / 'report.html'}")


def command(work: "Tuning", values: dict[str, Any]) -> str:
    """The command line that trains a configuration, and the one that goes on with the search."""
    from qfolio.experiments.presets import preset
    from qfolio.experiments.tuning.search import written

    config = work.config
    base = preset(config["preset"], config["task"], config["agent"])
    default = settings.describe(base.build()) | settings.describe(type(work.task)(**base.task))
    chosen = settings.describe(work.configured(values)) | config["task_settings"]
    changed = {name: value for name, value in chosen.items() if value != default[name]}
    words = ["qfolio train", config["task"], "--agent", config["agent"], "--preset"]
    ((unit, amount),) = work.budget.items()
    words += [config["preset"], f"--{unit}", str(amount)]
    words += ["--set", *map(shlex.quote, written(changed))] if changed else []
    return f"{' '.join(words)}\n{_join(work)}"
