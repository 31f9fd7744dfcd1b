"""A run: a population in training, what it has reported so far, and its folder on disk.

The folder holds config.json (settings, written once), metrics.csv and evaluation.csv (appended),
checkpoint.safetensors (the whole training state, replaced as one), policy.safetensors (weights)
and, at the end, summary.json. The checkpoint is the truth: rows that are ahead of it are dropped
when a run is resumed, and then come again, the same to the last digit.
"""

import contextlib
import csv
import io
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

from qfolio.core import devices, settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import greedy, start_keys
from qfolio.core.files import (
    UNFINISHED,
    new_folder,
    read_json,
    read_tree,
    require_new,
    require_types,
    write_bytes,
    write_json,
    write_tree,
)
from qfolio.core.host import population_of
from qfolio.core.mdp import Agent, Optimum, Task
from qfolio.core.population import Population
from qfolio.core.registry import AGENTS, TASKS, find, name_of
from qfolio.core.statistics import mean_interval
from qfolio.core.training import Episodes
from qfolio.core.version import __version__
from qfolio.solvers.followed import FollowedOptimum

FORMAT = 4
"""Of the run folder; raised whenever an older folder can no longer be read."""

EVALUATIONS = 20
"""Points on the learning curve, about."""

CHECKPOINT_SECONDS = 10.0


@dataclass(frozen=True)
class Progress:
    """Where a run is, after each chunk."""

    episodes: int  # finished by the seed that has finished fewest
    done: int  # of the total
    total: int  # episodes, or environment steps, of each seed
    unit: str  # which of the two
    mean_return: float  # of the training episodes finished in this chunk, all seeds; NaN if none
    epsilon: float
    steps_per_second: float  # environment steps of all seeds
    seconds_left: float
    greedy_return: float | None  # mean over seeds, where the curve has a point here


class Run:
    """Seeds of one agent on one task; make it with ``Run.create``, ``Run.open`` or ``train``."""

    def __init__(
        self, task: Task, agent: Agent, config: dict[str, Any], folder: Path | None
    ) -> None:
        self.task, self.agent, self.config, self.folder = task, agent, config, folder
        first = config["seed"]
        self.population: Population = population_of(
            task, agent, range(first, first + config["seeds"])
        )
        self.metrics: list[dict[str, float]] = []
        self.evaluations: list[dict[str, float]] = []
        self.seconds_train = 0.0
        self.interrupted = False

    @classmethod
    def create(
        cls,
        task: Task,
        agent: Agent,
        *,
        episodes: int | None = None,
        steps: int | None = None,
        seeds: int = 1,
        seed: int = 0,
        preset: str | None = None,
        out: Path | str | None = None,
    ) -> "Run":
        """A run before its first step.

        episodes, steps: how far each seed is trained; one of the two. Steps are those of all its
        environments. out: a new or empty folder.
        """
        check_counts(episodes, seeds, seed, steps=steps)
        folder = None if out is None else Path(out)
        if folder is not None:
            require_new(folder)
        config = {
            "format": FORMAT,
            "version": __version__,
            "task": name_of(TASKS, task),
            "task_settings": settings.describe(task),
            "agent": name_of(AGENTS, agent),
            "preset": preset,
            "agent_settings": settings.describe(agent),
            "episodes": episodes,
            "steps": steps,
            "seeds": seeds,
            "seed": seed,
            **devices.circumstances("python", "jax", "equinox", "optax", "numpy"),
        }
        run = cls(task, agent, config, None)
        if folder is not None:
            with new_folder(folder) as run.folder:
                write_json(run.folder / "config.json", config)
                run._write_checkpoint()
            run.folder = folder
        return run

    @classmethod
    def open(
        cls, folder: Path | str, task: Task | None = None, agent: Agent | None = None
    ) -> "Run":
        """A run as its last checkpoint left it.

        task, agent: needed only where they are not among those that qfolio registers.
        """
        folder = Path(folder)
        config = read_config(folder)
        run = cls(
            task or configured_task(config), agent or configured_agent(config), config, folder
        )
        run._read_checkpoint()
        return run

    @property
    def episodes(self) -> int:
        """Finished by the seed that has finished fewest."""
        return self.population.episodes

    @property
    def budget(self) -> dict[str, int]:
        """How far each seed is trained: ``{"episodes": n}`` or ``{"steps": n}``."""
        given = {name: self.config[name] for name in ("episodes", "steps")}
        return {name: amount for name, amount in given.items() if amount is not None}

    def done(self, unit: str) -> int:
        """Episodes or environment steps of each seed so far."""
        if unit == "steps":
            return self.population.steps * self.agent.num_envs
        return self.episodes

    def train(
        self,
        episodes: int | None = None,
        listener: Callable[[Progress], None] | None = None,
        *,
        steps: int | None = None,
    ) -> None:
        """Trains until each seed has done ``episodes`` or ``steps`` (what was configured).

        A first Ctrl-C stops after the current chunk, sets ``interrupted`` and leaves a checkpoint.
        A loss that is not finite raises QfolioError; the last good checkpoint stays.
        """
        if episodes is None and steps is None:
            episodes, steps = self.config["episodes"], self.config["steps"]
        check_counts(episodes, self.config["seeds"], self.config["seed"], steps=steps)
        left = self.population.steps_left(episodes, steps=steps)
        if not left:
            return
        self.config |= {"episodes": episodes, "steps": steps}
        if self.folder is not None:
            write_json(self.folder / "config.json", self.config)
        if not self.population.steps:
            self.evaluations = []  # of a process that was killed before its first checkpoint
        self._tidy()
        # In steps since the very beginning, so that a resumed run has the same curve.
        every = (self.population.steps + left) / EVALUATIONS
        begun, saved = self.population.steps, perf_counter()
        start_seconds = self.seconds_train
        if not self.population.steps:
            self._evaluate()
        with interruptible() as stop:
            while True:
                points = self.population.steps // every
                records = self._advance(left)
                left = self.population.steps_left(episodes, steps=steps)
                greedy = None
                if self.population.steps // every > points or not left:
                    greedy = self._evaluate()
                if listener is not None:
                    rate = (self.population.steps - begun) / (self.seconds_train - start_seconds)
                    listener(self._progress(records, rate, left, greedy))
                self.interrupted = stop.is_set() and left > 0
                last = self.interrupted or not left
                if last or perf_counter() - saved > CHECKPOINT_SECONDS:
                    self._write_checkpoint()
                    saved = perf_counter()
                if last:
                    return

    def first_weights(self) -> Any:
        """The first seed's learned weights."""
        return jax.tree.map(lambda x: x[0], self.population.weights())

    def summary(self) -> dict[str, Any]:
        """Greedy returns on the fixed start states, the optimum on the same, and what it cost."""
        result = self.grade()
        steps = self.done("steps")
        summary = {
            "task": self.config["task"],
            "agent": self.config["agent"],
            "preset": self.config["preset"],
            "seeds": self.config["seeds"],
            "episodes": self.episodes,
            "env_steps": steps,
            "seconds_compile": round(self.population.seconds_compile, 3),
            "seconds_train": round(self.seconds_train, 3),
            "steps_per_second": round(
                steps * self.config["seeds"] / max(self.seconds_train, 1e-9), 1
            ),
            **result,
        }
        if self.folder is not None:
            write_json(self.folder / "summary.json", summary)
        return summary

    def grade(self, starts: int | None = None) -> dict[str, Any]:
        """Returns, optimum and regret of each seed's policy on the first fixed start states."""
        keys = start_keys(starts or self.population.starts)
        played = self.population.evaluate(keys)
        returns = played.returns.mean(1)
        solution = self.task.optimum()
        optimum, regret = None, None
        if solution is not None:
            optimum = float(solution.returns(keys).mean())
            regret = ((optimum - returns) / abs(optimum)).tolist()
        return {
            "return_mean": float(returns.mean()),
            "return_ci95": list(mean_interval(returns)) if len(returns) > 1 else None,
            "return_per_seed": returns.tolist(),
            "optimum": optimum,
            "regret_per_seed": regret,
            "overestimation_per_seed": [
                float(error) if np.isfinite(error) else None for error in played.overestimation
            ],
            "rule": self._rule(solution),
        }

    def _rule(self, solution: Optimum | None) -> dict[str, Any] | None:
        """What the seeds' policies do beside what is best, in tasks where few numbers say it."""
        if not isinstance(solution, FollowedOptimum):
            return None
        members = self.population.weights()
        play = jax.jit(lambda weights, state: greedy(self.task, self.agent, weights)(state))
        policies = (
            partial(play, jax.tree.map(lambda x, i=i: x[i], members))
            for i in range(len(self.population.seeds))
        )
        return {
            "exact": self.task.rule(solution.policy),
            "per_seed": [self.task.rule(policy) for policy in policies],
        }

    def _advance(self, steps: int) -> list[dict[str, float]]:
        before = self.population.member_episodes
        compiled = self.population.seconds_compile
        start = perf_counter()
        episodes = self.population.advance(steps)
        self.seconds_train += perf_counter() - start - (self.population.seconds_compile - compiled)
        records = list(_records(self.population.seeds, before, episodes))
        self.metrics += records
        self._append("metrics.csv", records)
        return records

    def _evaluate(self) -> float:
        greedy = self.population.evaluate(start_keys(self.population.curve_starts))
        records = [
            {
                "seed": seed,
                "episode": episode,
                "env_steps": self.done("steps"),
                "return": float(returns.mean()),
                "overestimation": float(overestimation),
            }
            for seed, episode, returns, overestimation in zip(
                self.population.seeds, self.population.member_episodes, *greedy, strict=True
            )
        ]
        self.evaluations += records
        self._append("evaluation.csv", records)
        return float(greedy.returns.mean())

    def _progress(
        self,
        records: list[dict[str, float]],
        rate: float,
        steps_left: int,
        greedy: float | None,
    ) -> Progress:
        ((unit, total),) = self.budget.items()
        returns = [record["return"] for record in records]
        return Progress(
            episodes=self.episodes,
            done=self.done(unit),
            total=total,
            unit=unit,
            mean_return=float(np.mean(returns)) if returns else math.nan,
            epsilon=records[-1].get("epsilon", math.nan) if records else math.nan,
            steps_per_second=rate * self.agent.num_envs * len(self.population.seeds),
            seconds_left=steps_left / rate,
            greedy_return=greedy,
        )

    def _append(self, name: str, rows: list[dict[str, float]]) -> None:
        if self.folder is not None and rows:
            with (self.folder / name).open("a", newline="") as file:
                file.write(_csv(rows, header=file.tell() == 0))

    def _write_checkpoint(self) -> None:
        if self.folder is None:
            return
        state = self._snapshot()
        weights = self.agent.weights(state["training"].agent)
        write_tree(self.folder / "policy.safetensors", weights)
        write_tree(self.folder / "checkpoint.safetensors", state)

    def _snapshot(self) -> dict[str, Any]:
        return {"training": self.population.fetch(), "seconds_train": np.array(self.seconds_train)}

    def _read_checkpoint(self) -> None:
        assert self.folder is not None
        state = read_tree(self.folder / "checkpoint.safetensors", self._snapshot())
        self.seconds_train = float(state["seconds_train"])
        self.population.restore(state["training"])
        self.metrics = self._read_rows("metrics.csv")
        self.evaluations = self._read_rows("evaluation.csv")

    def _read_rows(self, name: str) -> list[dict[str, float]]:
        """The rows up to the checkpoint; later ones, or one cut short by a crash, do not count."""
        assert self.folder is not None
        path = self.folder / name
        if not path.exists():
            return []
        episodes = dict(zip(self.population.seeds, self.population.member_episodes, strict=True))
        steps = self.done("steps")
        try:
            table = list(csv.DictReader(path.read_text(errors="replace").splitlines()))
        except csv.Error as error:
            raise QfolioError(f"{path} is damaged ({error}); restore or delete it.") from None
        rows = []
        for row in table:
            # A row that was cut short has too few numbers.
            with contextlib.suppress(TypeError, ValueError, KeyError, OverflowError):
                values = {key: _number(text) for key, text in row.items()}
                done = values["episode"] <= episodes[int(values["seed"])]
                if done and values.get("env_steps", 0) <= steps:
                    rows.append(values)
        return rows

    def _tidy(self) -> None:
        """Brings the folder back to the checkpoint, from which training goes on."""
        if self.folder is None:
            return
        for name, rows in (("metrics.csv", self.metrics), ("evaluation.csv", self.evaluations)):
            if rows:
                write_bytes(self.folder / name, _csv(rows, header=True).encode())
            else:
                (self.folder / name).unlink(missing_ok=True)
        for path in self.folder.glob(f".*{UNFINISHED}"):
            path.unlink()


def train(
    task: Task,
    agent: Agent,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    seeds: int = 1,
    seed: int = 0,
    out: Path | str | None = None,
    listener: Callable[[Progress], None] | None = None,
) -> Run:
    """Trains ``seeds`` agents side by side, from seeds ``seed``, ``seed + 1``, …

    episodes, steps: how far, each of them; one of the two. out: a new folder for the run; without
    it nothing is written. ``run.summary()`` grades it.
    """
    devices.configure()
    run = Run.create(task, agent, episodes=episodes, steps=steps, seeds=seeds, seed=seed, out=out)
    run.train(listener=listener)
    return run


def read_config(folder: Path) -> dict[str, Any]:
    """config.json, or QfolioError where ``folder`` is no run of this version."""
    path = folder / "config.json"
    if not path.is_file():
        raise QfolioError(f"{folder} is no run: it has no config.json.")
    config = read_json(path)
    if config.get("kind") == "backtest":
        raise QfolioError(
            f"{folder} is a backtest, not a training run; see qfolio backtest --help."
        )
    if config.get("format") != FORMAT:
        raise QfolioError(
            f"{folder} was written by qfolio {config.get('version', 'of an unknown version')} in "
            f"another format; this is {__version__}: use that version, or train anew."
        )
    wanted = {
        "task": str,
        "agent": str,
        "task_settings": dict,
        "agent_settings": dict,
        "episodes": int | None,
        "steps": int | None,
        "seeds": int,
        "seed": int,
        "device": str,
        "preset": str | None,
    }
    try:
        require_types(config, wanted)
        check_counts(config["episodes"], config["seeds"], config["seed"], steps=config["steps"])
    except QfolioError as error:
        raise QfolioError(f"{path} is damaged: {error}") from None
    return config


def check_counts(episodes: int | None, seeds: int, seed: int, *, steps: int | None = None) -> None:
    """Raises QfolioError where a run cannot have that many episodes or steps, or these seeds."""
    if (episodes is None) == (steps is None):
        raise QfolioError("give either episodes or steps, to say how far each agent is trained.")
    unit, amount = ("episodes", episodes) if steps is None else ("steps", steps)
    bounds = {
        unit: (amount, 1, 2**31 - 1),
        "seeds": (seeds, 1, 2**20),
        "seed": (seed, 0, 2**32 - seeds),
    }
    for name, (value, low, high) in bounds.items():
        assert value is not None
        if not low <= value <= high:
            raise QfolioError(f"{name} is {value}; it must be from {low} to {high}.")


def configured_task(config: dict[str, Any]) -> Task:
    """The task of a configuration; it imports no module that a stranger may have named there."""
    module, _, id = str(config["task_settings"].get("id", "")).rpartition(":")
    if module and module not in sys.modules:
        raise QfolioError(
            f"The run is on {id} of the module {module}, which only you may import: do so first, "
            "in Python, and then open the run (qfolio.Run.open)."
        )
    return settings.build(find("task", TASKS, config["task"]), config["task_settings"])


def configured_agent(config: dict[str, Any]) -> Agent:
    return settings.build(find("agent", AGENTS, config["agent"]), config["agent_settings"])


def _records(
    seeds: Sequence[int], before: Sequence[int], episodes: Episodes
) -> Iterator[dict[str, float]]:
    """A row for each finished episode, in the order in which they finished."""
    number = dict(zip(seeds, before, strict=True))
    columns = {"return": episodes.returns, **episodes.metrics}
    # By time first, so that the order does not depend on where chunks begin and end.
    for time, member, environment in np.argwhere(episodes.finished.swapaxes(0, 1)):
        seed = seeds[member]
        number[seed] += 1
        values = {name: float(x[member, time, environment]) for name, x in columns.items()}
        yield {"seed": seed, "episode": number[seed], **values}


def _csv(rows: list[dict[str, float]], header: bool) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _number(text: str) -> float:
    number = float(text)
    return int(number) if number.is_integer() and "." not in text else number


@contextlib.contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Turns the first Ctrl-C into an event; a second one interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, frame: Any) -> None:
        stop.set()
        signal.signal(signal.SIGINT, previous)

    previous = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, note)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)
