"""The commands that train agents on a task, grade them and show them."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

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
from qfolio.core.errors import QfolioError, require_whole
from qfolio.core.registry import again
from qfolio.core.text import amount, listed
from qfolio.experiments.budget import MOST_STARTS
from qfolio.experiments.events import CONTRAST

if TYPE_CHECKING:
    from qfolio.experiments.budget import Budget
    from qfolio.experiments.executor import Executor
    from qfolio.experiments.run import Run


def train(
    task: Positional[Name] = None,
    *,
    agent: Name = None,
    preset: Name = None,
    episodes: Count = None,
    steps: Count = None,
    seeds: Count = None,
    seed: Count = None,
    out: Folder = None,
    assignments: Assignments = (),
    resume: Folder = None,
    on: str = "here",
    track: Trackers = (),
    trust: Modules = (),
    compare: bool = True,
    live: bool = False,
) -> Document:
    """Train agents on a task, grade them against the exact optimum and write a report.

    Examples:
        qfolio train
        qfolio train catch --seeds 5
        qfolio train pendulum/grid --agent q-learning --set discount=0.98

    Args:
        task: Task to learn (default: pendulum): pendulum, pendulum/grid, pendulum/hidden or catch;
            a finite process, finite/cliff, finite/frozen-lake or finite/random; a market with a
            known optimum, {markets}; an environment of Gymnasium by its ID, such as
            gym:CartPole-v1; or your own as module:Name.
        agent: Algorithm (default: the first that has presets for the task): dqn, reinforce, a2c,
            ppo, ddpg, td3, sac or mbpo; for numbered states q-learning, sarsa, expected-sarsa,
            double-q or dyna-q; for markets pathwise; or your own as module:Name.
        preset: Preset of the agent (default: fast). DQN on the pendulum also has best, categorical,
            rainbow and report (the settings of the report that qfolio grew out of).
        episodes: Training episodes of each seed, or more: seeds train side by side until each has
            as many (default: the preset's number). Episodes of DQN's presets fast and best are
            short: 28 and 40 steps.
        steps: Environment steps of each seed, instead of episodes.
        seeds: Number of seeds trained side by side (default: the preset's number).
        seed: First seed; the others follow it (default: 0).
        out: New folder for the run (default: one in runs/).
        assignments: Settings of agent and task, for example --set discount=0.98 hidden=256,256;
            every report lists them, and docs/algorithms/dqn.md explains those of DQN.
        resume: Folder of a run to resume; --episodes or --steps may set a new total.
        on: Where seeds train: here, processes:4 (or another number), ray or ray://HOST:10001.
        track: Trackers that follow the training: tensorboard, wandb, trackio, or your own as
            module:Name (default: none).
        trust: Modules of your own code that the folder may name (default: none).
        compare: For DQN, also train up to two seeds with one setting changed, for the report:
            double DQN, or in markets learning from one action at a time instead of all at once. If
            that fails, the report does without.
        live: Show an episode of the pendulum in a window at each point of the learning curve.
    """
    prepare(trust)
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.console.training import describe_run
    from qfolio.commands.progress import stop
    from qfolio.experiments import presets
    from qfolio.experiments.interrupts import resumable
    from qfolio.experiments.lasting import lasting
    from qfolio.experiments.log import tracked
    from qfolio.experiments.run import Run
    from qfolio.report.contrast import contrast_of

    following = trackers(track)
    budget = budget_of(episodes, steps)
    if live and on != "here":
        raise QfolioError("--live shows a training in this process; leave out --on, or --live.")
    executor = executor_of(on, out, resume)
    if live and task is not None:
        _require_seen(task)
    with _window(live) as show:
        if resume is None:
            task, preset = task or "pendulum", "fast" if preset is None else preset
            agent = agent or presets.default_agent(task)
            place = out or fresh_name(task, registry.short(agent), preset)
            chosen = settings.parse(assignments)
            run = _new_run(task, agent, preset, budget, seeds, seed or 0, place, chosen)
        elif task is not None or not continues("episodes", "steps", "compare", "live"):
            raise QfolioError(
                "--resume keeps the run's settings; add only --episodes or --steps, --on, --track, "
                "--trust, --no-compare or --live."
            )
        else:
            run = Run.open(resume)
            if live:
                _require_seen(run.config.task)
        budget = budget or run.budget
        console.say(*describe_run(run, budget))
        if not budget.left(run.population):
            trained = amount(run.done(budget.unit), budget.unit.removesuffix("s"))
            console.say(
                f"Nothing is left to train: each seed has had {trained} already; set a larger "
                f"total with --{budget.unit}."
            )
        command = _resume(run, on, compare or contrast_of(run.agent) is None)
        with resumable(command), tracked(*following):
            _train(run, budget, executor, show)
    if run.interrupted:
        stop(command)
    with resumable(command):
        contrast = None
        if compare:
            try:
                with lasting():  # whose end is not that of the run
                    contrast = _contrast(run, executor)
            except QfolioError as error:  # the grade and the report do not need it
                console.say(f"The training for contrast is left out. {error}")
        if contrast is not None and contrast.interrupted:
            stop(command)
        return _finish(run, contrast)


train.__doc__ = (train.__doc__ or "").replace("{markets}", listed(registry.of("market"), "or"))


def evaluate(
    folder: Positional[Path],
    *,
    episodes: Count = None,
    trust: Modules = (),
) -> Document:
    """Grade a run's greedy policies from fixed start states against the optimum.

    Examples:
        qfolio evaluate runs/mine --episodes 100
        qfolio evaluate runs/mine --json

    Args:
        folder: Folder of a run.
        episodes: Number of start states, the same for every run and agent (default: 1,024, or 100
            for environments of Gymnasium).
        trust: Modules of your own code that the folder may name (default: none).
    """
    if episodes is not None:
        require_whole("--episodes", episodes, 1, MOST_STARTS)
    prepare(trust)
    from qfolio.commands.console.training import print_result
    from qfolio.experiments.run import Run

    run = Run.open(folder)
    episodes = episodes or run.population.starts
    result = run.grade(episodes)
    print_result(run.population.seeds, result)
    return {"folder": folder, "starts": episodes, **result}


def watch(folder: Positional[Path], *, episodes: int = 3, trust: Modules = ()) -> None:
    """Show the first agent of a run on the pendulum in a window, or write episode.gif.

    The file is written where there is no display.

    Examples:
        qfolio watch runs/mine

    Args:
        folder: Folder of a run.
        episodes: Episodes to show in the window.
        trust: Modules of your own code that the folder may name (default: none).
    """
    from qfolio.commands.console import say
    from qfolio.commands.window import Window, has_display

    require_whole("--episodes", episodes, 1, MOST_STARTS)
    prepare(trust)
    from qfolio.core.evaluation import STARTS
    from qfolio.core.files import write_bytes
    from qfolio.experiments.run import Run
    from qfolio.report.animation import pendulum_gif
    from qfolio.report.collect import EPISODE_START, pendulum_episode
    from qfolio.tasks.pendulum import Pendulum

    run = Run.open(folder)
    if not isinstance(run.task, Pendulum):
        raise QfolioError(
            f"{folder} is a run on {run.config.task}; only the pendulum can be shown."
        )
    if has_display():
        window = Window(f"qfolio: {folder}")
        for number in range(episodes):
            episode = pendulum_episode(run, run.task, (EPISODE_START + number) % STARTS)
            if not window.show(episode.states, episode.torques):
                break
        window.close()
        return
    episode = pendulum_episode(run, run.task)
    path = folder / "episode.gif"
    write_bytes(path, pendulum_gif(episode.states, episode.torques, episode.rewards))
    say(f"There is no display here; the episode is in {path}")


def _new_run(
    task_name: str,
    agent_name: str,
    preset_name: str,
    budget: "Budget | None",
    seeds: int | None,
    seed: int,
    folder: Path,
    chosen: dict[str, str],
) -> "Run":
    from qfolio.experiments import presets
    from qfolio.experiments.run import Run

    task_class = registry.find("task", task_name)
    agent_class = registry.find("agent", agent_name)
    preset = presets.preset(preset_name, task_name, agent_name)
    task_settings, agent_settings = settings.divide(chosen, task_class, agent_class)
    return Run.create(
        settings.build(task_class, {**preset.task, **task_settings}),
        preset.build(**agent_settings),
        budget=budget or preset.budget,
        seeds=preset.seeds if seeds is None else seeds,
        seed=seed,
        preset=preset_name,
        out=folder,
    )


def _train(
    run: "Run",
    budget: "Budget",
    executor: "Executor",
    show: Callable[["Run"], None] | None = None,
) -> None:
    """Trains with live progress; in this process, the lines also show the optimum."""
    from qfolio.commands import console
    from qfolio.commands.progress import JobsProgress, RunProgress
    from qfolio.experiments.executor import Here
    from qfolio.experiments.grading import curve_optimum

    # A run that other processes began goes on in their groups of seeds, wherever it is resumed.
    if not isinstance(executor, Here) or run.groups.begun:
        with console.bar("") as update:
            run.train(budget, executor=executor, listen=JobsProgress(update))
        return

    optimum = None
    if run.task.optimum() is not None:
        with console.working("Finding the exact optimum"):
            optimum = curve_optimum(run.population)
    with console.bar("compiling", budget.amount) as update:
        run.train(budget, [RunProgress(run, optimum, update, show)])


def _contrast(run: "Run", executor: "Executor") -> "Run | None":
    """The training of the report's variant, with one setting changed; resumable, too."""
    from qfolio.commands.console import say
    from qfolio.experiments.run import Run
    from qfolio.experiments.run_folder import CHECKPOINT
    from qfolio.report.contrast import contrast_of

    variant = contrast_of(run.agent)
    if variant is None:
        return None
    assert run.folder is not None
    place = run.folder / CONTRAST
    if (place / CHECKPOINT).exists():
        contrast = Run.open(place)
    else:
        config = run.config
        contrast = Run.create(
            run.task,
            variant.variant,
            budget=run.budget,
            seeds=min(2, config.seeds),
            seed=config.seed,
            preset=config.preset,
            out=place,
        )
    if run.budget.left(contrast.population):
        say("", f"For contrast, {variant.variant_name} ({contrast.config.seeds} of the seeds):")
        if contrast.groups.begun:  # with the budget that the run had then
            _train(contrast, contrast.budget, executor)
        if not contrast.interrupted:
            _train(contrast, run.budget, executor)
    return contrast


def write_again(folder: Path) -> None:
    """Writes the report of a finished run, from the grades in its summary."""
    from qfolio.core.files import read_json
    from qfolio.experiments.run import Run
    from qfolio.experiments.run_folder import CHECKPOINT
    from qfolio.report.collect import report_data
    from qfolio.report.training import write_report

    run, place = Run.open(folder), folder / CONTRAST
    contrast = Run.open(place) if (place / CHECKPOINT).exists() else None
    if contrast is not None and run.budget.left(contrast.population):
        contrast = None  # it was left out
    path = folder / "summary.json"
    summary = read_json(path) if path.is_file() else {}
    if summary.get("episodes") != run.episodes:
        raise QfolioError(f"The run is not finished; continue with {_resume(run)}.")
    write_report(folder, report_data(run, summary, contrast, _command(run, contrast)))


def _finish(run: "Run", contrast: "Run | None") -> Document:
    from qfolio.commands.console import say, working
    from qfolio.commands.console.training import print_result, print_rule
    from qfolio.experiments.budget import unlearned
    from qfolio.report.collect import report_data
    from qfolio.report.training import write_report

    folder, starts = run.folder, run.population.starts
    assert folder is not None
    with working(f"Grading on {starts:,} start states and writing the report"):
        summary = run.summary()
        write_report(folder, report_data(run, summary, contrast, _command(run, contrast)))
    print_result(run.population.seeds, summary)
    if summary["rule"]:
        print_rule(summary["rule"])
    if why := unlearned(run.agent, summary["env_steps"]):
        say(f"The agent {why}")
    say(
        f"{summary['env_steps'] * summary['seeds']:,} steps in {summary['seconds_train']:.1f} s of "
        f"training ({summary['steps_per_second']:,.0f} a second), "
        f"{summary['seconds_compile']:.1f} s of compiling."
    )
    return outcome(folder, summary)


def _resume(run: "Run", on: str = "here", compare: bool = True) -> str:
    assert run.folder is not None
    command = "qfolio train --resume" if compare else "qfolio train --no-compare --resume"
    return again(command, run.folder, run.task, run.agent, on=on)


def _command(run: "Run", contrast: "Run | None") -> str:
    """The command line that repeats a run, and the one that resumes it."""
    from qfolio.experiments.presets import changes
    from qfolio.report.contrast import contrast_of

    config = run.config
    compare = contrast is not None or contrast_of(run.agent) is None
    resume = _resume(run, compare=compare)
    found = changes(config, type(run.task))
    if found is None:
        return resume
    preset, differing = found
    changed = {name: value for name, (value, _) in differing.items()}
    more = ["--seeds", str(config.seeds), "--seed", str(config.seed)]
    more += [] if compare else ["--no-compare"]
    return f"{training_command(config, preset, changed, *more)}\n{resume}"


def _require_seen(task: str) -> None:
    if task != "pendulum":
        raise QfolioError(f"--live shows the pendulum; there is nothing to see of {task}.")


@contextlib.contextmanager
def _window(live: bool) -> Iterator[Callable[["Run"], None] | None]:
    """The window of ``--live``, with the first agent's episode at each point of the curve."""
    from qfolio.commands.window import Window, has_display

    if not live:
        yield None
        return
    if not has_display():
        raise QfolioError("--live needs a display; without one, qfolio watch DIR writes a GIF.")
    from qfolio.report.collect import pendulum_episode
    from qfolio.tasks.pendulum import Pendulum

    window = Window()

    def show(run: "Run") -> None:
        window.caption(f"qfolio: after {run.episodes:,} episodes")
        assert isinstance(run.task, Pendulum)
        episode = pendulum_episode(run, run.task)
        window.show(episode.states, episode.torques)

    try:
        yield show
    finally:
        window.close()
