"""Continual learning: the world changes after training, and what an agent can do about it.

A task's numbers (the mass of a pendulum) change when training is over. Four ways to go on are
compared in the changed world, against its own exact optimum: the policy as it is; learning on from
the same memory; renewed learning, which keeps what was learned, forgets what was stored and starts
its schedules again; and a fresh agent. What each has forgotten is measured in the old world.

The folder holds continual.json (settings, written at the start; the first training and each way,
added as soon as it is finished), learned.safetensors (what the first training left, until every way
has gone on from it) and, at the end, the report.
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
from qfolio.core.training import TrainingState
from qfolio.experiments.budget import Budget, seed_range
from qfolio.experiments.comparison.ranking import middle_steps, regret, steps_within
from qfolio.experiments.described import agent_of, describe, task_of
from qfolio.experiments.fit import Listener, Row, Training, fit
from qfolio.learning.optimizer import Optimizer

FILE, LEARNED = "continual.json", "learned.safetensors"

POINTS = 24
"""Of a learning curve after the change, about; renewed learning has as many on its shorter way."""

WITHIN = 0.1
"""A seed has recovered when its regret in the changed world stays below."""


@dataclass(frozen=True)
class Plan:
    """What happens: ``agent`` learns ``task`` for some episodes, which then becomes ``changed``.

    rate: share of its initial learning rate that an agent goes on with. renewal: share of its first
    training that a renewed agent learns for. epsilon: how much that one explores at first, where it
    does so by chance.
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
                raise QfolioError(f"{name} is {getattr(self, name)}; it must be from 0 to 1.")
        if jax.tree.structure(self.task) != jax.tree.structure(self.changed):  # type: ignore[operator]
            raise QfolioError(
                "only numbers of a task may change while it is learned, as its program stays; "
                f"of {type(self.task).__name__} these are {', '.join(_numbers(self.task))}."
            )
        if not self.changes:
            raise QfolioError("nothing changes; name one of the task's numbers, as in mass=2.")
        if any(task.optimum() is None for task in (self.task, self.changed)):
            raise QfolioError(
                f"recovery is measured against an exact optimum, and {type(self.task).__name__} "
                "has none; take the pendulum."
            )

    @property
    def changes(self) -> dict[str, tuple[Any, Any]]:
        """Settings of the task before and after."""
        before, after = settings.describe(self.task), settings.describe(self.changed)
        return {k: (v, after[k]) for k, v in before.items() if v != after[k]}

    @property
    def going_on(self) -> Agent:
        """The agent, whose learning rate does not fall below ``rate``."""
        return self._set(learning_rate_final=max(self.rate, _setting(self.agent, "final")))

    @property
    def renewed(self) -> Agent:
        """The agent, whose schedules take a part of their time, and that explores less."""
        steps = self.renewal * _setting(self.agent, "steps")
        agent = self._set(learning_rate_steps=steps)
        if isinstance(epsilon := getattr(agent, "epsilon_start", None), float):
            agent = dataclasses.replace(agent, epsilon_start=min(epsilon, self.epsilon))
        return agent

    def _set(self, **changes: float) -> Any:
        agent: Any = self.agent
        return dataclasses.replace(agent, **changes)


def _setting(agent: Agent, name: str) -> float:
    value = getattr(agent, f"learning_rate_{name}", None)
    if not isinstance(value, float):
        raise QfolioError(
            f"{type(agent).__name__} has no learning rate that falls with time, which is what "
            "going on is about; take an agent with a network, such as dqn."
        )
    return value


def _numbers(task: Task) -> list[str]:
    return [name for name in settings.describe(task) if isinstance(getattr(task, name), float)]


class Course(msgspec.Struct):
    """How the seeds fared in one way to go on.

    steps: since the change, of all environments of a seed. curve: regrets (point, seed) on the
    first start states. final: regrets (seed,) on all of them; other: the same in the other world,
    which is the old one after the change. seconds: of learning, all seeds.
    """

    steps: list[int]
    curve: list[list[float]]
    final: list[float]
    other: list[float]
    seconds: float


FIRST = "first training"

WAYS = {
    "frozen": "the policy as it is",
    "going on": "the same memory, a small learning rate",
    "renewed": "an empty memory, schedules begun again",
    "fresh": "a new agent",
}


class ContinualConfig(Config, frozen=True):
    """The whole of continual.json: what happens, and what has come out so far."""

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
        """What is planned, before anything has come out."""
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
        """The plan that was made."""
        after = {name: new for name, (_, new) in self.changes.items()}
        return Plan(
            task_of(self.task, self.task_settings),
            task_of(self.task, self.task_settings | after),
            agent_of(self.agent, self.agent_settings),
            self.episodes,
            self.seeds,
            self.seed,
            self.rate,
            self.renewal,
            self.epsilon,
        )


def create(plan: Plan, folder: Path, command: str = "") -> None:
    """Makes the new or empty folder that ``compare`` works in.

    command: what was typed to start it, for the report.
    """
    config = ContinualConfig.of(plan, command)
    with new_folder(folder) as place:
        write_config(place / FILE, config)


def compare(folder: Path, listen: Callable[[str], Listener] | None = None) -> dict[str, Any] | None:
    """Trains, changes the world and goes on in every way; all that a report shows, as JSON values.

    What the folder already holds is not done again. None where Ctrl-C stopped it. Raises
    QfolioError where a loss is not finite.

    listen: called with what is under way; makes the listener to that training.
    """
    if not (folder / FILE).is_file():
        read_config(folder / FILE, ContinualConfig)  # says that this is no such folder
    with locked(folder):
        return _compare(folder, listen)


def _compare(folder: Path, listen: Callable[[str], Listener] | None) -> dict[str, Any] | None:
    state = read_config(folder / FILE, ContinualConfig)
    plan = state.plan()

    def keep(**results: Any) -> None:
        nonlocal state
        state = msgspec.structs.replace(state, **results)
        write_config(folder / FILE, state)

    def learn(name: str, population: Population, episodes: int, points: int) -> Course | None:
        worlds = grades if name == FIRST else grades[::-1]
        return _learn(
            population, episodes, points, worlds, [] if listen is None else [listen(name)]
        )

    grades = Grades(plan.task), Grades(plan.changed)
    seeds = seed_range(plan.seeds, plan.seed)
    first = Population(plan.task, plan.agent, seeds)
    missing = [way for way in WAYS if way not in state.courses]
    if state.training is None:
        training = learn(FIRST, first, plan.episodes, 1)
        if training is None:
            return None
        write_tree(folder / LEARNED, first.fetch())
        keep(optimum={"old": grades[0].optimum, "new": grades[1].optimum}, training=training)
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
        course = learn(way, population, round(share * plan.episodes), POINTS)
        if course is None:
            return None
        keep(
            courses={**state.courses, way: course},
            recovery={**state.recovery, way: recovery(course)},
        )
    (folder / LEARNED).unlink(missing_ok=True)
    return msgspec.to_builtins(state)


def recovery(course: Course) -> dict[str, Any]:
    """Environment steps from the change until a seed's regret stays within ``WITHIN``.

    middle: the interquartile mean, None where a quarter of the seeds or more never do.
    """
    steps = steps_within(course.steps, np.array(course.curve), WITHIN)
    return {"per_seed": steps, "middle": middle_steps(steps)}


def renew(agent: Agent, learned: TrainingState, fresh: TrainingState) -> TrainingState:
    """Members before their first step who know what ``learned`` does.

    What was stored is forgotten, and the optimiser and all counters, which schedules follow, are
    those of ``fresh``.
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
    """The exact optimum of one world, and how far policies are from it."""

    def __init__(self, task: Task) -> None:
        solution = task.optimum()
        assert solution is not None
        self.task, self._best = task, solution.returns(start_keys())

    @property
    def optimum(self) -> float:
        return float(self._best.mean())

    def regrets(self, population: Population, starts: int) -> list[float]:
        """Of the members' policies in this world, on the first start states."""
        if population.task is not self.task:
            learned = population.fetch()
            population = Population(self.task, population.agent, population.seeds)
            population.restore(learned)
        returns = population.evaluate(start_keys(starts), tail=0).returns.mean(1)
        return regret(returns, float(self._best[:starts].mean())).tolist()


class _Curve(Listener):
    """Grades the policies after each chunk."""

    def __init__(self, world: Grades) -> None:
        self.world = world
        self.steps: list[int] = []
        self.regrets: list[list[float]] = []

    def add(self, population: Population, steps: int) -> None:
        self.steps.append(steps * population.agent.num_envs)
        self.regrets.append(self.world.regrets(population, population.curve_starts))

    def on_chunk(self, training: Training, rows: list[Row]) -> None:
        self.add(training.population, training.population.steps - training.begun)


def _learn(
    population: Population,
    episodes: int,
    points: int,
    worlds: tuple[Grades, Grades],
    listeners: list[Listener],
) -> Course | None:
    """Learns ``episodes`` more, graded now and then; None where Ctrl-C stopped it.

    worlds: this one and the other one.
    """
    here, there = worlds
    curve = _Curve(here)
    curve.add(population, 0)
    seconds = 0.0
    if episodes:
        budget = Budget(population.episodes + episodes)
        chunk = -(-budget.left(population) // points)
        training = fit(population, budget, [curve, *listeners], chunk=chunk)
        seconds = training.seconds
        if training.interrupted:
            return None
    final, other = (world.regrets(population, population.starts) for world in (here, there))
    return Course(curve.steps, curve.regrets, final, other, seconds)
