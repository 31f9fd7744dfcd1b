"""A run: the training of one agent's seeds on one task, and its records."""

import contextlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import msgspec
import numpy as np

from qfolio.core import devices
from qfolio.core.errors import require_type
from qfolio.core.evaluation import start_keys
from qfolio.core.files import locked, new_folder, path_of, require_new
from qfolio.core.host import population_of
from qfolio.core.mdp import Agent, Task
from qfolio.core.notebook import card, number
from qfolio.core.population import Population
from qfolio.core.registry import short
from qfolio.core.text import amount
from qfolio.experiments.budget import Budget
from qfolio.experiments.described import agent_of, describe, task_of
from qfolio.experiments.executor import Executor, Here, ListenToJob, carry_out
from qfolio.experiments.fit import Listener, Row, Training, fit
from qfolio.experiments.grading import grade
from qfolio.experiments.log import JobLog, Log, add_result, seed_names
from qfolio.experiments.machines.choice import on
from qfolio.experiments.run_folder import EVALUATION, METRICS, RunConfig, RunFolder, curve_point
from qfolio.experiments.seed_groups import SeedGroups, SeedsJob, TrainedSeeds

EVALUATIONS = 20
"""Approximate number of points on the learning curve."""

CHECKPOINT_SECONDS = 10.0


class Run:
    """Seeds of one agent on one task; make it with ``Run.create``, ``Run.open`` or ``train``.

    metrics: a row for each finished training episode. evaluations: a row for each seed and point of
    the learning curve. interrupted: whether Ctrl-C stopped the last training. groups: the groups
    of seeds that executors train as jobs.
    """

    def __init__(
        self, task: Task, agent: Agent, config: RunConfig, folder: RunFolder | None, room: int = 0
    ) -> None:
        """room: seeds of the largest run that shares the programs, if more than this run's."""
        self.task, self.agent, self.config, self._folder = task, agent, config, folder
        self.population: Population = population_of(task, agent, config.seed_range, room)
        self.metrics: list[Row] = []
        self.evaluations: list[Row] = []
        self.seconds_train = 0.0
        self.interrupted = False
        self._log: JobLog | None = None  # only during training
        self.groups = SeedGroups(self)

    @classmethod
    def create(
        cls,
        task: Task,
        agent: Agent,
        *,
        budget: Budget | None = None,
        episodes: int | None = None,
        steps: int | None = None,
        seeds: int = 1,
        seed: int = 0,
        preset: str | None = None,
        out: Path | str | None = None,
    ) -> "Run":
        """A run before its first step.

        Args:
            task, agent: The task, and the agent that learns it.
            budget: The budget of each seed, unless one of the next two is given.
            episodes, steps: One of the two. Steps are those of all environments of a seed.
            seeds, seed: Number of agents, and the first one's seed; the others follow it.
            preset: Name of the preset, for readers.
            out: A new or empty folder; without it, nothing is written.
        """
        require_type("task", task, Task, "a task, such as qfolio.Pendulum()")
        require_type("agent", agent, Agent, "an agent, such as qfolio.DQN()")
        budget = budget or Budget(episodes, steps)
        config = RunConfig(
            **describe(task, agent),
            preset=preset,
            episodes=budget.episodes,
            steps=budget.steps,
            seeds=seeds,
            seed=seed,
            **devices.circumstances("python", "jax", "equinox", "optax", "numpy"),
        )
        place = None if out is None else path_of("out", out)
        if place is not None:
            require_new(place)
        run = cls(task, agent, config, None)
        if place is not None:
            with new_folder(place) as unfinished:
                run._folder = RunFolder(unfinished)
                run._folder.write_config(config)
                run._write_checkpoint()
            run._folder = RunFolder(place)
        return run

    @classmethod
    def open(
        cls, folder: Path | str, task: Task | None = None, agent: Agent | None = None
    ) -> "Run":
        """A run as its last checkpoint left it.

        task, agent: needed only if the folder cannot restore them, because they hold arrays or
        are a user's own and their module has not been imported.
        """
        files = RunFolder(path_of("folder", folder))
        config = files.read_config()
        run = cls(
            task or task_of(config.task, config.task_settings),
            agent or agent_of(config.agent, config.agent_settings),
            config,
            files,
        )
        run._read_checkpoint()
        return run

    def __repr__(self) -> str:
        config, unit = self.config, self.budget.unit
        seeds = amount(config.seeds, "seed")
        done = f"{self.done(unit):,} of {self.budget.amount:,} {unit}"
        where = f", in {self.folder}" if self.folder else ""
        return f"<Run: {config.agent} on {config.task}, {seeds}, {done}{where}>"

    def _repr_html_(self) -> str:
        config, unit, seeds = self.config, self.budget.unit, self.config.seeds
        points = [row["return"] for row in self.evaluations]
        points = points[: len(points) // seeds * seeds]
        return card(
            f"{config.agent} on {config.task}",
            [
                *([] if config.preset is None else [f"preset {config.preset}"]),
                f"{self.done(unit):,} of {self.budget.amount:,} {unit}",
                f"{self.seconds_train:.1f} s of training",
                *([] if self.folder is None else [str(self.folder)]),
            ],
            ("seed", "greedy return"),
            [(str(int(row["seed"])), number(row["return"])) for row in self.evaluations[-seeds:]],
            np.reshape(points, (-1, seeds)).mean(1).tolist(),
        )

    @property
    def folder(self) -> Path | None:
        """The folder of the run, if it has one."""
        return None if self._folder is None else self._folder.path

    @property
    def episodes(self) -> int:
        """Number of finished episodes of the seed with the fewest."""
        return self.population.episodes

    @property
    def budget(self) -> Budget:
        """The budget of each seed."""
        return self.config.budget

    def done(self, unit: str) -> int:
        """Episodes or environment steps of each seed so far."""
        if unit == "steps":
            return self.population.steps * self.agent.num_envs
        return self.episodes

    def train(
        self,
        budget: Budget | None = None,
        listeners: Sequence[Listener] = (),
        *,
        executor: Executor | str | None = None,
        listen: ListenToJob | None = None,
        log: JobLog | None = None,
    ) -> None:
        """Trains until each seed has used its budget (default: the configured one).

        A first Ctrl-C stops after the current chunk, sets ``interrupted`` and leaves a checkpoint;
        with an executor, it leaves the finished groups of seeds. Raises QfolioError if a loss is
        not finite (the last good checkpoint stays) or if another process trains in the folder.

        Args:
            budget: The budget of each seed, including earlier training.
            listeners: Called at the start, after each chunk and at the end; see ``Listener``.
            executor: Where groups of seeds train (default: all side by side in this process); see
                ``qfolio.on``.
            listen: Called before each group, with the finished share of all groups and the share of
                this one; returns its listeners (default: ``listeners``).
            log: Log of the experiment that the run is a part of (default: the folder's own).
        """
        budget, executor = budget or self.budget, on(executor)
        with contextlib.nullcontext() if self.folder is None else locked(self.folder):
            if isinstance(executor, Here) and not self.groups.begun:
                self._train(budget, listeners, log)
            else:
                each = listen or (lambda job, done, share: listeners)
                self._train_groups(self.groups.jobs(executor, budget), executor, each)

    def _train_groups(self, jobs: list[SeedsJob], executor: Executor, listen: ListenToJob) -> None:
        self.interrupted = False
        if jobs:
            with Log(self.folder).opened(**self._about) as log:
                store = partial(self.groups.store, log=log)
                self.interrupted = carry_out(executor, jobs, listen, store, log)

    def _train(self, budget: Budget, listeners: Sequence[Listener], log: JobLog | None) -> None:
        self.interrupted = False
        if not self.evaluations and self.population.steps:
            self.evaluate()  # the run's table was lost
        if not budget.left(self.population):
            return
        self.aim_at(budget)
        with contextlib.ExitStack() as stack:
            if log is None:
                own = stack.enter_context(Log(self.folder).opened(**self._about))
                log = own.job(members=seed_names(self.config.seed_range))
            self._log = log
            stack.callback(setattr, self, "_log", None)
            hooks = [log, _Metrics(self), _Curve(self), *listeners, _Checkpoints(self)]
            config = msgspec.to_builtins(self.config)
            training = fit(self.population, budget, hooks, config=config)
            self.interrupted = training.interrupted
            log.log.settle(training.finished)

    @property
    def _about(self) -> dict[str, Any]:
        """The description of the run in the log."""
        config = self.config
        return {
            "kind": "run",
            "task": config.task,
            "agents": [config.agent],
            "preset": config.preset,
            "seeds": config.seeds,
            self.budget.unit: self.budget.amount,
        }

    def aim_at(self, budget: Budget) -> None:
        """Sets the configured budget, before its training begins."""
        self.config = msgspec.structs.replace(
            self.config, episodes=budget.episodes, steps=budget.steps
        )
        if not self.population.steps:
            self.evaluations = []  # left by a process that was killed before its first checkpoint
        if self._folder is not None:
            self._folder.write_config(self.config)
            self._folder.tidy({METRICS: self.metrics, EVALUATION: self.evaluations})

    def adopt(self, trained: TrainedSeeds) -> None:
        """Takes over the results of training done elsewhere from this run's state."""
        before = self.done("steps")
        self.population.restore(trained.state["training"])
        self.population.seconds_compile += trained.seconds_compile
        self.seconds_train += float(trained.state["seconds_train"])
        new = [row for row in trained.evaluations if not before or row["env_steps"] > before]
        self._record(METRICS, self.metrics, trained.metrics)
        self._record(EVALUATION, self.evaluations, new)
        self._write_checkpoint()

    def first_weights(self) -> Any:
        """The first seed's learned weights."""
        return jax.tree.map(lambda x: x[0], self.population.weights())

    def grade(self, starts: int | None = None) -> dict[str, Any]:
        """Returns, optimum and regret of each seed's policy on the first fixed start states."""
        return grade(self.population, starts)

    def summary(self) -> dict[str, Any]:
        """Greedy returns on the fixed start states, their optimum, and the cost of training."""
        steps, config = self.done("steps"), self.config
        summary = {
            "task": config.task,
            "agent": config.agent,
            "preset": config.preset,
            "seeds": config.seeds,
            "episodes": self.episodes,
            "env_steps": steps,
            "seconds_compile": round(self.population.seconds_compile, 3),
            "seconds_train": round(self.seconds_train, 3),
            "steps_per_second": round(steps * config.seeds / max(self.seconds_train, 1e-9), 1),
            **self.grade(),
        }
        if self._folder is not None:
            self._folder.write_summary(summary)
            regrets = summary["regret_per_seed"]
            known = {"return": summary["return_mean"], "optimum": summary["optimum"]}
            known["regret"] = None if regrets is None else float(np.mean(regrets))
            add_result(self.folder, {short(config.agent): known})
        return summary

    def evaluate(self) -> None:
        """Adds a point to the learning curve."""
        played = self.population.evaluate(start_keys(self.population.curve_starts))
        members = zip(self.population.seeds, self.population.member_episodes, *played, strict=True)
        rows = [
            {
                "seed": seed,
                "episode": episode,
                "env_steps": self.done("steps"),
                "return": float(returns.mean()),
                "overestimation": float(overestimation),
            }
            for seed, episode, returns, overestimation in members
        ]
        self._record(EVALUATION, self.evaluations, rows)
        if self._log is not None:
            self._log.record(self.done("steps"), curve_point(rows))

    def _record(self, name: str, table: list[Row], rows: list[Row]) -> None:
        table += rows
        if self._folder is not None:
            self._folder.append(name, rows)

    def _write_checkpoint(self) -> None:
        if self._folder is not None:
            state = self.state()
            self._folder.write_checkpoint(state, self.agent.weights(state["training"].agent))

    def _read_checkpoint(self) -> None:
        assert self._folder is not None
        state = self._folder.read_checkpoint(self.state())
        self.seconds_train = float(state["seconds_train"])
        self.population.restore(state["training"])
        members = zip(self.population.seeds, self.population.member_episodes, strict=True)
        episodes, steps = dict(members), self.done("steps")
        self.metrics = self._folder.rows(METRICS, episodes, steps)
        points: dict[float, list[Row]] = {}
        for row in self._folder.rows(EVALUATION, episodes, steps):
            points.setdefault(row["env_steps"], []).append(row)
        whole = [rows for rows in points.values() if len(rows) == self.config.seeds]
        self.evaluations = [row for rows in whole for row in rows]

    def state(self) -> dict[str, Any]:
        """The content of a checkpoint: arrays with a leading seed axis."""
        return {"training": self.population.fetch(), "seconds_train": np.array(self.seconds_train)}


class _Metrics(Listener):
    """Records the row of every finished episode, and the training time."""

    def __init__(self, run: Run) -> None:
        self.run, self.before = run, run.seconds_train

    def on_chunk(self, training: Training, rows: list[Row]) -> None:
        self.run.seconds_train = self.before + training.seconds
        self.run._record(METRICS, self.run.metrics, rows)


class _Curve(Listener):
    """Evaluates the policies at the start, at the end, and about ``EVALUATIONS`` times between."""

    def __init__(self, run: Run) -> None:
        self.run = run

    def on_start(self, training: Training) -> None:
        # In steps since the run's start, so that a resumed run has the same curve.
        self.every = (training.begun + training.left) / EVALUATIONS
        self.points = training.begun // self.every
        if not training.begun:
            self.run.evaluate()

    def on_chunk(self, training: Training, rows: list[Row]) -> None:
        points = training.population.steps // self.every
        if points > self.points or training.finished:
            self.run.evaluate()
        self.points = points


class _Checkpoints(Listener):
    """Writes a checkpoint every ``CHECKPOINT_SECONDS``, and at the end."""

    def __init__(self, run: Run) -> None:
        self.run, self.saved = run, perf_counter()

    def on_chunk(self, training: Training, rows: list[Row]) -> None:
        if perf_counter() - self.saved > CHECKPOINT_SECONDS:
            self.on_end(training)

    def on_end(self, training: Training) -> None:
        self.run._write_checkpoint()
        self.saved = perf_counter()


def train(
    task: Task,
    agent: Agent,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    seeds: int = 1,
    seed: int = 0,
    out: Path | str | None = None,
    listeners: Sequence[Listener] = (),
    executor: Executor | str | None = None,
) -> Run:
    """Train agents of one kind on a task, side by side.

    Args:
        task: The task to learn.
        agent: The agent, with its settings.
        episodes: Training episodes of each seed; give these or ``steps``.
        steps: Environment steps of each seed.
        seeds: Number of agents.
        seed: The first seed; the others follow it.
        out: New folder for the run (default: nothing is written).
        listeners: Called at the start, after each chunk and at the end; see ``Listener``.
        executor: Where groups of seeds train (default: all in this process); see ``qfolio.on``.

    Returns:
        The trained run; ``run.summary()`` grades it.

    Raises:
        QfolioError: The agent does not fit the task, a setting is out of range, the folder exists,
            or a loss is not finite.
    """
    devices.configure()
    executor = on(executor)
    run = Run.create(task, agent, episodes=episodes, steps=steps, seeds=seeds, seed=seed, out=out)
    run.train(listeners=listeners, executor=executor)
    return run
