"""Faults of a task that look like faults of learning."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent, Discrete, Simplex, Task
from qfolio.core.registry import own_modules
from qfolio.core.training import episode_steps

OFF = 1e-3
"""How far weights may be off in single precision."""


def find(task: Task, agent: Agent, seed: int) -> str | None:
    """A sentence on the first observation or reward that is not finite; None if all are.

    Observations of a task with ``states`` have to be numbers of states. Checks one episode of each
    environment under the untrained agent.
    """
    found = jax.jit(lambda key: _finite(task, agent, key))(jax.random.key(seed))
    rows = zip(*(each.tolist() for each in found), strict=True)
    for time, (seen, acted, reward) in enumerate(rows):
        if not seen:
            where = f"after step {time}" if time else "at the start"
            wrong = "finite" if task.states is None else f"from 0 to {task.states - 1}"
            return (
                f"The observation of {task.name} is not {wrong} {where} of an episode; check its "
                f"observe, step and reset{'' if task.states is None else ', and its states'}."
            )
        if not acted:
            return (
                f"The action of {type(agent).__name__} is not finite at step {time + 1} of an "
                "episode; check its init and act."
            )
        if not reward:
            parts = "reward and cost model" if hasattr(task, "cost_model") else "step"
            return (
                f"The reward of {task.name} is not finite at step {time + 1} of an episode; check "
                f"its {parts}."
            )
    return None


def require_actions(task: Task, agent: Agent, learned: PyTree | None = None) -> None:
    """Raises QfolioError if a user's own agent chooses what the task does not have.

    These are weights that nobody can hold, or numbers of no choice, at the start of an episode.

    learned: what members have learned, with a leading member axis (default: an untrained agent).
    """
    if not (task.compiled and own_modules(agent)):
        return

    def chosen(key: PRNGKeyArray) -> dict[str, Array]:
        agent_key, reset_key, act_key = jax.random.split(key, 3)
        starts = jax.vmap(task.reset)(jax.random.split(reset_key, agent.num_envs))
        seen = jax.vmap(task.observe)(starts)
        if learned is not None:
            return {"policy": jax.vmap(agent.policy, in_axes=(0, None))(learned, seen)}
        state = agent.init(task, agent_key)
        acts = agent.act(state, seen, act_key)
        return {"act": acts, "policy": agent.policy(agent.weights(state), seen)}

    for method, actions in jax.jit(chosen)(jax.random.key(0)).items():
        if said := _refused(task.actions, np.asarray(actions)):
            raise QfolioError(f"{type(agent).__name__}.{method} gives {said}")


def _refused(actions: Any, given: np.ndarray) -> str:
    """Why a task does not have the actions given; empty if it has them."""
    if isinstance(actions, Discrete):
        wrong = given[(given < 0) | (given >= actions.n)]
        return (
            f"the action {wrong[0]:g}; it must be from 0 to {actions.n - 1}." if wrong.size else ""
        )
    if isinstance(actions, Simplex):
        sums = given.sum(-1)
        worst = float(sums.ravel()[abs(sums - 1).argmax()])
        if float(given.min()) < -OFF or abs(worst - 1) > OFF:
            return (
                f"weights of at least {float(given.min()):.3g} that sum to {worst:.3g}; weights, "
                "cash first, must be at least 0 and sum to 1, as a softmax is."
            )
    return ""


def _finite(task: Task, agent: Agent, key: PRNGKeyArray) -> tuple[Bool[Array, " time"], ...]:
    """Whether all observations, actions and rewards are finite, for each step of an episode."""
    agent_key, reset_key, key = jax.random.split(key, 3)
    state, count = agent.init(task, agent_key), agent.num_envs

    def step(
        carry: tuple[PyTree, Bool[Array, " environment"]], key: PRNGKeyArray
    ) -> tuple[tuple[PyTree, Bool[Array, " environment"]], tuple[Array, ...]]:
        states, over = carry
        act_key, step_key = jax.random.split(key)
        observation = jax.vmap(task.observe)(states)
        action = agent.act(state, observation, act_key)
        after = jax.vmap(task.step)(states, action, jax.random.split(step_key, count))
        most = jnp.inf if task.states is None else task.states - 1
        least = -jnp.inf if task.states is None else 0
        valid = lambda x: jnp.isfinite(x) & (least <= x) & (x <= most)  # noqa: E731
        leaves = [valid(x).reshape(count, -1).all(1) for x in jax.tree.leaves(observation)]
        seen = jnp.stack(leaves).all(0)
        acted = jnp.isfinite(action.reshape(count, -1)).all(1)
        fine = tuple((each | over).all() for each in (seen, acted, jnp.isfinite(after.reward)))
        return (after.state, over | after.terminated), fine

    start = jax.vmap(task.reset)(jax.random.split(reset_key, count)), jnp.zeros(count, bool)
    return lax.scan(step, start, jax.random.split(key, episode_steps(task, agent)))[1]
