"""The command that changes a task after training, and compares ways to adapt."""

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
    continues,
    fresh_name,
    prepare,
    typed,
)
from qfolio.commands.parsing import Document, outcome
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError
from qfolio.core.registry import again
from qfolio.core.text import figure

if TYPE_CHECKING:
    from qfolio.experiments.continual import Plan

Changes = Annotated[tuple[str, ...], arg(metavar="NAME=VALUE …", help_behavior_hint="")]
Share = Annotated[float | None, arg(metavar="X", help_behavior_hint="")]


def continual(
    task: Positional[Name] = None,
    *,
    change: Changes = (),
    agent: Name = None,
    preset: Name = None,
    episodes: Count = None,
    seeds: Count = None,
    seed: Count = None,
    rate: Share = None,
    renewal: Share = None,
    epsilon: Share = None,
    assignments: Assignments = (),
    out: Folder = None,
    resume: Folder = None,
    track: Trackers = (),
    trust: Modules = (),
) -> Document:
    """Change a task after training and compare how fast each way to adapt recovers, and its cost.

    Examples:
        qfolio continual --change mass=2
        qfolio continual --change mass=2 --seeds 5

    Args:
        task: Task to learn (default: pendulum).
        change: Change of the task's numbers, for example --change mass=2.
        agent: Algorithm (default: the first that has presets for the task).
        preset: Preset of the agent (default: fast).
        episodes: Training episodes before the change, and after it (default: the preset's number).
        seeds: Number of seeds trained side by side (default: the preset's number).
        seed: First seed; the others follow it (default: 0).
        rate: Learning rate after the change, as a share of the initial one (default: 0.3).
        renewal: Length of a renewed agent's training, as a share of the first (default: 0.5).
        epsilon: Initial exploration rate ε of a renewed agent (default: 0.3).
        assignments: Settings of the agent, and of the task before the change.
        out: New folder for the report (default: one in runs/).
        resume: Folder to resume; finished trainings are not repeated.
        track: Trackers that follow the training: tensorboard, wandb, trackio, or your own as
            module:Name (default: none).
        trust: Modules of your own code that the folder may name (default: none).
    """
    if resume is not None and (task is not None or not continues()):
        raise QfolioError("--resume keeps the experiment's settings; add only --track and --trust.")
    prepare(trust)
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.progress import BarProgress, stop
    from qfolio.experiments import continual, presets
    from qfolio.experiments.interrupts import resumable
    from qfolio.experiments.log import tracked
    from qfolio.report.continual import verdict, write_continual_report

    following = trackers(track)
    if resume is None:
        task, preset = task or "pendulum", "fast" if preset is None else preset
        agent = agent or presets.default_agent(task)
        shares = {"rate": rate, "renewal": renewal, "epsilon": epsilon}
        options: dict[str, Any] = {k: x for k, x in shares.items() if x is not None}
        options |= {} if seed is None else {"seed": seed}
        plan = _plan(task, change, agent, preset, episodes, seeds, assignments, options)
        folder = out or fresh_name(task, "continual")
        continual.create(plan, folder, typed())
    else:
        folder, plan = resume, continual.read(resume).plan()
    command = again("qfolio continual --resume", folder, plan.task, plan.agent)
    with resumable(command):
        with console.bar("compiling") as update, tracked(*following):
            content = continual.compare(folder, lambda name: BarProgress(update, name))
        if content is None:
            stop(command)
        write_continual_report(folder, content)
    _print_ways(content)
    console.tell(verdict(content))
    return outcome(folder, content)


def write_again(folder: Path) -> None:
    """Writes the report of a finished experiment."""
    import msgspec

    from qfolio.experiments import continual
    from qfolio.report.continual import write_continual_report

    state = continual.read(folder)
    if set(continual.WAYS) - set(state.courses):
        plan = state.plan()
        resume = again("qfolio continual --resume", folder, plan.task, plan.agent)
        raise QfolioError(f"The experiment is not finished; continue with {resume}.")
    write_continual_report(folder, msgspec.to_builtins(state))


def _plan(
    task_name: str,
    change: tuple[str, ...],
    agent_name: str,
    preset_name: str,
    episodes: int | None,
    seeds: int | None,
    assignments: tuple[str, ...],
    options: dict[str, Any],
) -> "Plan":
    from qfolio.core.training import episode_steps
    from qfolio.experiments import presets
    from qfolio.experiments.continual import Plan

    task_class = registry.find("task", task_name)
    agent_class = registry.find("agent", agent_name)
    preset = presets.preset(preset_name, task_name, agent_name)
    if not change:
        raise QfolioError(
            "--change is missing: name the task's new numbers, for example --change mass=2."
        )
    changes = settings.parse(change, "--change", "mass=2")
    before, chosen = settings.divide(settings.parse(assignments), task_class, agent_class)
    before = {**preset.task, **before}
    made, learner = settings.build(task_class, before), preset.build(**chosen)
    if episodes is None:  # a preset may count steps
        episodes = -(-preset.budget.env_steps(made, learner) // episode_steps(made, learner))
    return Plan(
        task=made,
        changed=settings.build(task_class, {**before, **changes}),
        agent=learner,
        episodes=episodes,
        seeds=preset.seeds if seeds is None else seeds,
        **options,
    )


def _print_ways(content: dict[str, Any]) -> None:
    """Prints a row for each way to adapt."""
    from qfolio.commands import console
    from qfolio.core.statistics import interquartile_mean

    heads = ("way", "regret", "worst seed", "steps to recover", "recovered", "steps", "old world")
    rows = []
    for way, course in content["courses"].items():
        recovery = content["recovery"][way]
        reached = sum(step is not None for step in recovery["per_seed"])
        final, other = (float(interquartile_mean(course[name])) for name in ("final", "other"))
        middle = recovery["middle"]
        rows.append((
            way, figure(final, ".1%"), figure(max(course["final"]), ".1%"), figure(middle, ",.0f"),
            f"{reached} of {content['seeds']}", f"{course['steps'][-1]:,}", figure(other, ".1%"),
        ))  # fmt: skip
    console.print_table(heads, rows)
