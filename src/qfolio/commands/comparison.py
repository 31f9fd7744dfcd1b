"""The command that trains several agents on one task and compares them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from qfolio.commands.arguments import (
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
    typed,
)
from qfolio.commands.parsing import Document, outcome
from qfolio.core import registry
from qfolio.core.errors import QfolioError
from qfolio.core.registry import again
from qfolio.core.text import amount, figure

if TYPE_CHECKING:
    from qfolio.experiments.budget import Budget
    from qfolio.experiments.comparison.run import Comparison, Entrant
    from qfolio.experiments.executor import Executor, Job
    from qfolio.experiments.fit import Listener


def compare(
    task: Positional[Name] = None,
    *,
    agents: Annotated[str | None, arg(metavar="NAME,NAME …", help_behavior_hint="")] = None,
    preset: Name = None,
    episodes: Count = None,
    steps: Count = None,
    seeds: Count = None,
    seed: Count = None,
    out: Folder = None,
    resume: Folder = None,
    on: str = "here",
    track: Trackers = (),
    trust: Modules = (),
) -> Document:
    """Train several agents on one task, with the same seeds, and write a report that compares them.

    Examples:
        qfolio compare --agents dqn,sac,ppo
        qfolio compare finite/cliff --agents q-learning,sarsa --seeds 5

    Args:
        task: Task to learn (default: pendulum).
        agents: Agents, separated by commas, each with an optional preset after a colon:
            dqn,pathwise or dqn:fast,dqn:report. Your own are module:Name or module:Name:PRESET.
        preset: Preset of agents that name none (default: fast if there is one, else the first).
        episodes: Training episodes of each seed (default: the presets' numbers).
        steps: Environment steps of each seed, instead of episodes.
        seeds: Number of seeds of each agent (default: 10).
        seed: First seed; the others follow it (default: 0).
        out: New folder for the comparison (default: one in runs/).
        resume: Folder of a comparison to resume.
        on: Where agents train: here, processes:4 (or another number), ray or ray://HOST:10001.
        track: Trackers that follow the training: tensorboard, wandb, trackio, or your own as
            module:Name (default: none).
        trust: Modules of your own code that the folder may name (default: none).
    """
    if resume is not None and (task is not None or not continues()):
        raise QfolioError(
            "--resume keeps the comparison's settings; add only --on, --track and --trust."
        )
    budget = budget_of(episodes, steps)
    prepare(trust)
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.progress import stop
    from qfolio.experiments.comparison.run import Comparison
    from qfolio.experiments.interrupts import resumable
    from qfolio.experiments.log import tracked

    executor, following = executor_of(on, out, resume), trackers(track)
    if resume is None:
        task = task or "pendulum"
        run = Comparison.create(
            _entrants(task, agents or "", preset, budget),
            seeds=10 if seeds is None else seeds,
            seed=seed or 0,
            command=typed(),
            note=""
            if budget is None
            else "The length of training was set by hand; learning-rate schedules and the like "
            "were tuned for the presets' own lengths.",
            out=out or fresh_name(task, "comparison"),
        )
    else:
        run = Comparison.open(resume)
    seeds = run.config.seeds
    console.say(
        f"{len(run.entrants)} agents on {run.config.task} · {amount(seeds, 'seed')} "
        f"each · {run.config.device}"
    )
    command = _resume(run, on)
    with resumable(command):
        with tracked(*following):
            _train(run, executor)
        if run.interrupted:
            stop(command)
        return outcome(run.folder, _finish(run))


def write_again(folder: Path) -> None:
    """Writes the report of a finished comparison."""
    from qfolio.experiments.comparison.run import Comparison
    from qfolio.report.comparison import write_comparison_report

    run = Comparison.open(folder)
    if not run.finished:
        raise QfolioError(f"The comparison is not finished; continue with {_resume(run)}.")
    write_comparison_report(folder, run.finish())


def _resume(run: "Comparison", on: str = "here") -> str:
    parts = [part for one in run.entrants.values() for part in (one.task, one.agent)]
    return again("qfolio compare --resume", run.folder, *parts, on=on)


def _entrants(
    task: str, agents: str, preset: str | None, budget: "Budget | None"
) -> "dict[str, Entrant]":
    """The agents that ``--agents`` lists, by name."""
    from qfolio.core import settings
    from qfolio.experiments import presets
    from qfolio.experiments.comparison.run import Entrant

    task_class = registry.find("task", task)
    entrants: dict[str, Entrant] = {}
    chosen: dict[tuple[str, str], str] = {}
    for entry in filter(None, map(str.strip, agents.split(","))):
        agent, own = registry.parted(entry)
        registry.find("agent", agent)
        known = presets.presets_of(task, agent)
        default = "fast" if "fast" in known else next(iter(known), "fast")
        name = own or preset or default
        if twin := chosen.get((agent, name)):
            raise QfolioError(
                f"--agents names {agent} with the preset {name} twice: {twin}, {entry}."
            )
        chosen[agent, name] = entry
        settled = presets.preset(name, task, agent)
        called = registry.entrant(entry)
        if called in entrants:  # classes of the same name, in different modules
            raise QfolioError(
                f"--agents names two agents that are called {called}; rename one of the classes."
            )
        entrants[called] = Entrant(
            settings.build(task_class, settled.task),
            settled.build(),
            name,
            budget or settled.budget,
        )
    return entrants


def _train(run: "Comparison", executor: "Executor") -> None:
    """Trains with a progress bar, and prints a line when an agent starts."""
    from qfolio.commands import console
    from qfolio.commands.progress import JobsProgress

    names, begun = list(run.entrants), set[str]()
    with console.bar("") as update:
        progress = JobsProgress(update)

        def listen(job: "Job", done: float, share: float) -> "list[Listener]":
            name = job.name.partition("/")[0]
            if name not in begun:
                begun.add(name)
                console.say(f"{names.index(name) + 1} of {len(names)}: {name}")
            return progress(job, done, share)

        run.run(listen, executor)


def _finish(run: "Comparison") -> Document:
    from qfolio.report.comparison import write_comparison_report

    content = run.finish()
    write_comparison_report(run.folder, content)
    _print_ranking(content)
    return content


def _print_ranking(content: dict[str, Any]) -> None:
    """Prints a row for each agent, best first, and the conclusion."""
    from qfolio.commands import console
    from qfolio.core.statistics import FEWEST_SEEDS
    from qfolio.experiments.comparison import conclusion
    from qfolio.experiments.comparison.ranking import HEADLINE

    ranking = content["ranking"]
    write = conclusion.writer_of(ranking)
    near = f"steps to {HEADLINE:.0%}"
    spread = "95% interval" if ranking["seeds"] >= FEWEST_SEEDS else "range of seeds"
    heads = ("agent", ranking["measure"], spread, "worst", near, "s a seed", "parameters")
    rows = []
    for name in ranking["order"]:
        measures, result = ranking["agents"][name], content["results"][name]
        final = measures["final"]
        few = min(final["per_seed"]), max(final["per_seed"])
        low, high = (write(end) for end in final["interval"] or few)
        within = next(x for x in measures["within"] if x["threshold"] == HEADLINE)
        cells = (
            write(final["iqm"]),
            f"{low.removesuffix('%')} … {high}",
            write(final["worst"]),
            figure(within["steps"], ",.0f"),
            conclusion.span(result["seconds_per_seed"]).removesuffix(" s"),
            f"{result['parameters']:,}",
        )
        rows.append((name, *cells))
    console.print_table(heads, rows)
    for sentence in [*content["conclusion"], *content["notes"]]:
        console.tell(sentence)
