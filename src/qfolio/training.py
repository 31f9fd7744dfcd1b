"""The training loop: environment, exploration and learning in one compiled program.

``advance`` is that program: any number of steps of one member (one seed of one agent on one task).
A ``Population`` runs it for all members, in chunks, from Python; everything else (progress, files,
Ctrl-C) happens between chunks, and nothing calls back from inside.
"""

from collections.abc import Sequence
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from qfolio.devices import Members, require_memory
from qfolio.errors import QfolioError
from qfolio.evaluation import Greedy, evaluate, tail_steps
from qfolio.mdp import Agent, Metrics, Task, Transition

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
    _, _, metrics = jax.eval_shape(partial(_step, task, agent, learning=True), started)
    return eqx.tree_at(lambda s: s.tally.metrics, started, dict.fromkeys(metrics, zeros))


def advance(
    task: Task, agent: Agent, state: TrainingState, steps: Int[Array, ""], *, learning: bool
) -> tuple[TrainingState, Episodes]:
    """``steps`` steps of all environments, each followed by learning if ``learning``.

    ``steps`` is at most ``chunk_steps``; the records beyond it stay empty.
    """
    _, record, _ = jax.eval_shape(partial(_step, task, agent, learning=learning), state)
    rows = chunk_steps(task, agent)
    empty = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), record)

    def body(i: Array, carry: tuple[TrainingState, Episodes]) -> tuple[TrainingState, Episodes]:
        state, episodes = carry
        state, record, _ = _step(task, agent, state, learning=learning)
        put = lambda all, one: lax.dynamic_update_index_in_dim(all, one, i, 0)  # noqa: E731
        return state, jax.tree.map(put, episodes, record)

    state, episodes = lax.fori_loop(0, steps, body, (state, empty))
    weights = jax.tree.leaves(agent.weights(state.agent))
    finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in weights]).all()
    return eqx.tree_at(lambda s: s.healthy, state, state.healthy & finite), episodes


def chunk_steps(task: Task, agent: Agent) -> int:
    """Steps in a chunk, a multiple of the steps of an episode that does not end early."""
    length = episode_steps(task, agent)
    return length * -(-CHUNK // length)


def episode_steps(task: Task, agent: Agent) -> int:
    return agent.episode_steps or task.horizon


def _step(
    task: Task, agent: Agent, state: TrainingState, *, learning: bool
) -> tuple[TrainingState, Episodes, Metrics]:
    act_key, task_key, reset_key, learn_key = jax.random.split(
        jax.random.fold_in(jax.random.wrap_key_data(state.key), state.steps), 4
    )
    environments = agent.environments
    observation = jax.vmap(task.observe)(state.task)
    action = agent.act(state.agent, observation, act_key)
    after = jax.vmap(task.step)(state.task, action, jax.random.split(task_key, environments))
    length = state.tally.steps + 1
    truncated = (length >= episode_steps(task, agent)) & ~after.terminated
    finished = after.terminated | truncated
    rollout = Transition(
        observation=observation,
        action=action,
        reward=after.reward,
        next_observation=jax.vmap(task.observe)(after.state),
        terminated=after.terminated,
        truncated=truncated,
    )
    rollout = jax.tree.map(lambda x: x[None], rollout)  # a rollout of one step
    if learning:
        learner, metrics = agent.learn(state.agent, rollout, learn_key)
    else:
        learner, metrics = agent.observe(state.agent, rollout), {}

    sums = {name: total + metrics.get(name, 0.0) for name, total in state.tally.metrics.items()}
    learned = state.tally.learned + int(learning)
    reward = state.tally.reward + after.reward
    means = {name: total / learned for name, total in sums.items()}
    monitored = {
        name: jnp.broadcast_to(value, reward.shape)
        for name, value in agent.monitor(state.agent).items()
    }
    record = Episodes(finished, reward, monitored | means)

    def reset(states: PyTree) -> PyTree:
        fresh = jax.vmap(task.reset)(jax.random.split(reset_key, environments))
        return jax.tree.map(partial(_select, finished), fresh, states)

    # The branch carries the environments only, never the agent with its replay buffer.
    next_states = lax.cond(finished.any(), reset, lambda states: states, after.state)
    tally = Tally(length, learned, reward, sums)
    finite = [jnp.isfinite(metric).all() for metric in metrics.values()]
    state = TrainingState(
        agent=learner,
        task=next_states,
        tally=jax.tree.map(lambda x: jnp.where(finished, jnp.zeros_like(x), x), tally),
        key=state.key,
        steps=state.steps + 1,
        episodes=state.episodes + finished.sum(dtype=jnp.int32),
        healthy=state.healthy & jnp.stack([jnp.array(True), *finite]).all(),
    )
    return state, record, metrics


def _select(mask: Bool[Array, " environment"], new: Array, old: Array) -> Array:
    return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


class Population:
    """Members trained side by side, and the programs that do it.

    state: the members' TrainingState, with a leading member axis.
    """

    def __init__(self, task: Task, agent: Agent, seeds: Sequence[int]) -> None:
        self.task, self.agent, self.seeds = task, agent, list(seeds)
        self._members = Members(len(self.seeds))
        # Numeric hyperparameters are arrays of each member, so that one program serves them all.
        static, numbers = eqx.partition(agent, lambda x: not isinstance(x, float))
        numbers = jax.tree.map(lambda x: np.full(len(self.seeds), x, np.float32), numbers)
        self._numbers = self._members.place(numbers)
        self._agent = lambda numbers: eqx.combine(static, numbers)
        self._programs: dict[str, Any] = {}
        self.seconds_compile = 0.0
        first = jax.eval_shape(lambda: begin(task, agent, jnp.array(0, jnp.uint32)))
        require_memory(first, len(self.seeds))
        self.state: TrainingState = self._run(
            "begin",
            lambda member: begin(task, self._agent(member[1]), member[0]),
            (self._members.place(np.array(self.seeds, np.uint32)), self._numbers),
        )

    @property
    def steps(self) -> int:
        """Steps of each environment so far."""
        return int(self._members.fetch(self.state.steps)[0])

    @property
    def member_episodes(self) -> list[int]:
        """Finished episodes of each member."""
        return self._members.fetch(self.state.episodes).tolist()

    @property
    def episodes(self) -> int:
        """Finished episodes of the member that has finished fewest."""
        return min(self.member_episodes)

    def steps_left(self, episodes: int) -> int:
        """Steps until each member has finished ``episodes`` if no episode ends early; 0 if done."""
        missing = episodes - self.episodes
        if missing <= 0:
            return 0
        rounds = -(-missing // self.agent.environments)
        under_way = int(self._members.fetch(self.state.tally.steps).max())
        return max(1, rounds * episode_steps(self.task, self.agent) - under_way)

    def advance(self, steps: int) -> Episodes:
        """At most one chunk; returns the records as numpy arrays (member, time, environment).

        Raises QfolioError, and leaves ``state`` undefined, if a loss is not finite.
        """
        warm_up = self.agent.warm_up() - self.steps
        learning = warm_up <= 0
        steps = min(steps, chunk_steps(self.task, self.agent), steps if learning else warm_up)

        def program(member: tuple[TrainingState, Agent], steps: Array) -> Any:
            state, numbers = member
            state, episodes = advance(
                self.task, self._agent(numbers), state, steps, learning=learning
            )
            return (state, numbers), episodes

        name = "learn" if learning else "collect"
        (self.state, self._numbers), episodes = self._run(
            name, program, (self.state, self._numbers), np.int32(steps), donate=True
        )
        healthy = self._members.fetch(self.state.healthy)
        if not healthy.all():
            seeds = ", ".join(str(s) for s, ok in zip(self.seeds, healthy, strict=True) if not ok)
            raise QfolioError(
                f"The loss of seed {seeds} is no longer finite after {self.steps} steps; "
                "lower learning_rate, or set huber=1 to bound the gradient."
            )
        return self._members.fetch(episodes)

    def evaluate(self, keys: Key[Array, " start"]) -> Greedy:
        """Greedy returns (member, start) and overestimation (member,) of the policies so far."""

        tail = tail_steps(self.agent.discount)

        def program(member: tuple[PyTree, Agent], keys: Key[Array, " start"]) -> Any:
            weights, numbers = member
            return evaluate(self.task, self._agent(numbers), weights, keys, tail)

        members = (self.agent.weights(self.state.agent), self._numbers)
        greedy = self._run(f"evaluate {len(keys)}", program, members, keys)
        return self._members.fetch(greedy)

    def weights(self) -> PyTree:
        """The members' learned weights as numpy arrays."""
        return self._members.fetch(self.agent.weights(self.state.agent))

    def fetch(self) -> TrainingState:
        """The members' states as numpy arrays, with a leading member axis."""
        return self._members.fetch(self.state)

    def restore(self, state: TrainingState) -> None:
        """Goes on from what ``fetch`` gave."""
        self.state = self._members.place(state)

    def _run(
        self, name: str, function: Any, members: Any, *shared: Any, donate: bool = False
    ) -> Any:
        """Runs the program of that name, which is compiled at its first use."""
        if name not in self._programs:
            start = perf_counter()
            self._programs[name] = self._members.compile(function, members, *shared, donate=donate)
            self.seconds_compile += perf_counter() - start
        return jax.block_until_ready(self._programs[name](members, *shared))
