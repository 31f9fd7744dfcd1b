"""The training loop: environment, exploration and learning in one compiled program.

``advance`` is that program: any number of steps of one member (one seed of one agent on one task).
A ``Population`` runs it for all members, in chunks, from Python; everything else (progress, files,
Ctrl-C) happens between chunks, and nothing calls back from inside.
"""

import math
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from qfolio.core.devices import Members, require_memory
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import CURVE_STARTS, STARTS, Greedy, evaluate, tail_steps
from qfolio.core.mdp import Agent, Metrics, Task, Transition

CHUNK = 400
"""Steps between two returns to Python, at least (whole episodes)."""


class Tally(NamedTuple):
    """What has been counted since each environment's episode began."""

    steps: Int[Array, " environment"]
    learned: Int[Array, " environment"]  # of these, the steps that learned
    reward: Float[Array, " environment"]
    metrics: dict[str, Float[Array, " environment"]]  # summed over the steps that learned


class TrainingState(eqx.Module):
    """One member's whole training: saved and loaded, it goes on bit for bit."""

    agent: PyTree
    task: PyTree  # (environment, ...)
    tally: Tally
    key: UInt32[Array, "2"]  # constant; each step folds its number in
    steps: Int[Array, ""]  # of each environment, since the beginning
    episodes: Int[Array, ""]  # finished, over all environments
    healthy: Bool[Array, ""]  # metrics and weights have been finite so far


class Episodes(NamedTuple):
    """A record for each step and environment; the values count where ``finished``."""

    finished: Bool[Array, "time environment"]
    returns: Float[Array, "time environment"]
    metrics: dict[str, Float[Array, "time environment"]]  # as monitored, or means over the episode


def begin(task: Task, agent: Agent, seed: Int[Array, ""]) -> TrainingState:
    """A member before its first step; all its randomness derives from ``seed``."""
    agent_key, task_key, key = jax.random.split(jax.random.key(seed), 3)
    state = agent.init(task, agent_key)
    environments = agent.environments
    zeros = jnp.zeros(environments)
    count = jnp.zeros(environments, jnp.int32)
    zero = jnp.array(0, jnp.int32)
    started = TrainingState(
        agent=state,
        task=jax.vmap(task.reset)(jax.random.split(task_key, environments)),
        tally=Tally(count, count, zeros, {}),
        key=jax.random.key_data(key),
        steps=zero,
        episodes=zero,
        healthy=jnp.array(True),
    )

    def learned(state: TrainingState) -> Metrics:
        """The metrics of a rollout of blanks, of which only the names count."""
        observation = jax.vmap(task.observe)(state.task)
        action = agent.act(state.agent, observation, task_key)
        no = jnp.zeros(environments, bool)
        step = Transition(state.task, observation, action, zeros, state.task, observation, no, no)
        time = agent.rollout_steps
        rollout = jax.tree.map(lambda x: jnp.broadcast_to(x, (time, *x.shape)), step)
        return absorb(task, agent, state, rollout, learning=True)[2]

    metrics = jax.eval_shape(learned, started)
    return eqx.tree_at(lambda s: s.tally.metrics, started, dict.fromkeys(metrics, zeros))


def advance(
    task: Task, agent: Agent, state: TrainingState, steps: Int[Array, ""], *, learning: bool
) -> tuple[TrainingState, Episodes]:
    """``steps`` steps of all environments, with learning after each rollout if ``learning``.

    ``steps`` is a multiple of the agent's rollouts and at most ``chunk_steps``; the records beyond
    it stay empty.
    """
    length = agent.rollout_steps
    _, record, _ = jax.eval_shape(partial(_rollout, task, agent, learning=learning), state)
    rows = chunk_steps(task, agent)
    empty = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape[1:]), x.dtype), record)

    def body(i: Array, carry: tuple[TrainingState, Episodes]) -> tuple[TrainingState, Episodes]:
        state, episodes = carry
        state, record, _ = _rollout(task, agent, state, learning=learning)
        put = lambda all, some: lax.dynamic_update_slice_in_dim(all, some, i * length, 0)  # noqa: E731
        return state, jax.tree.map(put, episodes, record)

    state, episodes = lax.fori_loop(0, steps // length, body, (state, empty))
    return eqx.tree_at(lambda s: s.healthy, state, healthy(agent, state)), episodes


def healthy(agent: Agent, state: TrainingState) -> Bool[Array, ""]:
    """Whether metrics and weights are still finite."""
    weights = jax.tree.leaves(agent.weights(state.agent))
    return state.healthy & jnp.stack([jnp.isfinite(leaf).all() for leaf in weights]).all()


def chunk_steps(task: Task, agent: Agent) -> int:
    """Steps in a chunk: whole rollouts, and whole episodes of those that do not end early."""
    length = math.lcm(episode_steps(task, agent), agent.rollout_steps)
    return length * -(-CHUNK // length)


def episode_steps(task: Task, agent: Agent) -> int:
    """Steps of a training episode: the task's horizon, or fewer."""
    return min(agent.episode_steps or task.horizon, task.horizon)


def _rollout(
    task: Task, agent: Agent, state: TrainingState, *, learning: bool
) -> tuple[TrainingState, Episodes, Metrics]:
    """One rollout, then learning from it; the records have a leading time axis."""

    def step(carry: tuple[PyTree, Array], time: Array) -> tuple[tuple[PyTree, Array], tuple]:
        states, length = carry
        act_key, task_key, reset_key, _ = step_keys(state.key, time)
        observation = jax.vmap(task.observe)(states)
        action = agent.act(state.agent, observation, act_key)
        after = jax.vmap(task.step)(states, action, jax.random.split(task_key, len(length)))
        truncated = (length + 1 >= episode_steps(task, agent)) & ~after.terminated
        finished = after.terminated | truncated
        transition = Transition(
            state=states,
            observation=observation,
            action=action,
            reward=after.reward,
            next_state=after.state,
            next_observation=jax.vmap(task.observe)(after.state),
            terminated=after.terminated,
            truncated=truncated,
        )

        def reset(states: PyTree) -> PyTree:
            fresh = jax.vmap(task.reset)(jax.random.split(reset_key, len(length)))
            return jax.tree.map(partial(_select, finished), fresh, states)

        # The branch carries the environments only, never the agent with its replay buffer.
        states = lax.cond(finished.any(), reset, lambda states: states, after.state)
        return (states, jnp.where(finished, 0, length + 1)), transition

    times = state.steps + jnp.arange(agent.rollout_steps)
    (states, _), rollout = _scan(step, (state.task, state.tally.steps), times)
    return absorb(
        task, agent, eqx.tree_at(lambda s: s.task, state, states), rollout, learning=learning
    )


def step_keys(key: UInt32[Array, "2"], time: Array) -> Key[Array, "4"]:
    """A member's keys for a step: to act, to step the task, to reset it, and to learn."""
    return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), time), 4)


def absorb(
    task: Task, agent: Agent, state: TrainingState, rollout: Transition, *, learning: bool
) -> tuple[TrainingState, Episodes, Metrics]:
    """Learns from a rollout, or only stores it, and counts it."""
    if learning:
        last = state.steps + agent.rollout_steps - 1
        learner, metrics = agent.learn(task, state.agent, rollout, step_keys(state.key, last)[3])
    else:
        learner, metrics = agent.observe(state.agent, rollout), {}
    monitored = agent.monitor(state.agent)

    def count(tally: Tally, transition: Transition) -> tuple[Tally, Episodes]:
        sums = {name: total + metrics.get(name, 0.0) for name, total in tally.metrics.items()}
        learned = tally.learned + int(learning)
        reward = tally.reward + transition.reward
        means = {name: total / learned for name, total in sums.items()}
        now = {name: jnp.broadcast_to(value, reward.shape) for name, value in monitored.items()}
        finished = transition.terminated | transition.truncated
        record = Episodes(finished, reward, now | means)
        tally = Tally(tally.steps + 1, learned, reward, sums)
        return jax.tree.map(lambda x: jnp.where(finished, jnp.zeros_like(x), x), tally), record

    tally, records = _scan(count, state.tally, rollout)
    finite = [jnp.isfinite(metric).all() for metric in metrics.values()]
    state = TrainingState(
        agent=learner,
        task=state.task,
        tally=tally,
        key=state.key,
        steps=state.steps + agent.rollout_steps,
        episodes=state.episodes + records.finished.sum(dtype=jnp.int32),
        healthy=state.healthy & jnp.stack([jnp.array(True), *finite]).all(),
    )
    return state, records, metrics


def _scan(function: Callable[..., Any], carry: Any, xs: Any) -> tuple[Any, Any]:
    """``lax.scan``; a single step stands in line, without a loop."""
    if jax.tree.leaves(xs)[0].shape[0] > 1:
        return lax.scan(function, carry, xs)
    carry, y = function(carry, jax.tree.map(lambda x: x[0], xs))
    return carry, jax.tree.map(lambda y: y[None], y)


def _select(mask: Bool[Array, " environment"], new: Array, old: Array) -> Array:
    return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


class Population:
    """Members trained side by side, and the programs that do it.

    tasks, agents: one for all members, or one for each, which may differ in numbers and arrays.
    state: the members' TrainingState, with a leading member axis.
    starts, curve_starts: on how many starts policies are graded, and along the learning curve.
    """

    starts, curve_starts = STARTS, CURVE_STARTS

    def __init__(
        self, tasks: Task | Sequence[Task], agents: Agent | Sequence[Agent], seeds: Sequence[int]
    ) -> None:
        self.seeds = list(seeds)
        tasks = [tasks] * len(self.seeds) if isinstance(tasks, Task) else list(tasks)
        agents = [agents] * len(self.seeds) if isinstance(agents, Agent) else list(agents)
        if len({jax.tree.structure(agent) for agent in agents}) > 1:
            raise QfolioError(
                "members of one population must share all settings that shape the program; train "
                "agents that differ in them in populations of their own."
            )
        # What is asked of the first holds for all: it does not depend on numbers.
        self.task, self.agent = task, agent = tasks[0], agents[0]
        self._tail = max(tail_steps(agent.discount) for agent in agents)
        self.seconds_compile = 0.0
        first = jax.eval_shape(lambda: begin(task, agent, jnp.array(0, jnp.uint32)))
        require_memory(first, len(self.seeds))
        own, self._shared, self._join, form = _split(list(zip(tasks, agents, strict=True)))
        self._begin(own, form)

    def _begin(self, own: list[np.ndarray], form: Hashable) -> None:
        """Members before their first step; ``own`` and ``form`` are those of ``_split``."""
        self._members = Members(len(self.seeds))
        self._own = self._members.place(own)
        # Nothing else may change what is compiled under a name.
        rows = chunk_steps(self.task, self.agent)
        self._programs = programs_of((form, len(self.seeds), self._members.one_by_one, rows))
        seeds = self._members.place(np.array(self.seeds, np.uint32))
        self.state: TrainingState = self._run(
            "begin", lambda task, agent, seed: begin(task, agent, seed), seeds
        )

    @property
    def steps(self) -> int:
        """Steps of each environment so far."""
        return int(self._fetch(lambda state: state.steps)[0])

    @property
    def member_episodes(self) -> list[int]:
        """Finished episodes of each member."""
        return self._fetch(lambda state: state.episodes).tolist()

    @property
    def episodes(self) -> int:
        """Finished episodes of the member that has finished fewest."""
        return min(self.member_episodes)

    @property
    def healthy(self) -> list[bool]:
        """Whether the losses and weights of each member have been finite so far."""
        return self._fetch(lambda state: state.healthy).tolist()

    def steps_left(self, episodes: int | None = None, *, steps: int | None = None) -> int:
        """Steps of each environment until each member has done what is given; 0 if done.

        episodes: finished by each member, if none ends early. steps: of all its environments.
        """
        if steps is not None:
            return max(0, -(-steps // self.agent.environments) - self.steps)
        missing = (episodes or 0) - self.episodes
        if missing <= 0:
            return 0
        rounds = -(-missing // self.agent.environments)
        under_way = int(self._fetch(lambda state: state.tally.steps).max())
        return max(1, rounds * episode_steps(self.task, self.agent) - under_way)

    def advance(self, steps: int, *, strict: bool = True) -> Episodes:
        """At most one chunk; returns the records as numpy arrays (member, time, environment).

        Raises QfolioError, and leaves ``state`` undefined, if a loss is not finite; unless
        ``strict``, the others go on, and ``healthy`` tells.
        """
        steps, learning = self._plan(steps, chunk_steps(self.task, self.agent))

        def program(
            task: Task, agent: Agent, state: TrainingState, steps: Array
        ) -> tuple[TrainingState, Episodes]:
            return advance(task, agent, state, steps, learning=learning)

        name = "learn" if learning else "collect"
        self.state, episodes = self._run(name, program, self.state, np.int32(steps), donate=True)
        if strict:
            self._require_healthy()
        return self._members.fetch(episodes)

    def _plan(self, steps: int, most: int) -> tuple[int, bool]:
        """How many steps to go now, in whole rollouts, and whether they learn."""
        length = self.agent.rollout_steps
        warm_up = -(-self.agent.warm_up() // length) * length - self.steps
        steps = min(steps, most, warm_up if warm_up > 0 else most)
        return -(-steps // length) * length, warm_up <= 0

    def _require_healthy(self) -> None:
        healthy = self.healthy
        if not all(healthy):
            bad = {str(s): None for s, ok in zip(self.seeds, healthy, strict=True) if not ok}
            raise QfolioError(
                f"The loss of seed {', '.join(bad)} is no longer finite after {self.steps} steps; "
                "lower learning_rate, or bound the gradient (huber or gradient_norm, whichever the "
                "agent has)."
            )

    def evaluate(self, keys: Key[Array, " start"], tail: int | None = None) -> Greedy:
        """Greedy returns (member, start) and overestimation (member,) of the policies so far.

        tail: steps beyond the horizon that the overestimation counts; those that matter if None.
        """
        tail = self._tail if tail is None else tail

        def program(task: Task, agent: Agent, weights: PyTree, keys: Array) -> Greedy:
            return evaluate(task, agent, weights, keys, tail)

        weights = self.agent.weights(self.state.agent)
        greedy = self._run(f"evaluate {len(keys)} {tail}", program, weights, keys)
        return self._members.fetch(greedy)

    def weights(self) -> PyTree:
        """The members' learned weights as numpy arrays."""
        return self._fetch(lambda state: self.agent.weights(state.agent))

    def fetch(self) -> TrainingState:
        """The members' states as numpy arrays, with a leading member axis."""
        return self._fetch(lambda state: state)

    def restore(self, state: TrainingState) -> None:
        """Goes on from what ``fetch`` gave."""
        self.state = self._members.place(state)

    def _fetch(self, where: Callable[[TrainingState], PyTree]) -> PyTree:
        """Parts of the members' states as numpy arrays, with a leading member axis."""
        return self._members.fetch(where(self.state))

    def _run(
        self,
        name: str,
        function: Callable[..., Any],
        members: Any,
        *args: Any,
        donate: bool = False,
    ) -> Any:
        """Runs ``function(task, agent, member, *args)`` for all members as one program."""
        start = partial(self._start, name, function, members, self._own)
        return jax.block_until_ready(start(*args, donate=donate))

    def _start(
        self,
        name: str,
        function: Callable[..., Any],
        member: Any,
        own: Any,
        *args: Any,
        donate: bool = False,
    ) -> Any:
        """The same without waiting for the result; compiled at the first use of the name.

        own: the numbers of the member's agent and task.
        """

        def one(member: Any, own: Any, shared: Any, *args: Any) -> Any:
            return function(*self._join(own, shared), member, *args)

        args = (member, own, self._shared, *args)
        if name not in self._programs:
            start = perf_counter()
            self._programs[name] = self._compile(one, *args, donate=donate)
            self.seconds_compile += perf_counter() - start
        return self._programs[name](*args)

    def _compile(self, one: Callable[..., Any], *args: Any, donate: bool) -> Any:
        """A program from arguments shaped like these; the first one's memory may be reused."""
        return self._members.compile(one, *args, split=2, donate=donate)


@lru_cache(maxsize=8)
def programs_of(form: Hashable) -> dict[str, Any]:
    """Compiled programs by name, for all populations of one form: compiling takes long."""
    return {}


def _split(
    members: Sequence[PyTree],
) -> tuple[list[np.ndarray], list[Array], Callable[[Any, Any], PyTree], Hashable]:
    """Parts the members' numbers and arrays into each one's own and those that all share.

    Numbers are each one's own, so that one program serves them all; an array is shared if it is
    the same object in all. Returns the own with a leading member axis, the shared, a function that
    puts one member together again, and what a program for them depends on.
    """
    columns = list(zip(*(jax.tree.leaves(member) for member in members), strict=True))
    structure = jax.tree.structure(members[0])
    is_own = [
        isinstance(column[0], float) or any(leaf is not column[0] for leaf in column)
        for column in columns
    ]
    own = [
        np.stack([np.asarray(x, np.float32 if isinstance(x, float) else None) for x in column])
        for column, mine in zip(columns, is_own, strict=True)
        if mine
    ]
    shared = [column[0] for column, mine in zip(columns, is_own, strict=True) if not mine]

    def join(own: list[Array], shared: list[Array]) -> PyTree:
        mine, common = iter(own), iter(shared)
        return jax.tree.unflatten(structure, [next(mine if m else common) for m in is_own])

    shapes = tuple(
        (np.shape(column[0]), getattr(column[0], "dtype", type(column[0]))) for column in columns
    )
    return own, shared, join, (structure, tuple(is_own), shapes)
