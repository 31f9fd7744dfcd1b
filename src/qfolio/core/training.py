"""The training loop: environment, exploration and learning in one compiled program.

``advance`` is that program: any number of steps of one member (one seed of one agent on one task).
A ``Population`` runs it for all members, in chunks, from Python; everything else (progress, files,
Ctrl-C) happens between chunks, and nothing calls back from inside.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from qfolio.core.contract import learning_of, require_agent, require_task
from qfolio.core.errors import require_methods
from qfolio.core.mdp import Agent, Metrics, Task, Transition

CHUNK, LONGEST = 400, 4000
"""Least number of steps in a chunk, and the most that whole episodes may make of it."""


class Tally(NamedTuple):
    """Running totals of each environment's current episode."""

    steps: Int[Array, " environment"]
    learned: Int[Array, " environment"]  # of these, the steps that learned
    reward: Float[Array, " environment"]
    metrics: dict[str, Float[Array, " environment"]]  # summed over the steps that learned
    measured: dict[str, Float[Array, " environment"]]  # by the task, summed over all steps


class TrainingState(eqx.Module):
    """One member's complete training state, from which training resumes exactly, bit for bit."""

    agent: PyTree
    task: PyTree  # (environment, ...)
    tally: Tally
    key: UInt32[Array, "2"]  # constant; each step folds its number in
    steps: Int[Array, ""]  # of each environment, since the beginning
    episodes: Int[Array, ""]  # finished, over all environments
    healthy: Bool[Array, ""]  # metrics and weights have been finite so far


class Episodes(NamedTuple):
    """A record for each step and environment; the values are valid where ``finished``."""

    finished: Bool[Array, "time environment"]
    returns: Float[Array, "time environment"]
    metrics: dict[str, Float[Array, "time environment"]]  # current ones, or means over the episode


def begin(task: Task, agent: Agent, seed: UInt32[Array, ""]) -> TrainingState:
    """A member before its first step; all its randomness derives from ``seed``.

    Raises QfolioError if a method of the task or the agent does not return what it has to.
    """
    agent = agent.fitted(task)
    agent_key, task_key, key = jax.random.split(jax.random.key(seed), 3)
    step = require_task(task, task_key)
    require_methods(type(agent), Agent)
    state = agent.init(task, agent_key)
    environments = agent.num_envs
    zeros = jnp.zeros(environments)
    count = jnp.zeros(environments, jnp.int32)
    zero = jnp.array(0, jnp.int32)
    started = TrainingState(
        agent=state,
        task=jax.vmap(task.reset)(jax.random.split(task_key, environments)),
        tally=Tally(count, count, zeros, {}, {}),
        key=jax.random.key_data(key),
        steps=zero,
        episodes=zero,
        healthy=jnp.array(True),
    )
    reported = require_agent(task, agent, state, step, task_key)
    names = (dict.fromkeys(metrics, zeros) for metrics in reported)
    return eqx.tree_at(lambda s: (s.tally.metrics, s.tally.measured), started, tuple(names))


def advance(
    task: Task, agent: Agent, state: TrainingState, steps: Int[Array, ""], *, learning: bool
) -> tuple[TrainingState, Episodes]:
    """``steps`` steps of all environments, with learning after each rollout if ``learning``.

    ``steps`` is a multiple of the agent's ``rollout_steps`` and at most ``chunk_steps``; records
    beyond it stay empty.
    """
    length = agent.rollout_steps
    rollout = jax.jit(partial(_rollout, task, agent, learning=learning), inline=True)
    _, record = jax.eval_shape(rollout, state)  # traced once, here and below
    rows = chunk_steps(task, agent)
    empty = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape[1:]), x.dtype), record)

    def body(i: Array, carry: tuple[TrainingState, Episodes]) -> tuple[TrainingState, Episodes]:
        state, episodes = carry
        state, record = rollout(state)
        put = lambda all, some: lax.dynamic_update_slice_in_dim(all, some, i * length, 0)  # noqa: E731
        return state, jax.tree.map(put, episodes, record)

    state, episodes = lax.fori_loop(0, steps // length, body, (state, empty))
    return eqx.tree_at(lambda s: s.healthy, state, healthy(agent, state)), episodes


def healthy(agent: Agent, state: TrainingState) -> Bool[Array, ""]:
    """Whether metrics and weights are still finite."""
    weights = jax.tree.leaves(agent.weights(state.agent))
    return state.healthy & jnp.stack([jnp.isfinite(leaf).all() for leaf in weights]).all()


def chunk_steps(task: Task, agent: Agent) -> int:
    """Steps in a chunk: whole rollouts, and whole episodes of full length if these are short."""
    length = math.lcm(episode_steps(task, agent), agent.rollout_steps)
    steps = length * -(-CHUNK // length)
    return steps if steps <= LONGEST else agent.whole_rollouts(CHUNK)


def episode_steps(task: Task, agent: Agent) -> int:
    """Steps of a training episode: the task's horizon, or fewer."""
    return min(agent.episode_steps or task.horizon, task.horizon)


def _rollout(
    task: Task, agent: Agent, state: TrainingState, *, learning: bool
) -> tuple[TrainingState, Episodes]:
    """One rollout, then learning from it; the records have a leading time axis."""
    return absorb(task, agent, *play(task, agent, state), learning=learning)


def play(task: Task, agent: Agent, state: TrainingState) -> tuple[TrainingState, Transition]:
    """The state after the steps of a rollout, from which nothing is learned yet, and these."""

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
            reward=after.reward.astype(jnp.float32),
            next_state=after.state,
            next_observation=jax.vmap(task.observe)(after.state),
            terminated=finished & ~truncated,  # often a constant by itself, see learning_of
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
    return eqx.tree_at(lambda s: s.task, state, states), rollout


def step_keys(key: UInt32[Array, "2"], time: Array) -> Key[Array, "4"]:
    """A member's keys for a step: to act, to step the task, to reset it, and to learn."""
    return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(key), time), 4)


def absorb(
    task: Task, agent: Agent, state: TrainingState, rollout: Transition, *, learning: bool
) -> tuple[TrainingState, Episodes]:
    """Learns from a rollout, or only stores it, and updates the counts."""
    if learning:
        last = state.steps + agent.rollout_steps - 1
        learn, learn_key = learning_of(task, agent), step_keys(state.key, last)[3]
        learner, metrics = learn(task, agent, state.agent, rollout, learn_key)
    else:
        learner, metrics = agent.observe(state.agent, rollout), {}
    monitored = agent.monitor(state.agent)

    def count(tally: Tally, step: tuple[Transition, Metrics]) -> tuple[Tally, Episodes]:
        transition, measured = step
        sums = {name: total + metrics.get(name, 0.0) for name, total in tally.metrics.items()}
        learned = tally.learned + int(learning)
        reward = tally.reward + transition.reward
        means = {name: total / learned for name, total in sums.items()}
        totals = {name: total + measured[name] for name, total in tally.measured.items()}
        means |= {name: total / (tally.steps + 1) for name, total in totals.items()}
        now = {name: jnp.broadcast_to(value, reward.shape) for name, value in monitored.items()}
        finished = transition.terminated | transition.truncated
        record = Episodes(finished, reward, now | means)
        tally = Tally(tally.steps + 1, learned, reward, sums, totals)
        return jax.tree.map(lambda x: jnp.where(finished, jnp.zeros_like(x), x), tally), record

    measured = jax.vmap(jax.vmap(partial(agent.measure, task)))(rollout)
    tally, records = _scan(count, state.tally, (rollout, measured))
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
    return state, records


def _scan(function: Callable[..., Any], carry: Any, xs: Any) -> tuple[Any, Any]:
    """``lax.scan``, without a loop for a single step."""
    if jax.tree.leaves(xs)[0].shape[0] > 1:
        return lax.scan(function, carry, xs)
    carry, y = function(carry, jax.tree.map(lambda x: x[0], xs))
    return carry, jax.tree.map(lambda y: y[None], y)


def _select(mask: Bool[Array, " environment"], new: Array, old: Array) -> Array:
    return jnp.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)
