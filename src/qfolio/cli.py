"""The commands. Nothing below this file prints; jax is imported only by commands that compute."""

import contextlib
import datetime
import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import tyro
from tyro.conf import Positional, arg

from qfolio.errors import QfolioError

if TYPE_CHECKING:
    from qfolio.runs import Progress, Run

INTERRUPTED = 130  # what a shell expects after Ctrl-C


def train(
    task: Positional[str] = "pendulum",
    *,
    agent: str = "dqn",
    preset: str = "fast",
    episodes: int | None = None,
    seeds: int | None = None,
    seed: int = 0,
    out: Path | None = None,
    assignments: Annotated[tuple[str, ...], arg(name="set", metavar="NAME=VALUE …")] = (),
    resume: Path | None = None,
    compare: bool = True,
    live: bool = False,
) -> None:
    """Train agents on a task, grade them against the exact optimum and write a report.

    Args:
        task: What to learn: pendulum.
        agent: Which algorithm: dqn.
        preset: fast, best, or report (the run of the report that qfolio grew out of).
        episodes: Training episodes of each agent; the preset says how many otherwise.
        seeds: How many agents are trained side by side; the preset says otherwise.
        seed: The first agent's seed; the others' follow it.
        out: A new folder for the run; runs/… otherwise.
        assignments: Hyperparameters, for example --set discount=0.98 hidden=256,256
        resume: Go on with the run in this folder, up to --episodes if given.
        compare: Train two more agents with double DQN switched, for the report.
        live: Show an episode in a window now and then, while training.
    """
    from qfolio import devices

    devices.configure()
    from qfolio.runs import Run

    if resume is not None:
        if assignments or seeds is not None or out is not None:
            raise QfolioError(
                "--resume keeps the run's settings and seeds; leave --set, --seeds and --out out."
            )
        run = Run.open(resume)
        folder = resume
    else:
        folder = out or Path("runs") / f"{task}-{preset}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        run = _new_run(task, agent, preset, episodes, seeds, seed, folder, assignments)
    total = run.config["episodes"] if episodes is None else episodes
    _say(f"{_describe(run)} · {run.config['device']}")
    with _window(live, run) as show:
        _train(run, total, show)
    comparison = _comparison(run, folder) if compare else None
    _finish(run, folder, comparison)


def evaluate(
    folder: Positional[Path],
    *,
    episodes: int = 1024,
    as_json: Annotated[bool, arg(name="json")] = False,
) -> None:
    """Grade a run's greedy policies from fixed start states against the optimum.

    Args:
        folder: A run folder.
        episodes: Start states, the same for every run and every agent.
        as_json: Print JSON instead of a table.
    """
    if episodes < 1:
        raise QfolioError(f"--episodes is {episodes}; it must be at least 1.")
    from qfolio import devices

    devices.configure()
    from qfolio.runs import Run

    run = Run.open(folder)
    result = run.grade(episodes)
    if as_json:
        print(json.dumps({"folder": str(folder), "starts": episodes, **result}, indent=2))
    else:
        _print_result(run, result)


def watch(folder: Positional[Path], *, episodes: int = 3) -> None:
    """Show a run's first agent in a window; without a display, write episode.gif.

    Args:
        folder: A run folder.
        episodes: Episodes to show in the window.
    """
    from qfolio import devices
    from qfolio.watch import Window, has_display

    devices.configure()
    from qfolio.report.animation import pendulum_gif
    from qfolio.report.collect import EPISODE_START, greedy_episode
    from qfolio.runs import Run

    run = Run.open(folder)
    if has_display():
        window = Window(f"qfolio: {folder}")
        for start in range(EPISODE_START, EPISODE_START + episodes):
            episode = greedy_episode(run, run.task, start)
            if not window.show(episode.states, episode.torques):
                break
        window.close()
        return
    episode = greedy_episode(run, run.task)
    path = folder / "episode.gif"
    pendulum_gif(path, episode.states, episode.torques, episode.rewards)
    _say(f"There is no display here; the episode is in {path}")


def _new_run(
    task_name: str,
    agent_name: str,
    preset_name: str,
    episodes: int | None,
    seeds: int | None,
    seed: int,
    folder: Path,
    assignments: tuple[str, ...],
) -> "Run":
    from qfolio import presets, registry, settings
    from qfolio.runs import Run

    task_class = registry.find("task", registry.TASKS, task_name)
    registry.find("agent", registry.AGENTS, agent_name)
    preset = presets.preset(preset_name, task_name, agent_name)
    chosen = settings.parse(assignments)
    task_settings = {name: chosen.pop(name) for name in settings.names(task_class) & chosen.keys()}
    return Run.create(
        settings.build(task_class, task_settings),
        preset.build(**chosen),
        episodes=preset.episodes if episodes is None else episodes,
        seeds=preset.seeds if seeds is None else seeds,
        seed=seed,
        preset=preset_name,
        out=folder,
    )


def _train(run: "Run", episodes: int, show: Callable[["Run"], None] | None = None) -> None:
    """Trains with live progress; leaves the process after Ctrl-C."""
    import rich.progress

    optimum = _optimum(run)
    columns = ("episodes", "return", "greedy", "optimum", "epsilon", "steps/s", "left")
    _say("".join(f"{name:>11}" for name in columns))
    bar_columns = (
        rich.progress.BarColumn(bar_width=24),
        rich.progress.TextColumn("{task.description}"),
    )
    with rich.progress.Progress(*bar_columns, console=_console(), transient=True) as live:
        bar = live.add_task("compiling", total=episodes, completed=run.episodes)

        def note(now: "Progress") -> None:
            cells = [
                f"{now.episodes:,}",
                _number(now.mean_return),
                _number(now.greedy_return),
                _number(optimum),
                f"{now.epsilon:.2f}",
                f"{now.steps_per_second:,.0f}",
                str(datetime.timedelta(seconds=round(now.seconds_left))),
            ]
            left = cells[-1]
            live.update(
                bar,
                completed=min(now.episodes, episodes),
                description=f"{cells[0]} episodes  return {cells[1]}  ε {cells[4]}  "
                f"{cells[5]} steps/s  {left} left",
            )
            if now.greedy_return is not None:
                _say("".join(f"{cell:>11}" for cell in cells))
                if show is not None:
                    show(run)

        run.train(episodes, note)
    if run.interrupted:
        _say(
            f"Stopped after {run.episodes:,} episodes. "
            f"Go on with: qfolio train --resume {run.folder}"
        )
        sys.exit(INTERRUPTED)


def _optimum(run: "Run") -> float | None:
    from qfolio.evaluation import start_keys
    from qfolio.runs import CURVE_STARTS

    solution = run.task.optimum()
    if solution is None:
        return None
    with _console().status("Solving for the exact optimum (once; then it is on disk)"):
        return float(solution.returns(start_keys())[:CURVE_STARTS].mean())


def _comparison(run: "Run", folder: Path) -> "Run | None":
    """The same training with the one thing changed that the report contrasts; resumable too."""
    from qfolio.runs import Run

    variant = run.agent.contrast()
    if variant is None:
        return None
    label, agent = variant
    place = folder / "contrast"
    if (place / "checkpoint.safetensors").exists():
        contrast = Run.open(place)
    else:
        config = run.config
        contrast = Run.create(
            run.task,
            agent,
            episodes=config["episodes"],
            seeds=min(2, config["seeds"]),
            seed=config["seed"],
            preset=config["preset"],
            out=place,
        )
    if contrast.population.steps_left(run.config["episodes"]):
        _say(f"\nFor contrast, {label} ({contrast.config['seeds']} of the seeds):")
        _train(contrast, run.config["episodes"])
    return contrast


def _finish(run: "Run", folder: Path, comparison: "Run | None") -> None:
    from qfolio.report.collect import report_data
    from qfolio.report.page import write_report

    with _console().status("Grading on 1,024 start states and writing the report"):
        summary = run.summary()
        write_report(folder, report_data(run, summary, comparison, _command(run)))
    _print_result(run, summary)
    _say(
        f"{summary['env_steps'] * summary['seeds']:,} steps in {summary['seconds_train']:.1f} s of "
        f"training ({summary['steps_per_second']:,.0f} a second), "
        f"{summary['seconds_compile']:.1f} s of compiling."
    )
    _say(f"Report: {folder / 'report.html'}")


def _command(run: "Run") -> str:
    """The command line that repeats a run, and the one that goes on with it."""
    from qfolio import settings
    from qfolio.presets import preset

    config = run.config
    name = config["preset"] or "report"  # whose settings are the agent's defaults
    default = settings.describe(preset(name, config["task"], config["agent"]).build())
    default |= settings.describe(type(run.task)())
    chosen = config["agent_settings"] | config["task_settings"]
    changed = [
        f"{name}={','.join(map(str, value)) if isinstance(value, list) else value}"
        for name, value in chosen.items()
        if value != default[name]
    ]
    words = ["qfolio train", config["task"], "--agent", config["agent"], "--preset"]
    words += [name, "--episodes", config["episodes"], "--seeds", config["seeds"]]
    words += ["--seed", config["seed"], *(["--set", *changed] if changed else [])]
    return f"{' '.join(map(str, words))}\nqfolio train --resume {run.folder}"


def _print_result(run: "Run", result: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("seed", "return", "optimum", "regret", "overestimation"):
        table.add_column(name, justify="right", min_width=9)
    regrets = result["regret_per_seed"] or [math.nan] * len(result["return_per_seed"])
    optimum = _number(result["optimum"])
    per_seed = zip(
        run.population.seeds,
        result["return_per_seed"],
        regrets,
        result["overestimation_per_seed"],
        strict=True,
    )
    for seed, value, regret, over in per_seed:
        table.add_row(str(seed), _number(value), optimum, f"{regret:.2%}", _number(over))
    mean = (sum(column) / len(column) for column in (regrets, result["overestimation_per_seed"]))
    regret, over = mean
    table.add_section()
    table.add_row("mean", _number(result["return_mean"]), optimum, f"{regret:.2%}", _number(over))
    _console().print(table)
    if result["return_ci95"]:
        low, high = result["return_ci95"]
        _say(f"95 % interval of the mean return over seeds: {low:.1f} to {high:.1f}")
    else:
        _say("One seed has no interval; train several with --seeds.")


@contextlib.contextmanager
def _window(live: bool, run: "Run") -> Iterator[Callable[["Run"], None] | None]:
    """What ``--live`` shows: the first agent's episode in a window, at each point of the curve."""
    from qfolio.watch import Window, has_display

    if not live:
        yield None
        return
    if not has_display():
        raise QfolioError("--live needs a display; without one, watch DIR writes episode.gif.")
    from qfolio.report.collect import greedy_episode

    window = Window()

    def show(run: "Run") -> None:
        window.caption(f"qfolio: after {run.episodes:,} episodes")
        episode = greedy_episode(run, run.task)
        window.show(episode.states, episode.torques)

    try:
        yield show
    finally:
        window.close()


def _describe(run: "Run") -> str:
    config = run.config
    seeds = f"{config['seeds']} seed" + "s" * (config["seeds"] > 1)
    return f"{config['agent'].upper()} on {config['task']} · preset {config['preset']} · {seeds}"


def _number(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:,.1f}"


def _console() -> Any:
    from rich.console import Console

    return Console(stderr=False, highlight=False)


def _say(text: str) -> None:
    print(text, flush=True)


def main() -> NoReturn:
    """The entry point: errors meant for people become one sentence and exit code 2."""
    commands: dict[str, Callable[..., Any]] = {
        "train": train, "evaluate": evaluate, "watch": watch,
    }  # fmt: skip
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="qfolio",
            description="Reinforcement learning for portfolio optimization, "
            "graded against exact optima.",
        )
    except QfolioError as error:
        print(f"qfolio: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("qfolio: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    sys.exit(0)
