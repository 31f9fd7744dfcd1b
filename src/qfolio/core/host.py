"""The training loop for environments that cannot be compiled: the counterpart of ``training.py``.

The agents are the same. One compiled program takes the finished rollout, learns from it and returns
the next actions; Python steps the environments of Gymnasium in between. Members take turns: while
the programs of some compute, Python steps the environments of another.
"""

import abc
import contextlib
from collections.abc import Callable, Generator, Hashable, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable
from weakref import finalize

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Key, PyTree

from qfolio.core.devices import compiled, keyed, unkeyed
from qfolio.core.errors import QfolioError, one_line
from qfolio.core.evaluation import Greedy
from qfolio.core.mdp import Agent, Task, Transition
from qfolio.core.population import Population, programs_of
from qfolio.core.registry import name_of
from qfolio.core.training import (
    Episodes,
    TrainingState,
    absorb,
    begin,
    episode_steps,
    healthy,
    step_keys,
)

T = TypeVar("T")

CHUNK = 200
"""Least number of steps in a chunk (rounded up to whole rollouts)."""

LARGEST = float(np.finfo(np.float32).max)
"""The largest number in single precision, in which agents learn."""

LANES = 10
"""Environments that are stepped side by side when a member is evaluated."""


@runtime_checkable
class Facts(Protocol):
    """How observations and actions are translated between an environment and agents."""

    def given(self, actions: np.ndarray) -> list[Any]:
        """A batch of agents' actions in the environment's format."""
        ...

    def seen(self, observation: Any) -> Any:
        """An environment's observation in the agents' format."""
        ...


class HostTask(Task):
    """A task whose environment is stepped from Python, by Gymnasium's interface."""

    compiled = False

    @property
    @abc.abstractmethod
    def facts(self) -> Facts:
        """How observations and actions are translated."""

    @property
    @abc.abstractmethod
    def observation(self) -> tuple[tuple[int, ...], type]:
        """Shape and type of an observation."""

    @property
    def referents(self) -> Hashable:
        """What programs know of the environment: another one may be registered with its ID."""
        return self.observation, self.states, self.observation_scale, self.actions

    @abc.abstractmethod
    def make(self, **options: Any) -> Any:
        """A new environment without a time limit; ``options`` are arguments of its constructor."""


class Outcome(NamedTuple):
    """The result of stepping environments; ``observation`` is from before any reset."""

    reward: Float[np.ndarray, " environment"]
    observation: np.ndarray  # (environment, ...)
    terminated: Bool[np.ndarray, " environment"]
    truncated: Bool[np.ndarray, " environment"]


class Environments:
    """Environments of one task, stepped one after another.

    limit: steps after which an episode is truncated. observation: the current observations.

    All methods raise a QfolioError, which names the task and the step, if an environment fails or
    returns an observation of the wrong shape or a number that is not finite.
    """

    def __init__(self, task: HostTask, limit: int, count: int) -> None:
        self._name, self._facts, self._limit = name_of(task), task.facts, limit
        self._environments = [task.make() for _ in range(count)]
        # Closed when nothing refers to them any more; at exit the process frees what they hold.
        finalize(self, _close, self._environments).atexit = False
        self._steppers = [environment.step for environment in self._environments]
        shape, kind = task.observation
        self.observation: np.ndarray = np.zeros((count, *shape), kind)
        self._steps = np.zeros(count, np.int32)

    def reset(self, index: int, seed: int | None = None) -> None:
        """Starts an episode in one environment."""
        self._steps[index] = 0
        try:
            observation, _ = self._environments[index].reset(seed=seed)
            self.observation[index] = self._seen(observation)
        except Exception as error:
            raise self._failure(index, error) from error
        if not np.isfinite(self.observation[index]).all():
            raise self._failure(index, "its observation is not finite")

    def step(self, actions: np.ndarray, which: Iterable[int] | None = None) -> Outcome:
        """Steps all environments, or only those in ``which``; resets none."""
        count = len(self._steppers)
        reward = np.zeros(count)
        terminated, truncated = np.zeros(count, bool), np.zeros(count, bool)
        after = np.zeros_like(self.observation)
        given = self._facts.given(actions)
        self._steps += 1
        for i in range(count) if which is None else which:
            try:
                result = self._steppers[i](given[i])
                if len(result) != 5:
                    raise QfolioError(
                        f"its step returned {len(result)} values; wanted are observation, reward, "
                        "terminated, truncated and info"
                    )
                observation, paid, terminated[i], truncated[i], _ = result
                if not isinstance(paid, float):
                    _require_number(paid)
                reward[i] = paid
                after[i] = self._seen(observation)
            except Exception as error:
                raise self._failure(i, error) from error
        self._require_finite(after, reward)
        self.observation = after
        truncated = (truncated | (self._steps >= self._limit)) & ~terminated
        return Outcome(reward.astype(np.float32), after, terminated, truncated)

    def restart(self, finished: Bool[np.ndarray, " environment"]) -> None:
        """Resets the finished environments; arrays returned before stay unchanged."""
        if finished.any():
            self.observation = self.observation.copy()
            for i in np.flatnonzero(finished).tolist():
                self.reset(i)

    def _seen(self, observation: Any) -> Any:
        """The agents' observation; numpy would broadcast a wrong shape without this check."""
        seen, wanted = self._facts.seen(observation), self.observation.shape[1:]
        if np.shape(seen) != wanted:
            raise QfolioError(
                f"its observation has the shape {np.shape(seen)} and its observation space {wanted}"
            )
        return seen

    def _require_finite(self, after: np.ndarray, reward: np.ndarray) -> None:
        """Raises QfolioError if an environment returned a number that is not finite in float32."""
        paid = np.abs(reward) <= LARGEST  # False for NaN
        if np.isfinite(after).all() and paid.all():
            return
        for i in range(len(reward)):
            for what, fine in (("observation", np.isfinite(after[i]).all()), ("reward", paid[i])):
                if not fine:
                    raise self._failure(i, f"its {what} is not finite in single precision")

    def _failure(self, index: int, reason: str | Exception) -> QfolioError:
        if isinstance(reason, QfolioError):
            reason = str(reason)
        elif isinstance(reason, Exception):
            reason = one_line(reason)
        step = int(self._steps[index])
        where = f"at step {step} of an episode" if step else "at the start of an episode"
        return QfolioError(f"{self._name} failed {where}: {reason}.")


def _require_number(paid: Any) -> None:
    """Raises QfolioError for a reward that numpy would take for NaN, or for a row of numbers."""
    if paid is None:
        raise QfolioError("its reward is None, which is no number")
    if np.shape(paid):
        raise QfolioError(f"its reward has the shape {np.shape(paid)}; it must be one number")
    if isinstance(paid, str | bytes):
        raise QfolioError(f"its reward is the text {paid!r}, which is no number")


def _close(environments: Iterable[Any]) -> None:
    for environment in environments:
        with contextlib.suppress(Exception):  # nobody waits for its result
            environment.close()


class HostPopulation(Population):
    """A population whose task is stepped from Python.

    After ``restore``, and after an exception of an environment, agents keep what they learned, but
    environments start new episodes.
    """

    starts, curve_starts = 100, 10
    task: HostTask

    def _begin(self, own: list[np.ndarray], shared: list[Any], form: Hashable) -> None:
        length = self.agent.rollout_steps
        self._rows = length * -(-CHUNK // length)
        self._programs = programs_of((form, "host", self._rows))
        self._require_memory()
        self._own = [jax.device_put([x[i] for x in own]) for i in range(len(self.seeds))]
        self._shared = shared
        self._states = [
            self._start("begin", begin, seed, own, once=True)
            for seed, own in zip(np.array(self.seeds, np.uint32), self._own, strict=True)
        ]
        self._environments: list[Environments] = []
        self._judges: list[Environments] = []

    @property
    def _held(self) -> int:
        return len(self.seeds)

    def restore(self, state: TrainingState) -> None:
        self._states = [
            keyed(jax.device_put(jax.tree.map(lambda x, i=i: x[i], state)), old)
            for i, old in enumerate(self._states)
        ]
        self._leave_episodes()

    def advance(self, steps: int, *, strict: bool = True) -> Episodes:
        if not self._environments:
            self._environments = [self._make(seed) for seed in self.seeds]
            if self.steps:  # of earlier environments
                self._cut()
        steps, learning = self._plan(steps, self._rows)
        players = [self._play(member, steps, learning) for member in range(len(self.seeds))]
        try:
            records = _stack(_take_turns(players))
        except BaseException:
            self._leave_episodes()
            raise
        if strict:
            self._require_healthy()
        return records

    def task_fault(self, member: int = 0) -> None:
        """None: what an environment returns is checked at each step."""

    def policy(self, member: int = 0) -> Callable[[Any], Any]:
        """Takes an observation, and returns the action, in the environment's own format."""
        inner, facts, (_, kind) = super().policy(member), self.task.facts, self.task.observation

        def policy(observation: Any) -> Any:
            return facts.given(inner(np.asarray(facts.seen(observation), kind))[None])[0]

        return policy

    def _member(self, member: int) -> tuple[Task, Agent]:
        found: tuple[Task, Agent] = self._join(self._own[member], self._shared)
        return found

    def evaluate(self, keys: Key[Array, " start"], tail: int | None = None) -> Greedy:
        """Greedy returns (member, start) from environments seeded by the keys.

        The overestimation is NaN, because rewards after a time limit are not observed; ``tail`` has
        no effect.
        """
        if not self._judges:
            limit = self.task.horizon
            self._judges = [Environments(self.task, limit, LANES) for _ in self.seeds]
        seeds = np.asarray(jax.random.key_data(keys))[:, -1].tolist()
        judged = _take_turns([self._judge(member, seeds) for member in range(len(self.seeds))])
        unknown: Any = np.full(len(self.seeds), np.nan)
        return Greedy(_stack(judged), unknown)

    def _leave_episodes(self) -> None:
        """Lets the next step begin new episodes, in new environments."""
        self._environments = []
        self._states = [
            eqx.tree_at(lambda s: s.tally, state, jax.tree.map(jnp.zeros_like, state.tally))
            for state in self._states
        ]

    def _cut(self) -> None:
        """Tells the agents that their episodes were cut off."""
        cut = eqx.filter_jit(lambda agent, state: agent.cut(state))
        self._states = [
            eqx.tree_at(lambda s: s.agent, state, cut(self.agent, state.agent))
            for state in self._states
        ]

    def _make(self, seed: int) -> Environments:
        """A member's environments; all their randomness derives from its seed and step."""
        limit, count = episode_steps(self.task, self.agent), self.agent.num_envs
        environments = Environments(self.task, limit, count)
        for i in range(count):
            entropy = np.random.SeedSequence((seed, i, self.steps))
            environments.reset(i, int(entropy.generate_state(1)[0]))
        return environments

    def _play(self, member: int, steps: int, learning: bool) -> Generator[None, None, Episodes]:
        """Plays some steps of a member; yields while its programs compute."""
        length, name = self.agent.rollout_steps, "learn" if learning else "collect"
        environments, own = self._environments[member], self._own[member]
        state = self._states[member]
        # jax flattens its arguments at each call: a list of arrays is faster than modules.
        carry, form = jax.tree.flatten((state, self._blank(state)))

        def act(task: Task, agent: Agent, carry: PyTree, seen: Array, time: Array) -> Array:
            state, _ = jax.tree.unflatten(form, carry)
            return agent.act(state.agent, seen, step_keys(state.key, state.steps + time)[0])

        def learn(
            task: Task, agent: Agent, carry: PyTree, rollout: Transition, seen: Array, row: Array
        ) -> tuple[PyTree, Array]:
            state, records = jax.tree.unflatten(form, carry)
            state, record = absorb(task, agent, state, rollout, learning=learning)
            put = lambda all, some: lax.dynamic_update_slice_in_dim(all, some, row, 0)  # noqa: E731
            carry = jax.tree.leaves((state, jax.tree.map(put, records, record)))
            return carry, act(task, agent, carry, seen, jnp.int32(0))

        actions = self._start("act", act, carry, own, environments.observation, np.int32(0))
        try:
            for row in range(0, steps, length):
                rollout = []
                for time in range(1, length + 1):
                    yield
                    seen, action = environments.observation, np.asarray(actions)
                    outcome = environments.step(action)
                    rollout.append((seen, action, *outcome))
                    environments.restart(outcome.terminated | outcome.truncated)
                    seen = environments.observation
                    if time < length:
                        actions = self._start("act", act, carry, own, seen, np.int32(time))
                before, action, *outcomes = map(_stack_rows, zip(*rollout, strict=True))
                reward, after, terminated, truncated = outcomes
                transition = Transition(
                    (), before, action, reward, (), after, terminated, truncated
                )
                inputs = transition, seen, np.int32(row)
                carry, actions = self._start(name, learn, carry, own, *inputs, donate=True)
        finally:  # also after an exception: the state at the beginning has been donated
            state, records = jax.tree.unflatten(form, carry)
            self._states[member] = state

        def check(task: Task, agent: Agent, state: TrainingState) -> Array:
            return healthy(agent, state)

        fine = self._start("healthy", check, state, own)
        self._states[member] = eqx.tree_at(lambda s: s.healthy, state, fine)
        return records

    def _judge(self, member: int, seeds: list[int]) -> Generator[None, None, np.ndarray]:
        """Returns of a member's greedy policy from each seed."""
        environments, own = self._judges[member], self._own[member]
        weights = self.agent.weights(self._states[member].agent)

        def policy(task: Task, agent: Agent, weights: PyTree, seen: Array) -> Array:
            return agent.policy(weights, seen)

        returns = np.zeros(len(seeds))
        for first in range(0, len(seeds), LANES):
            some = seeds[first : first + LANES]
            running = list(range(len(some)))
            for i in running:
                environments.reset(i, some[i])
            while running:
                actions = self._start("policy", policy, weights, own, environments.observation)
                yield
                outcome = environments.step(np.asarray(actions), running)
                returns[first : first + LANES] += outcome.reward[: len(some)]
                over = outcome.terminated | outcome.truncated
                running = [i for i in running if not over[i]]
        return returns

    def _blank(self, state: TrainingState) -> Episodes:
        """Empty records of a chunk."""
        shape = (self._rows, self.agent.num_envs)
        monitored = jax.eval_shape(self.agent.monitor, state.agent)
        zeros: Any = np.zeros(shape, np.float32)
        never: Any = np.zeros(shape, bool)
        metrics = dict.fromkeys(monitored | state.tally.metrics | state.tally.measured, zeros)
        return Episodes(never, zeros, metrics)

    def _fetch(self, where: Callable[[TrainingState], PyTree]) -> PyTree:
        return _stack([where(state) for state in self._states])

    def _compile(
        self, one: Callable[..., Any], *args: Any, donate: bool = False, once: bool = False
    ) -> Any:
        program = jax.jit(one, donate_argnums=0 if donate else ())
        return compiled(program.lower(*args), once=once)

    def _call(self, program: Any, *args: Any) -> Any:
        return program(*args)


def population_of(
    task: Task, agents: Agent | Sequence[Agent], seeds: Sequence[int], room: int = 0
) -> Population:
    """A population on a task, compiled or stepped from Python as the task requires."""
    kind = HostPopulation if isinstance(task, HostTask) else Population
    return kind(task, agents, seeds, room)


def _stack(members: Sequence[PyTree]) -> PyTree:
    return jax.tree.map(lambda *x: np.stack([unkeyed(one) for one in x]), *members)


def _stack_rows(rows: Sequence[np.ndarray]) -> Any:
    """Stacks the arrays of steps along a leading time axis."""
    return np.stack(rows) if len(rows) > 1 else rows[0][None]


def _take_turns(players: Sequence[Generator[None, None, T]]) -> list[T]:
    """Resumes the players in turn until all have returned."""
    results: dict[int, T] = {}
    try:
        while len(results) < len(players):
            for i, player in enumerate(players):
                if i not in results:
                    try:
                        next(player)
                    except StopIteration as end:
                        results[i] = end.value
    finally:
        for player in players:
            player.close()  # if another has failed
    return [results[i] for i in range(len(players))]
