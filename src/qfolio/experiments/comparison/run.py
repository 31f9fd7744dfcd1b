"""A comparison: several agents on one task, trained one after another on the same seeds.

The folder holds comparison.json (settings, written at the start; each agent's result, added when it
is finished; and the ranking), a run folder for each agent in agents/ (for ``qfolio evaluate`` and
``watch``) and, at the end, the report. A stopped comparison resumes from the last checkpoint of the
agent that was training.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from qfolio.core import devices, settings
from qfolio.core.config import (
    AgentName,
    Config,
    agent_folder,
    read_config,
    require_agent_names,
    write_config,
)
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.files import locked, new_folder, path_of, read_json
from qfolio.core.mdp import Agent, Task
from qfolio.core.notebook import card
from qfolio.core.statistics import interquartile_mean, regret
from qfolio.core.text import amount, four_digits, listed
from qfolio.core.training import begin
from qfolio.experiments.budget import Budget, seed_range, unlearned
from qfolio.experiments.comparison.conclusion import conclusion, share
from qfolio.experiments.comparison.measure import measure
from qfolio.experiments.comparison.ranking import Result, rank
from qfolio.experiments.described import agent_of, describe, require_described, task_of
from qfolio.experiments.executor import Executor, Here, ListenToJob, carry_out
from qfolio.experiments.fit import Listener
from qfolio.experiments.log import JobLog, Log, add_result, seed_names
from qfolio.experiments.machines.choice import on
from qfolio.experiments.run import Run
from qfolio.experiments.run_folder import CONFIG
from qfolio.experiments.seed_groups import FOLDER as SEEDS
from qfolio.experiments.seed_groups import SeedsJob
from qfolio.experiments.seeds import TrainedSeeds

FILE = "comparison.json"

COARSE = 10
"""Learning curves with fewer points only roughly show when an agent came near the goal."""


@dataclass(frozen=True)
class Entrant:
    """An agent with its variant of the task and its training budget.

    preset: the preset's name, for readers.
    """

    task: Task
    agent: Agent
    preset: str | None
    budget: Budget


@dataclass(frozen=True)
class _AgentJob:
    """Trains all seeds of an agent in this process, from the last checkpoint in its folder."""

    name: str
    members: Sequence[str]
    open: Callable[[str], Run]

    def run(self, listeners: Sequence[Listener]) -> Run | QfolioError | None:
        log, *others = listeners
        assert isinstance(log, JobLog)
        try:
            run = self.open(self.name)
            run.train(listeners=others, log=log)
        except QfolioError as error:
            return error
        return None if run.interrupted else run


class EntrantConfig(msgspec.Struct, kw_only=True):
    """An entrant as comparison.json holds it."""

    agent: str
    preset: str | None
    agent_settings: dict[str, Any]
    task_settings: dict[str, Any]
    episodes: int | None
    steps: int | None


class ComparisonConfig(Config, frozen=True):
    """The content of comparison.json: what is compared, and the results so far."""

    kind: ClassVar[str] = "comparison"
    format: ClassVar[int] = 2

    task: str
    seeds: int
    seed: int
    command: str
    note: str
    agents: dict[AgentName, EntrantConfig]
    device: str
    started: str
    results: dict[str, Result] = msgspec.field(default_factory=dict)
    failures: dict[str, str] = msgspec.field(default_factory=dict)
    ranking: dict[str, Any] | None = None
    conclusion: list[str] = msgspec.field(default_factory=list)
    notes: list[str] = msgspec.field(default_factory=list)

    def __post_init__(self) -> None:
        seed_range(self.seeds, self.seed)
        require_agent_names(self.agents)
        if not self.results.keys() <= self.agents.keys():
            raise QfolioError("there are results of unknown agents.")


class Comparison:
    """Several agents on one task, with the same seeds.

    ``create`` or ``open`` makes one; ``run`` trains and grades the agents without a result.

    results: of the finished agents, by name. failures: the errors of the others.
    """

    def __init__(self, config: ComparisonConfig, folder: Path) -> None:
        self.config, self.results, self.folder = config, dict(config.results), folder
        self.failures = dict(config.failures)
        self.interrupted = False
        self.entrants = {
            name: _entrant(config.task, entry) for name, entry in config.agents.items()
        }

    @classmethod
    def create(
        cls,
        entrants: dict[str, Entrant],
        *,
        seeds: int,
        seed: int = 0,
        command: str = "",
        note: str = "",
        out: Path | str,
    ) -> "Comparison":
        """Creates a comparison in which no agent has been trained yet.

        Raises QfolioError if an agent does not fit the task or into memory, or its name cannot be
        that of a folder, or if its settings do not describe it or its task.

        Args:
            entrants: Two or more agents, by name.
            seeds: Number of seeds of each agent, from ``seed``.
            command: The command that started it, for the report.
            note: A remark for the report, as a sentence.
            out: A new or empty folder.
        """
        if len(entrants) < 2:
            raise QfolioError(
                "A comparison needs two or more agents; name them with --agents, separated by "
                "commas."
            )
        seed_range(seeds, seed)
        for name, entrant in entrants.items():
            _require_fit(name, entrant, seeds)
            require_described("A comparison", entrant.task, entrant.agent)
        described = {name: describe(one.task, one.agent) for name, one in entrants.items()}
        tasks = list(dict.fromkeys(entry.pop("task") for entry in described.values()))
        if len(tasks) > 1:
            raise QfolioError(f"A comparison has one task, but these are {', '.join(tasks)}.")
        config = ComparisonConfig(
            task=tasks[0],
            seeds=int(seeds),
            seed=int(seed),
            command=command,
            note=note,
            agents={
                name: EntrantConfig(
                    preset=entrant.preset,
                    episodes=entrant.budget.episodes,
                    steps=entrant.budget.steps,
                    **described[name],
                )
                for name, entrant in entrants.items()
            },
            **devices.circumstances(),
        )
        place = path_of("out", out)
        with new_folder(place) as folder:
            write_config(folder / FILE, config)
        return cls(config, place)

    @classmethod
    def open(cls, folder: Path | str) -> "Comparison":
        """A comparison as its last finished agent left it."""
        place = path_of("folder", folder)
        return cls(read_config(place / FILE, ComparisonConfig), place)

    def __repr__(self) -> str:
        config, seeds = self.config, amount(self.config.seeds, "seed")
        done = f"{len(self.results)} of {amount(len(self.entrants), 'agent')} finished"
        names = ", ".join(self.entrants)
        return f"<Comparison: {names} on {config.task}, {seeds}, {done}, in {self.folder}>"

    def _repr_html_(self) -> str:
        config, rows = self.config, []
        for name in self.entrants:
            known = _measures(self.results[name]) if name in self.results else {}
            seconds = self.results[name].seconds_train if name in self.results else None
            earned, missed = known.get("return"), known.get("regret")
            cells = (four_digits(earned), "–" if missed is None else share(missed))
            rows.append((name, *cells, four_digits(seconds), self.failures.get(name, "")))
        done = f"{len(self.results)} of {len(self.entrants)} agents"
        seeds = amount(config.seeds, "seed")
        header = ("agent", "return", "regret", "seconds", "")
        facts = [done, seeds, *config.conclusion[:1], str(self.folder)]
        return card(f"Comparison on {config.task}", facts, header, rows)

    def place(self, name: str) -> Path:
        """The run folder of an agent."""
        return self.folder / "agents" / agent_folder(name)

    def run(
        self, listen: ListenToJob | None = None, executor: Executor | str | None = None
    ) -> None:
        """Trains and grades every agent that has no result yet.

        A first Ctrl-C stops after the current chunk and sets ``interrupted``; with an executor,
        finished groups of seeds are kept. An agent that diverges is left out and noted in
        ``failures``.

        Args:
            listen: Called before each job, which is an agent or a group of its seeds, with the
                share of the comparison that is finished and that of this job; returns its
                listeners.
            executor: Where groups of seeds train (default: one agent after another in this
                process); see ``qfolio.on``.
        """
        listen, executor = listen or (lambda job, done, share: ()), on(executor)
        missing = [name for name in self.entrants if name not in self.results]
        self.interrupted = False
        if not missing:
            return
        self.failures = {}  # they are tried again
        with locked(self.folder), Log(self.folder).opened(**self._about) as log:
            # Seeds that were begun in groups go on in them, wherever they are resumed.
            groups = any((self.place(name) / SEEDS).exists() for name in missing)
            run = self._run_here if isinstance(executor, Here) and not groups else self._run_groups
            self.interrupted = run(missing, executor, listen, log)

    @property
    def _about(self) -> dict[str, Any]:
        """The description of the comparison in the log."""
        config = self.config
        return {
            "kind": config.kind,
            "task": config.task,
            "agents": list(config.agents),
            "seeds": config.seeds,
        }

    @property
    def _members(self) -> int:
        """The seeds of all agents."""
        return len(self.entrants) * self.config.seeds

    def _run_here(
        self, missing: list[str], executor: Executor, listen: ListenToJob, log: Log
    ) -> bool:
        """Trains one agent after another; returns whether Ctrl-C stopped it."""
        members = seed_names(seed_range(self.config.seeds, self.config.seed))
        jobs = [_AgentJob(name, members, self._open) for name in missing]

        def store(job: _AgentJob, trained: Run | QfolioError) -> None:
            if isinstance(trained, QfolioError):
                self._fail(job.name, job.name, trained, log)
            else:
                self._keep(job.name, trained, executor, log)

        return carry_out(executor, jobs, listen, store, log, self._members)

    def _run_groups(
        self, missing: list[str], executor: Executor, listen: ListenToJob, log: Log
    ) -> bool:
        """Trains all agents' groups of seeds; returns whether Ctrl-C stopped it."""
        runs, jobs = dict[str, Run](), list[SeedsJob]()

        def store(job: SeedsJob, trained: TrainedSeeds | QfolioError) -> None:
            try:
                runs[job.label].groups.store(job, trained, log)
            except QfolioError as error:
                self._fail(job.name, job.label, error, log)
            keep_if_finished(job.label)

        def keep_if_finished(name: str) -> None:
            if not runs[name].budget.left(runs[name].population):
                self._keep(name, runs.pop(name), executor, log)

        with contextlib.ExitStack() as stack:
            for name in missing:
                runs[name] = self._open(name)
                stack.enter_context(locked(self.place(name)))
                jobs += runs[name].groups.jobs(executor, label=name)
                keep_if_finished(name)  # all seeds may be trained, with only the result missing
            return carry_out(executor, jobs, listen, store, log, self._members)

    def _fail(self, job: str, name: str, error: QfolioError, log: Log) -> None:
        self.failures[name] = str(error)
        log.write("failed", job=job, error=str(error))
        self._write()

    def _keep(self, name: str, run: Run, executor: Executor, log: Log) -> None:
        try:
            self.results[name] = measure(run, executor.devices)
        except QfolioError as error:  # it cannot be graded
            self._fail(name, name, error, log)
        else:
            self._write()

    @property
    def finished(self) -> bool:
        """Whether every agent has a result, or could not be trained."""
        return self.entrants.keys() == self.results.keys() | self.failures.keys()

    def finish(self) -> dict[str, Any]:
        """The content of comparison.json, with the ranking of all finished agents."""
        if len(self.results) < 2:
            reasons = "; ".join(f"{name}: {why}" for name, why in self.failures.items())
            raise QfolioError(f"There are fewer than two agents to compare. {reasons}")
        self._write()
        add_result(self.folder, {name: _measures(one) for name, one in self.results.items()})
        return read_json(self.folder / FILE)

    def notes(self) -> list[str]:
        """Caveats for the comparison, in sentences."""
        notes = [f"{name} could not be trained. {why}" for name, why in self.failures.items()]
        notes += filter(None, [self.config.note])
        entrants = {name: self.entrants[name] for name in self.entrants if name in self.results}
        tasks = {name: settings.describe(entrant.task) for name, entrant in entrants.items()}
        differing = [_differing(key, tasks) for key in next(iter(tasks.values()))]
        if any(differing):
            said = "; ".join(filter(None, differing))
            notes.append(f"Task settings differ between agents: {said}. {self._comparable()}")
        steps = {name: self.results[name].env_steps for name in entrants}
        for name, entrant in entrants.items():
            if why := unlearned(entrant.agent, steps[name]):
                notes.append(f"{name} {why}")
        most, least = max(steps, key=lambda n: steps[n]), min(steps, key=lambda n: steps[n])
        if steps[most] > 1.05 * steps[least]:
            notes.append(
                f"Budgets differ: from {steps[least]:,} environment steps a seed "
                f"({least}) to {steps[most]:,} ({most})."
            )
        coarse = [name for name in entrants if len(self.results[name].curve_steps) < COARSE]
        if coarse:
            notes.append(
                f"The learning curves of {listed(coarse)} have fewer than {COARSE} points, because "
                "evaluations are far apart: they may come near the goal earlier than stated."
            )
        return notes

    def _comparable(self) -> str:
        """A sentence on whether start states, episode lengths and optima are the same."""
        tasks = [entrant.task for name, entrant in self.entrants.items() if name in self.results]
        starts = [jax.vmap(task.reset)(start_keys()) for task in tasks]
        optima = [result.optimum for result in self.results.values()]
        known = [optimum for optimum in optima if optimum is not None]
        alike = {
            "start states": all(_same(starts[0], start) for start in starts),
            "lengths of episodes": all(task.horizon == tasks[0].horizon for task in tasks),
        }
        if known:
            alike["exact optima"] = bool(np.allclose(known, known[0], rtol=1e-4))
        if all(alike.values()):
            return (
                f"Their {listed(list(alike))} are the same (this was checked), so results are "
                "comparable."
            )
        differ = listed([name for name, same in alike.items() if not same])
        if len(known) == len(optima):
            return f"Their {differ} differ, too: each regret is a share of the agent's own optimum."
        return f"Their {differ} differ, too: returns are not comparable."

    def _open(self, name: str) -> Run:
        """The agent's run, from its last checkpoint if there is one."""
        entrant, place = self.entrants[name], self.place(name)
        if (place / CONFIG).exists():
            return Run.open(place)
        return Run.create(
            entrant.task,
            entrant.agent,
            budget=entrant.budget,
            seeds=self.config.seeds,
            seed=self.config.seed,
            preset=entrant.preset,
            out=place,
        )

    def _write(self) -> None:
        results = {name: self.results[name] for name in self.entrants if name in self.results}
        ranking = rank(results) if len(results) > 1 and self.finished else None
        self.config = msgspec.structs.replace(
            self.config,
            results=results,
            failures=dict(self.failures),
            ranking=ranking,
            conclusion=conclusion(ranking) if ranking else [],
            notes=self.notes() if ranking else [],
        )
        write_config(self.folder / FILE, self.config)


def _require_fit(name: str, entrant: Entrant, seeds: int) -> None:
    """Raises QfolioError if an agent cannot learn the task; traces programs, runs none."""
    try:
        state = jax.eval_shape(partial(begin, entrant.task, entrant.agent), jnp.uint32(0))
        compiled = entrant.task.compiled
        devices.require_memory(state, devices.Members(seeds).slots if compiled else seeds)
    except QfolioError as error:
        raise QfolioError(f"{name}: {error}") from None


def _entrant(task: str, entry: EntrantConfig) -> Entrant:
    return Entrant(
        task_of(task, entry.task_settings),
        agent_of(entry.agent, entry.agent_settings),
        entry.preset,
        Budget(entry.episodes, entry.steps),
    )


def _differing(key: str, tasks: dict[str, dict[str, Any]]) -> str | None:
    """The values of a task's setting and the agents that have them; None if all are the same."""
    values: dict[str, list[str]] = {}
    for name, entry in tasks.items():
        value = entry[key]
        values.setdefault("empty" if value == "" else str(value), []).append(name)
    groups = (f"{value} for {listed(names)}" for value, names in values.items())
    return f"{key} is {', '.join(groups)}" if len(values) > 1 else None


def _measures(result: Result) -> dict[str, float | None]:
    """The measures of a result in the log: interquartile means over seeds, as in the ranking."""
    final = float(interquartile_mean(result.returns))
    missed = regret(final, result.optimum)
    known = {"return": final, "optimum": result.optimum}
    return {**known, "regret": None if missed is None else float(missed)}


def _same(first: Any, second: Any) -> bool:
    """Whether two pytrees hold the same numbers."""
    pair = jax.tree.leaves(first), jax.tree.leaves(second)
    return len(pair[0]) == len(pair[1]) and all(map(np.array_equal, *pair))
