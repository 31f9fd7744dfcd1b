"""Seeds of one agent on one task, side by side in this process: training, records, checkpoints."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import PyTree

from qfolio.core.evaluation import start_keys
from qfolio.core.host import population_of
from qfolio.core.mdp import Agent, Task
from qfolio.core.population import Population
from qfolio.experiments.budget import Budget
from qfolio.experiments.fit import Listener, Training, fit
from qfolio.experiments.log import JobLog, Log, seed_names
from qfolio.experiments.records import Records
from qfolio.experiments.run_folder import EVALUATION, METRICS, RunConfig, RunFolder, curve_point

EVALUATIONS = 20
"""Approximate number of points on the learning curve."""

CHECKPOINT_SECONDS = 10.0


class TrainedSeeds(NamedTuple):
    """Seeds that have been trained.

    config: for these seeds alone. state: their checkpoint, with a leading seed axis.
    """

    config: RunConfig
    state: PyTree
    metrics: Records
    evaluations: Records
    seconds_compile: float = 0.0


class Seeds:
    """The seeds of a run, with its folder if it has one.

    evaluations: a row for each seed and point of the learning curve. interrupted: whether Ctrl-C
    stopped the last training.
    """

    def __init__(
        self, task: Task, agent: Agent, config: RunConfig, folder: RunFolder | None, room: int = 0
    ) -> None:
        """room: seeds of the largest run that shares the programs, if more than this run's."""
        self.task, self.config, self._folder = task, config, folder
        self.population: Population = population_of(task, agent, config.seed_range, room)
        self.agent = self.population.agent  # fitted to the task
        self._metrics: list[Records] = []  # of each chunk
        self.evaluations = Records()
        self.seconds_train = 0.0
        self.interrupted = False
        self._log: JobLog | None = None  # only during training

    @property
    def folder(self) -> Path | None:
        """The folder of the run, if it has one."""
        return None if self._folder is None else self._folder.path

    @property
    def metrics(self) -> Records:
        """A row for each finished training episode."""
        self._metrics = [Records.joined(self._metrics)]
        return self._metrics[0]

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
            return self.population.env_steps
        return self.episodes

    def train_here(
        self, budget: Budget, listeners: Sequence[Listener] = (), log: JobLog | None = None
    ) -> None:
        """Trains all seeds as one population, until each has used a budget or Ctrl-C stops it.

        log: of the experiment that this is a part of (default: the folder's own).
        """
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
            training = fit(self.population, budget, hooks)
            self.interrupted = training.interrupted
            log.log.settle(training.finished)

    @property
    def _about(self) -> dict[str, Any]:
        """The description of the run in the log."""
        config = self.config
        return {
            "kind": config.kind,
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
            # A process that was killed before its first checkpoint may have left some.
            self.evaluations = Records()
        if self._folder is not None:
            self._folder.write_config(self.config)
            self._folder.tidy({METRICS: self.metrics, EVALUATION: self.evaluations})

    def adopt(self, trained: TrainedSeeds) -> None:
        """Takes over the results of training done elsewhere from this run's state."""
        before = self.done("steps")
        self.population.restore(trained.state["training"])
        self.population.seconds_compile += trained.seconds_compile
        self.seconds_train += float(trained.state["seconds_train"])
        points = trained.evaluations
        self._record_episodes(trained.metrics)
        self._record_point(points[points.column("env_steps") > before] if before else points)
        self._write_checkpoint()

    def evaluate(self) -> None:
        """Adds a point to the learning curve."""
        played = self.population.evaluate(start_keys(self.population.curve_starts))
        members = zip(self.population.seeds, self.population.member_episodes, *played, strict=True)
        rows = Records.of(
            {
                "seed": seed,
                "episode": episode,
                "env_steps": self.done("steps"),
                "return": float(returns.mean()),
                "overestimation": float(overestimation),
            }
            for seed, episode, returns, overestimation in members
        )
        self._record_point(rows)
        if self._log is not None:
            self._log.record(self.done("steps"), curve_point(rows))

    def state(self) -> dict[str, Any]:
        """The content of a checkpoint: arrays with a leading seed axis."""
        return {"training": self.population.fetch(), "seconds_train": np.array(self.seconds_train)}

    def _record_episodes(self, rows: Records) -> None:
        self._metrics.append(rows)
        if self._folder is not None:
            self._folder.append(METRICS, rows)

    def _record_point(self, rows: Records) -> None:
        self.evaluations = Records.joined([self.evaluations, rows])
        if self._folder is not None:
            self._folder.append(EVALUATION, rows)

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
        self._metrics = [self._folder.rows(METRICS, episodes, steps)]
        points = self._folder.rows(EVALUATION, episodes, steps)
        _, at, counts = np.unique(
            points.column("env_steps"), return_inverse=True, return_counts=True
        )
        self.evaluations = points[counts[at] == self.config.seeds]  # whole points


class _Metrics(Listener):
    """Records the row of every finished episode, and the training time."""

    def __init__(self, seeds: Seeds) -> None:
        self.seeds, self.before = seeds, seeds.seconds_train

    def on_chunk(self, training: Training, rows: Records) -> None:
        self.seeds.seconds_train = self.before + training.seconds
        self.seeds._record_episodes(rows)


class _Curve(Listener):
    """Evaluates the policies at the start, at the end, and about ``EVALUATIONS`` times between."""

    def __init__(self, seeds: Seeds) -> None:
        self.seeds = seeds

    def on_start(self, training: Training) -> None:
        # From the budget alone, so that a resumed run has the same curve if episodes end early.
        self.every = training.budget.longest(self.seeds.task, self.seeds.agent) / EVALUATIONS
        self.points = training.begun // self.every
        if not training.begun:
            self.seeds.evaluate()

    def on_chunk(self, training: Training, rows: Records) -> None:
        points = training.population.steps // self.every
        if points > self.points or training.finished:
            self.seeds.evaluate()
        self.points = points


class _Checkpoints(Listener):
    """Writes a checkpoint every ``CHECKPOINT_SECONDS``, and at the end."""

    def __init__(self, seeds: Seeds) -> None:
        self.seeds, self.saved = seeds, perf_counter()

    def on_chunk(self, training: Training, rows: Records) -> None:
        if perf_counter() - self.saved > CHECKPOINT_SECONDS:
            self.on_end(training)

    def on_end(self, training: Training) -> None:
        self.seeds._write_checkpoint()
        self.saved = perf_counter()
