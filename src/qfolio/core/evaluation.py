"""Evaluation: greedy returns from fixed start states, and the overestimation of action values."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray, PyTree

from qfolio.core.keys import apart
from qfolio.core.mdp import Agent, Policy, Task

STARTS = 1024
"""Number of start states of a final evaluation; the learning curve uses the first of them."""

CURVE_STARTS = 64
"""Number of start states of each evaluation along the learning curve."""


def start_keys(n: int = STARTS) -> Key[Array, " start"]:
    """Keys of the fixed start states; a smaller set is a prefix of a larger one."""
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(20151), i))(jnp.arange(n))


def step_key(key: PRNGKeyArray, time: Int[Array, ""]) -> PRNGKeyArray:
    """The key of a step of the episode that starts with ``key``, from which its start is drawn."""
    return jax.random.fold_in(apart(key), time)


LONGEST = 2000
"""Most steps that are followed beyond the horizon."""

FADED = 0.01
"""Discounts below this no longer matter to the overestimation."""


class Greedy(NamedTuple):
    """Results of greedy episodes from several start states."""

    returns: Float[Array, " start"]  # undiscounted, over the task's horizon
    overestimation: Float[Array, ""]  # NaN without action values or complete tails


def tail_steps(discount: float | None) -> int:
    """Steps after which a reward is discounted to 1%: at most 2,000, and 0 without a discount."""
    if discount is None:
        return 0
    return min(LONGEST, math.ceil(math.log(FADED) / math.log(min(max(discount, 1e-9), 1 - 1e-9))))


def evaluate(
    task: Task, agent: Agent, weights: PyTree, keys: Key[Array, " start"], tail: int
) -> Greedy:
    """Follows the greedy policy from each key's start state over the horizon and ``tail`` steps.

    The return covers the horizon. The overestimation is the mean, over the states visited within
    the horizon, of max_a Q(s, a) minus the realized discounted return (van Hasselt et al. 2016,
    section 3); the tail keeps that return from being cut off. The overestimation leaves out starts
    from which the task's data end within the tail, such as the last rows of a price table, and
    those whose episode goes on after a tail of ``LONGEST`` that the discount has not faded by then.
    """
    starts = jax.vmap(task.reset)(keys)
    known = jax.vmap(task.steps_left)(starts) >= task.horizon + tail

    def step(carry: tuple[PyTree, Array], time: Array) -> tuple[tuple[PyTree, Array], tuple]:
        states, alive = carry
        observation = jax.vmap(task.observe)(states)
        values = agent.action_values(weights, observation)
        best = jnp.full(alive.shape, jnp.nan) if values is None else values.max(-1)
        actions = agent.policy(weights, observation)
        after = jax.vmap(task.step)(states, actions, jax.vmap(step_key, (0, None))(keys, time))
        reward = jnp.where(alive, after.reward, 0.0)
        return (after.state, alive & ~after.terminated), (reward, best, alive)

    discount = 1.0 if agent.discount is None else agent.discount

    alive = jnp.ones(keys.shape, bool)
    times = jnp.arange(task.horizon + tail)
    (_, goes_on), (rewards, best, visited) = lax.scan(step, (starts, alive), times)
    if tail >= LONGEST:
        known &= ~(goes_on & (discount**tail > FADED + 1e-4))

    def back(following: Array, reward: Array) -> tuple[Array, Array]:
        now = reward + discount * following
        return now, now

    _, discounted = lax.scan(back, jnp.zeros(keys.shape), rewards, reverse=True)
    first = slice(0, task.horizon)
    counted = visited & known
    error = jnp.where(counted, best - discounted, 0.0)[first].sum() / counted[first].sum()
    return Greedy(rewards[first].sum(0), error)


def greedy(task: Task, agent: Agent, weights: PyTree) -> Policy:
    """An agent's greedy policy, as a function from a state to the intended action."""

    def policy(state: PyTree) -> Array:
        return task.intent(state, _action(task, agent, weights, state))

    return policy


def _action(task: Task, agent: Agent, weights: PyTree, state: PyTree) -> Array:
    """The agent's greedy action in one state."""
    view = jax.tree.map(lambda x: x[None], task.observe(state))
    return agent.policy(weights, view)[0]


class Episode(NamedTuple):
    """One greedy episode, step by step."""

    states: PyTree  # (time + 1, ...)
    actions: Array  # (time, ...)
    rewards: Float[Array, " time"]


def greedy_episode(task: Task, agent: Agent, weights: PyTree, key: PRNGKeyArray) -> Episode:
    """One greedy episode from the start state of ``key``, over the whole horizon of the task."""

    def step(state: PyTree, time: Array) -> tuple[PyTree, tuple]:
        action = _action(task, agent, weights, state)  # a step takes it, not its intent
        after = task.step(state, action, step_key(key, time))
        return after.state, (after.state, action, after.reward)

    start = task.reset(key)
    _, (states, actions, rewards) = lax.scan(step, start, jnp.arange(task.horizon))
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    return Episode(states, actions, rewards)
