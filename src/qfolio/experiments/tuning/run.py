"""A hyperparameter search: configurations chosen by Optuna, trained in batches.

Configurations × seeds are the members of one population, so that a batch of them is one compiled
program. The folder holds study.json (the search, written once), the journal of all trials and, at
the end, summary.json. Any number of processes may work on one folder at once; one that starts
later, or again, continues from the journal.
"""

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float, Key

from qfolio.core import devices, settings
from qfolio.core.config import Config, read_config, write_config
from qfolio.core.errors import QfolioError, require_whole
from qfolio.core.evaluation import start_keys
from qfolio.core.files import new_folder, path_of, read_json, write_json
from qfolio.core.host import population_of
from qfolio.core.mdp import Agent, Task
from qfolio.core.text import finite
from qfolio.core.training import begin
from qfolio.experiments.budget import Budget, seed_range, unlearned
from qfolio.experiments.described import agent_of, describe, require_described, task_of
from qfolio.experiments.executor import Executor, Job, carry_out, persistent
from qfolio.experiments.fit import Listener, Training
from qfolio.experiments.grading import optimal_returns
from qfolio.experiments.log import Log, add_result
from qfolio.experiments.machines.choice import on
from qfolio.experiments.records import Records
from qfolio.experiments.run_folder import SUMMARY
from qfolio.experiments.tuning import search
from qfolio.experiments.tuning.journal import Asked, Journal, Trial, best_of, preset_of
from qfolio.experiments.tuning.search import Value
from qfolio.experiments.tuning.trials import TrialsJob, trials_jobs

STUDY = "study.json"
"""The name of the file that holds the settings."""

Count = Annotated[int, msgspec.Meta(ge=1, lt=2**20)]

STARTS = 256
"""Start states on which configurations are compared."""

FRESH = 1000
"""First of the fresh seeds that retrain the best configuration at the end."""

RANDOM = 0.5
"""Share of the trials that are drawn at random before Optuna's sampler takes over; the sampler's
own trials gather around the best and do not cover the space."""


def tuning_keys() -> Key[Array, " start"]:
    """Keys of the start states for tuning, which are never used to grade results.

    Choosing by the graded starts would bias every grade upwards.
    """
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(70607), i))(jnp.arange(STARTS))


@dataclass(frozen=True)
class Progress:
    """Progress of a search, after each batch."""

    done: int  # finished trials of all processes
    total: int
    diverged: int
    best: Trial | None
    preset: Trial | None
    seconds: float  # of this batch
    trials: int  # in this batch


class _Share(Listener):
    """Reports the finished share of jobs that may run side by side.

    shares: the share of all work that each job has done. share: this job's share of all work.
    """

    def __init__(
        self, tell: Callable[[float], None], shares: dict[str, float], job: str, share: float
    ) -> None:
        self.tell, self.shares, self.job, self.share = tell, shares, job, share

    def on_chunk(self, training: Training, rows: Records) -> None:
        self.shares[self.job] = training.share * self.share
        self.tell(sum(self.shares.values()))


class SearchConfig(Config, kw_only=True, frozen=True):
    """The configuration of a search."""

    kind: ClassVar[str] = "search"
    format: ClassVar[int] = 2

    task: str
    task_settings: dict[str, Any]
    agent: str
    agent_settings: dict[str, Any]
    preset: str
    search: dict[str, str]  # the ranges and choices of the searched settings
    trials: Count
    seeds: Count
    episodes: int | None
    steps: int | None
    batch: Count
    fresh_seeds: Count
    device: str
    versions: dict[str, str]
    started: str

    def __post_init__(self) -> None:
        _ = self.budget, seed_range(max(self.seeds, self.fresh_seeds), FRESH)

    @property
    def budget(self) -> Budget:
        """The budget of each agent."""
        return Budget(self.episodes, self.steps)


class Tuning:
    """A search in its folder; make it with ``Tuning.create`` or ``Tuning.open``."""

    def __init__(self, config: SearchConfig, folder: Path) -> None:
        self.config, self.folder = config, folder
        self.task = task_of(config.task, config.task_settings)
        self.agent = agent_of(config.agent, config.agent_settings)
        kind = type(self.agent)
        texts = config.search.items()
        self.space = [search.dimension(name, text, kind) for name, text in texts]
        self.interrupted = False
        at_random = max(2, round(RANDOM * config.trials))
        self.journal = Journal(folder, self.space, at_random=at_random)

    @classmethod
    def create(
        cls,
        task: Task,
        agent: Agent,
        space: Sequence[search.Dimension],
        *,
        trials: int,
        seeds: int,
        budget: Budget,
        batch: int,
        fresh_seeds: int,
        preset: str,
        out: Path | str,
    ) -> "Tuning":
        """Creates a search without trials.

        Args:
            task: The task to learn.
            agent: The agent of ``preset``, with the settings that are not searched.
            space: The searched settings.
            trials: Total number of configurations.
            seeds: Number of seeds of each configuration.
            budget: The budget of each agent.
            batch: Number of configurations trained at once.
            fresh_seeds: Number of seeds of the final comparison, which the search never uses.
            preset: The name of the preset, for readers.
            out: A new or empty folder.

        Raises:
            QfolioError: A setting is out of range, settings do not describe the task or the agent,
                or the budget ends before learning begins.
        """
        _require_counts(trials=trials, batch=batch, seeds=seeds, fresh_seeds=fresh_seeds)
        require_described("A search", task, agent)
        config = SearchConfig(
            **describe(task, agent),
            preset=preset,
            search={dim.name: str(dim) for dim in space},
            trials=trials,
            seeds=seeds,
            episodes=budget.episodes,
            steps=budget.steps,
            batch=batch,
            fresh_seeds=fresh_seeds,
            **devices.circumstances("jax", "optuna"),
        )
        agents = search.require_buildable(agent, task, space)
        if all(reasons := [_unlearned(one, task, budget) for one in agents]):
            raise QfolioError(f"The agent {reasons[0]}")
        jax.eval_shape(lambda: begin(task, agent, jnp.array(0, jnp.uint32)))  # fits the task?
        folder = path_of("out", out)
        with new_folder(folder, "--join") as unfinished:
            write_config(unfinished / STUDY, config)
        return cls(config, folder)

    @classmethod
    def open(
        cls, folder: Path | str, *, trials: int | None = None, batch: int | None = None
    ) -> "Tuning":
        """Opens a search in its folder, to join or to continue it.

        trials: a new total number of configurations. batch: for this process alone.
        """
        folder = path_of("folder", folder)
        config = read_config(folder / STUDY, SearchConfig)
        if trials is not None:
            _require_counts(trials=trials)
            config = msgspec.structs.replace(config, trials=trials)
            write_config(folder / STUDY, config)
        if batch is not None:
            _require_counts(batch=batch)
            config = msgspec.structs.replace(config, batch=batch)
        return cls(config, folder)

    def configured(self, values: dict[str, Value]) -> Agent:
        """The agent with these values of the searched settings.

        Raises QfolioError if it refuses them.
        """
        described = settings.describe(self.agent)
        agent: Agent = settings.build(type(self.agent), {**described, **values})
        return agent.fitted(self.task)

    def run(
        self,
        listener: Callable[[Progress], None] | None = None,
        chunk_listener: Callable[[float], None] | None = None,
        executor: Executor | str | None = None,
    ) -> None:
        """Trains one batch after another until the configured number of trials is reached.

        Ctrl-C stops after the current chunk and sets ``interrupted``; an unfinished batch is
        proposed again when the search is resumed. chunk_listener: called with the finished share of
        a batch. executor: where parts of a batch train (default: all in this process); see
        ``qfolio.on``.
        """
        preset = {dim.name: search.own_value(self.agent, dim) for dim in self.space}
        batch, total = self.config.batch, self.config.trials
        self.interrupted = False
        with (
            self._log() as log,
            self.journal.at_work(),
            persistent(on(executor)) as workers,
        ):
            while not self.interrupted and (asked := self.journal.ask(batch, total, preset)):
                try:
                    now = self._train(asked, log, chunk_listener, workers)
                except KeyboardInterrupt:
                    self.interrupted = True
                    break
                if listener is not None:
                    listener(now)
                log.result(self._results(now.best, now.preset), now.done)
                self.interrupted &= now.done < total
            log.settle(not self.interrupted)

    def _log(self) -> contextlib.AbstractContextManager[Log]:
        config = self.config
        about = {"kind": config.kind, "task": config.task, "agents": [config.agent]}
        return Log(self.folder).opened(**about, trials=config.trials, seeds=config.seeds)

    def trained(
        self,
        agents: Mapping[str, Agent],
        seeds: Sequence[int],
        keys: Key[Array, " start"],
        log: Log | None = None,
        listener: Callable[[float], None] | None = None,
        executor: Executor | str | None = None,
    ) -> Float[np.ndarray, "agent seed"]:
        """Trains agents; returns mean greedy returns by agent and seed, NaN if the loss diverged.

        Raises KeyboardInterrupt if Ctrl-C stops it before the end.

        agents: by their names in the log.
        """
        executor, config = on(executor), self.config
        starts = np.asarray(jax.random.key_data(keys))
        jobs = trials_jobs(self.task, agents, seeds, config.budget, starts, executor)
        found: dict[str, np.ndarray] = {}
        shares: dict[str, float] = {}

        def listen(job: Job, done: float, share: float) -> list[Listener]:
            return [] if listener is None else [_Share(listener, shares, job.name, share)]

        def store(job: TrialsJob, returns: np.ndarray) -> None:
            found.update(zip(job.names, returns, strict=True))

        self.interrupted |= carry_out(executor, jobs, listen, store, log or Log(None))
        if len(found) < len(agents):
            raise KeyboardInterrupt
        return np.array([found[name] for name in agents]).reshape(len(agents), len(seeds))

    def conclude(self, executor: Executor | str | None = None) -> dict[str, Any]:
        """Trains the best configuration and the preset with fresh seeds, and grades both.

        They are graded on the fixed start states, which the search never used. The result is cached
        in summary.json for as long as the best configuration is the same. executor: as for ``run``.
        """
        trials = self.journal.trials()
        found = best_of(trials)
        if found is None:
            raise QfolioError(
                population_of(self.task, self.agent, [0]).task_fault()
                or f"None of the {len(trials)} configurations kept a finite loss; search lower "
                "learning rates, or bound the gradient (huber_delta or max_grad_norm, whichever "
                "the agent has)."
            )
        if (summary := self._summary(found)) is not None:
            return summary
        seeds = range(FRESH, FRESH + self.config.fresh_seeds)
        agents = {"best": self.configured(found.values), "preset": self.agent}
        with self._log() as log:
            returns = self.trained(agents, seeds, start_keys(), log, executor=executor)

        def optimum(keys: Key[Array, " start"]) -> float | None:
            best = optimal_returns(self.task, keys)
            return None if best is None else float(best.mean())

        best, preset = finite(returns.tolist())
        summary = {
            "best": found.values,
            "return_tuned_on": found.value,
            "seeds": list(seeds),
            "return_per_seed": best,
            "preset_return_per_seed": preset,
            "optimum": optimum(start_keys()),
            "optimum_tuned_on": optimum(tuning_keys()),
        }
        write_json(self.folder / SUMMARY, summary)
        add_result(self.folder, self._results(found, preset_of(trials)))
        return summary

    @property
    def summary(self) -> dict[str, Any] | None:
        """What ``conclude`` has found of the best configuration so far; None if it has not yet."""
        best = best_of(self.journal.trials())
        return None if best is None else self._summary(best)

    def _summary(self, best: Trial) -> dict[str, Any] | None:
        """The content of summary.json if it is about this configuration."""
        with contextlib.suppress(QfolioError):  # missing or damaged: it is made again
            if (summary := read_json(self.folder / SUMMARY)).get("best") == best.values:
                return summary
        return None

    def _results(self, best: Trial | None, preset: Trial | None) -> dict[str, dict[str, Any]]:
        """What the log says of both: the return in the search, which flatters, and a fresh one."""
        tried = {"best": best, "preset": preset}
        values = {name: {"return_in_search": x.value} for name, x in tried.items() if x}
        if best is not None and (summary := self._summary(best)) is not None:
            fresh = {"best": "return_per_seed", "preset": "preset_return_per_seed"}
            for name, key in fresh.items():
                known = [math.nan if x is None else x for x in summary[key]]
                values[name] = {"return": float(np.mean(known)), **values.get(name, {})}
        return values

    def _train(
        self,
        asked: Sequence[Asked],
        log: Log | None = None,
        listener: Callable[[float], None] | None = None,
        executor: Executor | str | None = None,
    ) -> Progress:
        """Trains a batch and records its returns: NaN for settings that the agent refuses."""
        start = perf_counter()
        try:
            agents = dict[str, Agent]()
            for one in asked:
                # It may refuse two values that it takes one by one; the search goes on without it.
                with contextlib.suppress(QfolioError):
                    agents[_name(one)] = self.configured(one.values)
            seeds = range(self.config.seeds)
            returns = self.trained(agents, seeds, tuning_keys(), log, listener, executor)
        except BaseException:
            for one in asked:
                self.journal.give_up(one)
            raise
        seconds = perf_counter() - start
        found = dict(zip(agents, returns.tolist(), strict=True))
        for one in asked:
            returns_of_one = found.get(_name(one), [math.nan] * len(seeds))
            self.journal.tell(one, returns_of_one, seconds / len(asked))
        trials = self.journal.trials()
        return Progress(
            done=len(trials),
            total=self.config.trials,
            diverged=sum(math.isnan(trial.value) for trial in trials),
            best=best_of(trials),
            preset=preset_of(trials),
            seconds=seconds,
            trials=len(asked),
        )


def _name(asked: Asked) -> str:
    """The name of a trial, counted from 1 as in the report."""
    return f"trial {asked.trial.number + 1}"


def _unlearned(agent: Agent, task: Task, budget: Budget) -> str:
    steps = agent.whole_rollouts(budget.longest(task, agent))
    return unlearned(agent, steps * agent.num_envs)


def _require_counts(**counts: int) -> None:
    for name, value in counts.items():
        require_whole(name, value, 1, 2**20 - 1)
