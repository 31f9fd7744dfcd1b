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
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from qfolio.core import devices, settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.files import (
    new_folder,
    read_json,
    read_tree,
    require_types,
    write_json,
    write_tree,
)
from qfolio.core.mdp import Agent, Task
from qfolio.core.population import Population
from qfolio.core.registry import AGENTS, TASKS, name_of
from qfolio.core.training import TrainingState
from qfolio.core.version import __version__
from qfolio.experiments.comparison.ranking import middle_steps, regret, steps_within
from qfolio.experiments.run import check_counts, configured_agent, configured_task
from qfolio.learning.optimizer import Optimizer

FORMAT = 1
"""Of continual.json."""

FILE, LEARNED = "continual.json", "learned.safetensors"

NUMBERS = ("episodes", "seeds", "seed", "rate", "renewal", "epsilon")
"""Of a plan, as continual.json holds them."""

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
        check_counts(self.episodes, self.seeds, self.seed)
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

    @classmethod
    def of(cls, content: dict[str, Any]) -> "Plan":
        """The plan that a continual.json tells."""
        after = {name: new for name, (_, new) in content["changes"].items()}
        changed = {**content, "task_settings": content["task_settings"] | after}
        return cls(
            configured_task(content),
            configured_task(changed),
            configured_agent(content),
            **{name: content[name] for name in NUMBERS},
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

    def _set(self, **changes: float) -> Agent:
        return dataclasses.replace(self.agent, **changes)


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


class Course(NamedTuple):
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


WAYS = {
    "frozen": "the policy as it is",
    "going on": "the same memory, a small learning rate",
    "renewed": "an empty memory, schedules begun again",
    "fresh": "a new agent",
}

Listener = Callable[[str, float], None]
"""Called with what is under way and how much of it is done."""


def create(plan: Plan, folder: Path, command: str = "") -> None:
    """Makes the new or empty folder that ``compare`` works in.

    command: what was typed to start it, for the report.
    """
    content = {
        "format": FORMAT,
        "version": __version__,
        "task": name_of(TASKS, plan.task),
        "task_settings": settings.describe(plan.task),
        "changes": plan.changes,
        "agent": name_of(AGENTS, plan.agent),
        "agent_settings": settings.describe(plan.agent),
        **{name: getattr(plan, name) for name in NUMBERS},
        **devices.circumstances(),
        "starts": Population.starts,
        "curve_starts": Population.curve_starts,
        "within": WITHIN,
        "command": command,
        "courses": {},
        "recovery": {},
    }
    with new_folder(folder) as place:
        write_json(place / FILE, content)


def compare(folder: Path, listener: Listener = lambda name, share: None) -> dict[str, Any]:
    """Trains, changes the world and goes on in every way; all that a report shows, as JSON values.

    What the folder already holds is not done again. Raises QfolioError where a loss is not finite.
    """
    content = _read(folder)
    plan, courses = Plan.of(content), content["courses"]
    seeds = range(plan.seed, plan.seed + plan.seeds)
    grades = Grades(plan.task), Grades(plan.changed)
    first = Population(plan.task, plan.agent, seeds)
    missing = [way for way in WAYS if way not in courses]
    if "training" not in content:
        training = _learn(first, plan.episodes, 1, grades, partial(listener, "first training"))
        write_tree(folder / LEARNED, first.fetch())
        content["optimum"] = {"old": grades[0].optimum, "new": grades[1].optimum}
        content["training"] = training._asdict()
        write_json(folder / FILE, content)
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
        episodes = round(share * plan.episodes)
        course = _learn(population, episodes, POINTS, grades[::-1], partial(listener, way))
        courses[way], content["recovery"][way] = course._asdict(), recovery(course)
        write_json(folder / FILE, content)
    (folder / LEARNED).unlink(missing_ok=True)
    return content


def _read(folder: Path) -> dict[str, Any]:
    """What continual.json says, or QfolioError where ``folder`` has none of this version."""
    path = folder / FILE
    if not path.is_file():
        raise QfolioError(f"{folder} is no change of a task: it has no {FILE}.")
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise QfolioError(f"{path} was written in another format; start anew.")
    wanted: dict[str, Any] = {"task": str, "task_settings": dict, "changes": dict, "agent": str,
              "agent_settings": dict, "episodes": int, "seeds": int, "seed": int,
              "courses": dict, "recovery": dict}  # fmt: skip
    wanted |= dict.fromkeys(("rate", "renewal", "epsilon"), float | int)
    try:
        require_types(content, wanted)
    except QfolioError as error:
        raise QfolioError(f"{path} is damaged: {error}") from None
    return content


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


def _learn(
    population: Population,
    episodes: int,
    points: int,
    grades: tuple[Grades, Grades],
    tell: Callable[[float], None],
) -> Course:
    """Learns ``episodes`` more, graded now and then; grades: of this world and the other one."""
    here, there = grades
    begun, end, seconds = population.steps, population.episodes + episodes, 0.0
    left = total = population.steps_left(end)
    steps, curve = [0], [here.regrets(population, population.curve_starts)]
    while left > 0:
        compiled, start = population.seconds_compile, perf_counter()
        population.advance(min(left, -(-total // points)))
        seconds += perf_counter() - start - (population.seconds_compile - compiled)
        left = population.steps_left(end)
        done = population.steps - begun
        steps.append(done * population.agent.num_envs)
        curve.append(here.regrets(population, population.curve_starts))
        tell(done / (done + left))
    final, other = (world.regrets(population, population.starts) for world in (here, there))
    return Course(steps, curve, final, other, seconds)
