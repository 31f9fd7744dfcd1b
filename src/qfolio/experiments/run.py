"""A run: the training of one agent's seeds on one task, and its records."""

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from qfolio.core import devices, faults
from qfolio.core.errors import QfolioError, require_type
from qfolio.core.files import locked, new_folder, path_of, require_new
from qfolio.core.mdp import Agent, Task
from qfolio.core.notebook import card
from qfolio.core.registry import short
from qfolio.core.text import amount, four_digits
from qfolio.experiments.budget import Budget, require_budget, seed_range
from qfolio.experiments.described import agent_of, describe, task_of
from qfolio.experiments.executor import Executor, Here, ListenToJob, carry_out
from qfolio.experiments.fit import Listener, require_listeners
from qfolio.experiments.grading import grade
from qfolio.experiments.log import JobLog, Log, add_result
from qfolio.experiments.machines.choice import on
from qfolio.experiments.run_folder import RunConfig, RunFolder
from qfolio.experiments.seed_groups import SeedGroups, SeedsJob
from qfolio.experiments.seeds import Seeds


class Run(Seeds):
    """Seeds of one agent on one task; make it with ``Run.create``, ``Run.open`` or ``train``.

    metrics: a row for each finished training episode. evaluations: a row for each seed and point of
    the learning curve. interrupted: whether Ctrl-C stopped the last training. groups: the groups
    of seeds that executors train as jobs.
    """

    def __init__(
        self, task: Task, agent: Agent, config: RunConfig, folder: RunFolder | None
    ) -> None:
        super().__init__(task, agent, config, folder)
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
        if preset is not None:
            require_type("preset", preset, str, "text")
        budget = Budget(episodes, steps) if budget is None else require_budget(budget)
        every = seed_range(seeds, seed)
        config = RunConfig(
            **describe(task, agent),
            preset=preset,
            episodes=budget.episodes,
            steps=budget.steps,
            seeds=len(every),
            seed=every.start,
            **devices.circumstances("python", "jax", "equinox", "numpy"),
        )
        place = None if out is None else path_of("out", out)
        if place is not None:
            require_new(place)
        run = cls(task, agent, config, None)
        faults.require_actions(task, agent)
        if place is not None:
            with new_folder(place) as unfinished:
                run._folder = RunFolder(unfinished)
                run._folder.write_config(config)
                run._write_checkpoint()
            run._folder.path = place
        return run

    @classmethod
    def open(
        cls, folder: Path | str, task: Task | None = None, agent: Agent | None = None
    ) -> "Run":
        """A run as its last checkpoint left it.

        task, agent: needed only if the folder cannot restore them, because they hold arrays or
        are a user's own and their module has not been imported. Raises QfolioError if they are not
        those of the run.
        """
        files = RunFolder(path_of("folder", folder))
        config = files.read_config()
        run = cls(
            task_of(config.task, config.task_settings, task),
            agent_of(config.agent, config.agent_settings, agent),
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
            ("seed", f"greedy return, {self.population.curve_starts} starts"),
            [
                (str(int(row["seed"])), four_digits(row["return"]))
                for row in self.evaluations[-seeds:]
            ],
            np.reshape(points, (-1, seeds)).mean(1).tolist(),
        )

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
        not finite (the last good checkpoint stays), if another process trains in the folder, or if
        one has done so since this run was opened.

        Args:
            budget: The budget of each seed, including earlier training.
            listeners: Called at the start, after each chunk and at the end; see ``Listener``.
            executor: Where groups of seeds train (default: all side by side in this process); see
                ``qfolio.on``.
            listen: Called before each group, with the share of all seeds that is finished and that
                of this group; returns its listeners (default: ``listeners``).
            log: Log of the experiment that the run is a part of (default: the folder's own).
        """
        budget = self.budget if budget is None else require_budget(budget)
        require_listeners(listeners)
        executor = on(executor)
        with contextlib.nullcontext() if self.folder is None else locked(self.folder):
            if self._folder is not None:
                self._folder.require_latest()
            if isinstance(executor, Here) and not self.groups.begun:
                self.train_here(budget, listeners, log)
            else:
                each = listen or (lambda job, done, share: listeners)
                self._train_groups(self.groups.jobs(executor, budget), executor, each)

    def _train_groups(self, jobs: list[SeedsJob], executor: Executor, listen: ListenToJob) -> None:
        self.interrupted = False
        if jobs:
            with Log(self.folder).opened(**self._about) as log:
                store = partial(self.groups.store, log=log)
                self.interrupted = carry_out(executor, jobs, listen, store, log, self.config.seeds)

    def first_weights(self) -> Any:
        """The first seed's learned weights."""
        return jax.tree.map(lambda x: x[0], self.population.weights())

    def policy(self, seed: int | None = None) -> Callable[[Any], Any]:
        """The greedy policy of a seed as it is now: a function of one observation to an action.

        Both are in the format of an environment of Gymnasium; with other tasks they are those of
        ``task.observe`` and ``task.step``. Make the function once: each is compiled anew.
        seed: one of the run's seeds (default: the first); QfolioError for others.
        """
        seeds = self.population.seeds
        if seed is not None and seed not in seeds:
            raise QfolioError(
                f"seed is {seed}; the first of this run is {seeds[0]}, and the last {seeds[-1]}."
            )
        return self.population.policy(0 if seed is None else seeds.index(seed))

    def grade(self, starts: int | None = None) -> dict[str, Any]:
        """Grades each seed's greedy policy on the first fixed start states.

        Returns return_mean, return_ci95, return_per_seed, optimum, regret_per_seed (as shares of
        the optimum's absolute value; None if it is 0), overestimation_per_seed and rule; what is
        unknown is None.
        Raises QfolioError if a return is not finite.
        """
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
            "episodes_per_seed": self.population.member_episodes,
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
        out: A new or empty folder for the run (default: nothing is written).
        listeners: Called at the start, after each chunk and at the end; see ``Listener``.
        executor: Where groups of seeds train (default: all in this process); see ``qfolio.on``.

    Returns:
        The trained run; ``run.summary()`` grades it.

    Raises:
        QfolioError: The agent does not fit the task, a setting is out of range, the folder is
            not empty, or a loss is not finite.
    """
    devices.configure()
    executor = on(executor)
    run = Run.create(task, agent, episodes=episodes, steps=steps, seeds=seeds, seed=seed, out=out)
    run.train(listeners=listeners, executor=executor)
    return run
