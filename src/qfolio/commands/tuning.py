"""The command that searches hyperparameters and reports which ones matter."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from qfolio.commands.arguments import (
    Assignments,
    Count,
    Folder,
    Modules,
    Name,
    Trackers,
    budget_of,
    continues,
    executor_of,
    fresh_name,
    prepare,
    training_command,
)
from qfolio.commands.parsing import Document, outcome
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError, needs
from qfolio.core.registry import again
from qfolio.core.text import amount

if TYPE_CHECKING:
    from qfolio.experiments.budget import Budget
    from qfolio.experiments.executor import Executor
    from qfolio.experiments.tuning.run import Tuning

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
    on: str = "here",
    track: Trackers = (),
    trust: Modules = (),
) -> Document:
    """Search an agent's hyperparameters and report which ones matter.

    Examples:
        qfolio tune --trials 32
        qfolio tune --agent sac --search learning_rate=1e-4..1e-2

    Args:
        task: Task to learn, any that qfolio train knows (default: pendulum).
        agent: Algorithm, or your own as module:Name (default: the first with presets for the task).
        preset: Preset to start from, which also gives the settings that are not searched
            (default: fast).
        trials: Total number of configurations to try (default: 64).
        seeds: Number of seeds of each configuration (default: 2).
        episodes: Training episodes of each seed (default: the preset's). learning_rate_steps
            changes in proportion, unless it is set.
        steps: Environment steps of each seed, instead of episodes.
        batch: Number of configurations to train at once (default: 16).
        search: Settings to search, for example --search learning_rate=1e-4..1e-2
            hidden=64,64|128,128 (default: those that usually matter, from a tenth to ten times the
            preset's value). A range is searched on a logarithmic scale if its ends are a factor of
            10 apart, or a factor of 10 apart in their distance from 1; log:, near-one: or linear:
            before the range chooses another scale, as in discount=linear:0.9..0.99.
        assignments: Settings to fix at values other than the preset's.
        out: New folder for the search (default: one in runs/).
        join: Folder of a search to continue, even while other processes work on it; --trials
            raises its total number of trials.
        on: Where configurations train: here, processes:4 (or another number), ray or
            ray://HOST:10001. A batch should have several configurations for each worker.
        track: Trackers that follow the training: tensorboard, wandb, trackio, or your own as
            module:Name (default: none).
        trust: Modules of your own code that the folder may name (default: none).
    """
    prepare(trust)
    tuning = _tuning()
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.console.tuning import describe_search
    from qfolio.commands.progress import print_batch, stop
    from qfolio.experiments import presets
    from qfolio.experiments.interrupts import resumable
    from qfolio.experiments.log import tracked

    executor, following = executor_of(on, out, join, "--join"), trackers(track)
    budget = budget_of(episodes, steps)
    if join is None:
        task, preset = task or "pendulum", "fast" if preset is None else preset
        agent = agent or presets.default_agent(task)
        work = _new(task, agent, preset, trials, seeds, budget, batch, search, assignments, out)
    elif task is not None or not continues("trials", "batch"):
        raise QfolioError(
            "--join keeps the settings of the search; add only --trials, --batch, --on, --track or "
            "--trust."
        )
    else:
        work = tuning.Tuning.open(join, trials=trials, batch=batch)
    resume = again("qfolio tune --join", work.folder, work.task, work.agent, on=on)
    console.say(*describe_search(work))
    print_batch()
    with (
        resumable(resume),
        console.bar("training a batch") as update,
        tracked(*following),
    ):
        work.run(print_batch, lambda done: update(completed=done), executor)
    if work.interrupted:
        stop(resume)
    if count := work.journal.in_hand():
        console.say(
            f"Other processes are training {amount(count, 'trial')}; "
            "the last to finish writes the report."
        )
        return {"folder": work.folder, "report": None}
    try:
        with resumable(resume):
            return outcome(work.folder, _conclude(work, resume, executor))
    except KeyboardInterrupt:
        stop(resume)


def write_again(folder: Path) -> None:
    """Writes the report of a finished search."""
    from qfolio.report.sweep import sweep
    from qfolio.report.tuning import write_tuning_report

    tuning = _tuning()
    work = tuning.Tuning.open(folder)
    resume = again("qfolio tune --join", folder, work.task, work.agent)
    if (summary := work.summary) is None:
        raise QfolioError(f"The search is not finished; continue with {resume}.")
    write_tuning_report(folder, sweep(work, summary, f"{command(work, summary['best'])}\n{resume}"))


def _tuning() -> Any:
    missing = 'qfolio tune needs Optuna to choose configurations: pip install "qfolio[tune]".'
    with needs("optuna", otherwise=missing):
        import qfolio.experiments.tuning.run
    return qfolio.experiments.tuning.run


def _new(
    task_name: str,
    agent_name: str,
    preset_name: str,
    trials: int | None,
    seeds: int | None,
    budget: "Budget | None",
    batch: int | None,
    ranges: tuple[str, ...],
    assignments: tuple[str, ...],
    out: Path | None,
) -> "Tuning":
    from qfolio.experiments import presets
    from qfolio.experiments.budget import SCHEDULES
    from qfolio.experiments.tuning import search
    from qfolio.experiments.tuning.run import Tuning

    task_class = registry.find("task", task_name)
    agent_class = registry.find("agent", agent_name)
    preset = presets.preset(preset_name, task_name, agent_name)
    task_settings, chosen = settings.divide(settings.parse(assignments), task_class, agent_class)
    space = search.parse(ranges, agent_class)
    if both := [dim.name for dim in space if dim.name in chosen]:
        raise QfolioError(f"--set and --search both name {both[0]}; name it in one of them.")
    budget = budget or preset.budget
    task = settings.build(task_class, {**preset.task, **task_settings})
    usual = preset.build(**chosen)
    share = budget.env_steps(task, usual) / preset.budget.env_steps(task, usual)
    lengths = {k: v * share for k, v in preset.settings.items() if k in SCHEDULES}
    scheduled = {k: round(v, 1) or v for k, v in lengths.items()}  # a length of 0 is refused
    agent = preset.build(**{**scheduled, **chosen})
    space = space or [dim for dim in search.usual(agent) if dim.name not in chosen]
    if both := [dim.name for dim in space if dim.name in settings.names(task_class)]:
        raise QfolioError(  # no command line could train what was found
            f"{agent_name} and {task_name} both have a setting {both[0]}, so that --set cannot "
            "tell whose it is; rename that of the task, or name others with --search."
        )
    return Tuning.create(
        task,
        agent,
        space,
        trials=64 if trials is None else trials,
        seeds=2 if seeds is None else seeds,
        budget=budget,
        batch=16 if batch is None else batch,
        fresh_seeds=preset.seeds,
        preset=preset_name,
        out=out or fresh_name("tune", task_name, registry.short(agent_name)),
    )


def _conclude(work: "Tuning", resume: str, executor: "Executor") -> Document:
    from qfolio.commands.console import say, working
    from qfolio.commands.console.tuning import print_search
    from qfolio.report.sweep import sweep
    from qfolio.report.tuning import write_tuning_report

    with working("Training the best configuration and the preset with fresh seeds"):
        summary = work.conclude(executor=executor)
    train = command(work, summary["best"])
    with working("Writing the report"):
        data = sweep(work, summary, f"{train}\n{resume}")
        write_tuning_report(work.folder, data)
    print_search(summary, data.verdicts)
    say("", "This trains the best configuration of the search:", train)
    return summary


def command(work: "Tuning", values: dict[str, Any]) -> str:
    """The command line that trains a configuration."""
    from qfolio.experiments.described import plain
    from qfolio.experiments.presets import preset

    config = work.config
    base = preset(config.preset, config.task, config.agent)
    default = base.described(type(work.task))
    chosen = settings.describe(work.configured(values)) | plain(config.task_settings)
    changed = {name: value for name, value in chosen.items() if value != default.get(name)}
    return training_command(config, config.preset, changed)
