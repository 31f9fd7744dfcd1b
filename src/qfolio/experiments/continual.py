"""Continual learning: adaptation to a world that changes after training.

A task's numbers (such as the mass of a pendulum) change when training is over. Four ways to adapt
are compared in the changed world, against its own exact optimum: the policy as it is; continued
learning with the same replay buffer; renewed learning, which keeps the weights, empties the buffer
and restarts the schedules; and a fresh agent. Forgetting is measured in the old world.

The folder holds continual.json (settings, written at the start; the first training and each way,
added when finished), learned.safetensors (the state after the first training, until every way is
finished) and, at the end, the report.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from qfolio.core import devices, settings
from qfolio.core.config import Config, read_config, write_config
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.files import locked, new_folder, read_tree, write_tree
from qfolio.core.mdp import Agent, Task
from qfolio.core.population import Population
from qfolio.core.statistics import regret
from qfolio.core.training import TrainingState
from qfolio.experiments.budget import SCHEDULES, Budget, seed_range, unlearned
from qfolio.experiments.comparison.ranking import middle_steps, steps_within
from qfolio.experiments.described import agent_of, describe, plain, require_described, task_of
from qfolio.experiments.fit import Listener, Training, fit
from qfolio.experiments.grading import optimal_returns
from qfolio.experiments.log import JobLog, Log, seed_names
from qfolio.experiments.records import Records
from qfolio.learning.optimizer import Optimizer

FILE, LEARNED = "continual.json", "learned.safetensors"

POINTS = 24
"""Approximate number of points on each learning curve after the change."""

WITHIN = 0.1
"""A seed has recovered when its regret in the changed world stays below this."""


@dataclass(frozen=True)
class Plan:
    """The experiment: ``agent`` learns ``task``, which then becomes ``changed``.

    rate: learning rate after the change, as a share of the initial one. renewal: length of a
    renewed agent's training, as a share of the first. epsilon: the renewed agent's initial
    exploration, if it explores ε-greedily.
    """

    task: Task
    changed: Task
    agent: Agent
    episodes: int
    seeds: int = 8
    seed: int = 0
    rate: float = 0.3
    renewal: float = 0.5
    epsilon: float = 0.3

    def __post_init__(self) -> None:
        _ = Budget(self.episodes), seed_range(self.seeds, self.seed)
        for name in ("rate", "renewal", "epsilon"):
            if not 0 < getattr(self, name) <= 1:
                raise QfolioError(
                    f"{name} is {getattr(self, name)}; it must be above 0 and at most 1."
                )
        if jax.tree.structure(self.task) != jax.tree.structure(self.changed):  # type: ignore[operator]
            raise QfolioError(
                "only numbers of a task may change, because its compiled program stays the same; "
                f"{type(self.task).__name__} has {', '.join(_numbers(self.task)) or 'none'}."
            )
        if not self.changes:
            raise QfolioError(
                "nothing changes; give one of the task's numbers a new value, as in mass=2."
            )
        _require_schedule(self.agent)
        if any(task.optimum() is None for task in (self.task, self.changed)):
            raise QfolioError(
                f"recovery is measured against an exact optimum, but {type(self.task).__name__} "
                "has none; use the pendulum."
            )

    @property
    def changes(self) -> dict[str, tuple[Any, Any]]:
        """The settings that change: their values before and after, by name."""
        before, after = settings.describe(self.task), settings.describe(self.changed)
        return {k: (v, after[k]) for k, v in before.items() if v != after[k]}

    @property
    def going_on(self) -> Agent:
        """The agent, with a learning rate of ``rate`` times the initial one from now on."""
        return self._set(learning_rate_final=self.rate, learning_rate_steps=1.0)

    @property
    def renewed(self) -> Agent:
        """The agent, with shorter schedules and less exploration."""
        own = [name for name in SCHEDULES if hasattr(self.agent, name)]
        agent = self._set(**{name: self.renewal * getattr(self.agent, name) for name in own})
        if isinstance(epsilon := getattr(agent, "epsilon_start", None), float):
            agent = dataclasses.replace(agent, epsilon_start=min(epsilon, self.epsilon))
        return agent

    def _set(self, **changes: float) -> Any:
        agent: Any = self.agent
        return dataclasses.replace(agent, **changes)


def _require_schedule(agent: Agent) -> None:
    """Raises QfolioError for an agent whose learning rate has no schedule."""
    found = (getattr(agent, f"learning_rate_{name}", None) for name in ("final", "steps"))
    if not all(isinstance(value, float) for value in found):
        raise QfolioError(
            f"{type(agent).__name__} has no learning-rate schedule, which continuing requires; use "
            "an agent with a network, such as dqn."
        )


def _numbers(task: Task) -> list[str]:
    """The settings that are inputs of the compiled program."""
    inputs = {each.name for each in dataclasses.fields(task) if not each.metadata.get("static")}
    return [name for name in settings.describe(task) if name in inputs]


class Course(msgspec.Struct):
    """The results of all seeds for one way to adapt.

    steps: environment steps of a seed since the change. curve: regrets (point, seed) on the
    first start states. final: regrets (seed,) on all of them; other: the same in the other world
    (after the change, the old one). seconds: time spent learning, all seeds together. unlearned: as
    the function of that name says it, of learning that began anew.
    """

    steps: list[int]
    curve: list[list[float]]
    final: list[float]
    other: list[float]
    seconds: float
    unlearned: str = ""


FIRST = "first training"

WAYS = {
    "frozen": "the policy, unchanged",
    "going on": "the same replay buffer, a small learning rate",
    "renewed": "an empty replay buffer, restarted schedules",
    "fresh": "a new agent",
}


class ContinualConfig(Config, frozen=True):
    """The content of continual.json: the plan, and the results so far."""

    kind: ClassVar[str] = "continual"
    format: ClassVar[int] = 2

    task: str
    task_settings: dict[str, Any]
    changes: dict[str, tuple[Any, Any]]
    agent: str
    agent_settings: dict[str, Any]
    episodes: int
    seeds: int
    seed: int
    rate: float
    renewal: float
    epsilon: float
    device: str
    started: str
    starts: int
    curve_starts: int
    within: float
    command: str
    optimum: dict[str, float] = msgspec.field(default_factory=dict)
    training: Course | None = None
    courses: dict[str, Course] = msgspec.field(default_factory=dict)
    recovery: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)

    @classmethod
    def of(cls, plan: Plan, command: str) -> "ContinualConfig":
        """The configuration of a plan, before any result."""
        return cls(
            **describe(plan.task, plan.agent),
            changes=plan.changes,
            episodes=plan.episodes,
            seeds=plan.seeds,
            seed=plan.seed,
            rate=plan.rate,
            renewal=plan.renewal,
            epsilon=plan.epsilon,
            **devices.circumstances(),
            starts=Population.starts,
            curve_starts=Population.curve_starts,
            within=WITHIN,
            command=command,
        )

    def plan(self) -> Plan:
        """The plan that this configuration describes."""
        after = {name: new for name, (_, new) in self.changes.items()}
        return Plan(
            task_of(self.task, self.task_settings),
            task_of(self.task, plain(self.task_settings) | after),
            agent_of(self.agent, self.agent_settings),
            self.episodes,
            self.seeds,
            self.seed,
            self.rate,
            self.renewal,
            self.epsilon,
        )


def create(plan: Plan, folder: Path, command: str = "") -> None:
    """Creates the folder that ``compare`` works in; an empty one may exist already.

    command: the command that started it, for the report.
    """
    require_described("Continual learning", plan.task, plan.changed, plan.agent)
    config = ContinualConfig.of(plan, command)
    with new_folder(folder) as place:
        write_config(place / FILE, config)


def read(folder: Path) -> ContinualConfig:
    """The plan of a folder, and its results so far; raises QfolioError if it is no such folder."""
    return read_config(folder / FILE, ContinualConfig)


def compare(folder: Path, listen: Callable[[str], Listener] | None = None) -> dict[str, Any] | None:
    """Trains, changes the world and adapts in every way; returns the report's data as JSON values.

    Results that the folder already holds are not computed again. Returns None if Ctrl-C stopped it.
    Raises QfolioError if a loss is not finite.

    listen: called with the name of each training; returns its listener.
    """
    if not (folder / FILE).is_file():
        read(folder)  # raises if this is no such folder
    with locked(folder):
        state = read(folder)
        about = {"kind": state.kind, "task": state.task, "agents": [state.agent]}
        with Log(folder).opened(**about, seeds=state.seeds) as log:
            result = _compare(folder, state, listen, log)
            log.settle(result is not None)
            return result


def _compare(
    folder: Path, state: ContinualConfig, listen: Callable[[str], Listener] | None, log: Log
) -> dict[str, Any] | None:
    plan = state.plan()
    seeds = seed_range(plan.seeds, plan.seed)

    def keep(**results: Any) -> None:
        nonlocal state
        state = msgspec.structs.replace(state, **results)
        write_config(folder / FILE, state)

    def learn(
        name: str, population: Population, episodes: int, points: int
    ) -> tuple[Course | None, bool]:
        worlds = grades if name == FIRST else grades[::-1]
        listeners = [] if listen is None else [listen(name)]
        job = log.job(name, seed_names(seeds), population.env_steps)
        return _learn(population, episodes, points, worlds, job, listeners)

    grades = Grades(plan.task), Grades(plan.changed)
    first = Population(plan.task, plan.agent, seeds)
    missing = [way for way in WAYS if way not in state.courses]
    log.queue([*([FIRST] if state.training is None else []), *missing])
    if state.training is None:
        training, stopped = learn(FIRST, first, plan.episodes, 1)
        if training is None:
            return None
        write_tree(folder / LEARNED, first.fetch())
        keep(optimum={"old": grades[0].optimum, "new": grades[1].optimum}, training=training)
        if stopped:
            return None
    elif missing:
        first.restore(read_tree(folder / LEARNED, first.fetch()))
    learned = first.fetch()
    for way in missing:
        agent = {"going on": plan.going_on, "renewed": plan.renewed}.get(way, plan.agent)
        population = Population(plan.changed, agent, seeds)
        if way == "renewed":
            population.restore(renew(agent, learned, population.fetch()))
        elif way != "fresh":
            population.restore(learned)
        share = {"frozen": 0.0, "renewed": plan.renewal}.get(way, 1.0)
        course, stopped = learn(way, population, round(share * plan.episodes), POINTS)
        if course is None:
            return None
        keep(
            courses={**state.courses, way: course},
            recovery={**state.recovery, way: recovery(course)},
        )
        if stopped and way != missing[-1]:
            return None
    (folder / LEARNED).unlink(missing_ok=True)
    return msgspec.to_builtins(state)


def recovery(course: Course) -> dict[str, Any]:
    """Environment steps from the change until each seed's regret stays within ``WITHIN``.

    per_seed: None if it never does. middle: the interquartile mean; None if more than a quarter of
    the seeds never do.
    """
    steps = steps_within(course.steps, np.array(course.curve), WITHIN)
    return {"per_seed": steps, "middle": middle_steps(steps)}


def renew(agent: Agent, learned: TrainingState, fresh: TrainingState) -> TrainingState:
    """Members before their first step with the weights of ``learned``.

    Stored experience is dropped; the optimizer and all counters, which set the schedules, are those
    of ``fresh``.
    """

    def is_optimizer(x: Any) -> bool:
        return type(x) is Optimizer

    def choose(old: Any, new: Any) -> Any:
        begun = is_optimizer(new) or jnp.issubdtype(new.dtype, jnp.integer)
        return new if begun else old

    kept = agent.carry_over(learned.agent, fresh.agent)
    renewed = jax.tree.map(choose, kept, fresh.agent, is_leaf=is_optimizer)
    return eqx.tree_at(lambda state: state.agent, fresh, renewed)


class Grades:
    """The exact optimum of one world, and the regrets of policies in it.

    Raises QfolioError if the optimum is 0, of which there are no shares.
    """

    def __init__(self, task: Task) -> None:
        best = optimal_returns(task, start_keys())
        assert best is not None
        self.task, self._best = task, best
        counts = Population.starts, Population.curve_starts
        if not all(self._best[:starts].mean() for starts in counts):
            raise QfolioError(
                f"Recovery is measured in shares of the optimum, but that of {task} is 0; "
                "choose another task or change."
            )

    @property
    def optimum(self) -> float:
        return float(self._best.mean())

    def regrets(self, population: Population, starts: int) -> list[float]:
        """Regrets of the members' policies in this world, on the first start states."""
        if population.task is not self.task:
            learned = population.fetch()
            population = Population(self.task, population.agent, population.seeds)
            population.restore(learned)
        returns = population.evaluate(start_keys(starts), tail=0).returns.mean(1)
        found = regret(returns, float(self._best[:starts].mean()))
        assert found is not None
        return found.tolist()


class _Curve(Listener):
    """Grades the policies after each chunk."""

    def __init__(self, world: Grades, job: JobLog) -> None:
        self.world, self.job = world, job
        self.steps: list[int] = []
        self.regrets: list[list[float]] = []

    def add(self, population: Population, steps: int) -> None:
        self.steps.append(steps * population.agent.num_envs)
        self.regrets.append(self.world.regrets(population, population.curve_starts))
        self.job.record(population.env_steps, {"greedy regret": self.regrets[-1]})

    def on_chunk(self, training: Training, rows: Records) -> None:
        self.add(training.population, training.done)


def _learn(
    population: Population,
    episodes: int,
    points: int,
    worlds: tuple[Grades, Grades],
    job: JobLog,
    listeners: list[Listener],
) -> tuple[Course | None, bool]:
    """Learns for ``episodes`` more, with regular grading.

    Returns what it learned, None if it was stopped before the end, and whether Ctrl-C was pressed.

    worlds: the world learned in, and the other one.
    """
    here, there = worlds
    curve = _Curve(here, job)
    curve.add(population, 0)
    seconds, stopped, anew = 0.0, False, not population.steps
    if episodes:
        budget = Budget(population.episodes + episodes)
        chunk = -(-budget.left(population) // points)
        training = fit(population, budget, [job, curve, *listeners], chunk=chunk)
        seconds, stopped = training.seconds, training.interrupted
        if stopped and not training.finished:
            return None, True
    else:
        job.log.write("done", job=job.name, step=population.env_steps)
    final, other = (world.regrets(population, population.starts) for world in (here, there))
    why = unlearned(population.agent, curve.steps[-1]) if anew else ""
    return Course(curve.steps, curve.regrets, final, other, seconds, why), stopped
