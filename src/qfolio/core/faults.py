"""Faults of a task that look like faults of learning."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from qfolio.core.mdp import Agent, Task
from qfolio.core.training import episode_steps


def find(task: Task, agent: Agent, seed: int) -> str | None:
    """A sentence on the first observation or reward that is not finite; None if all are.

    Observations of a task with ``states`` have to be numbers of states. Checks one episode of each
    environment under the untrained agent.
    """
    observed, paid = jax.jit(lambda key: _finite(task, agent, key))(jax.random.key(seed))
    for time, (seen, reward) in enumerate(zip(observed.tolist(), paid.tolist(), strict=True)):
        if not seen:
            where = f"after step {time}" if time else "at the start"
            wrong = "finite" if task.states is None else f"from 0 to {task.states - 1}"
            return (
                f"The observation of {task.name} is not {wrong} {where} of an episode; check its "
                f"observe, step and reset{'' if task.states is None else ', and its states'}."
            )
        if not reward:
            return (
                f"The reward of {task.name} is not finite at step {time + 1} of an episode; check "
                "its step."
            )
    return None


def _finite(
    task: Task, agent: Agent, key: PRNGKeyArray
) -> tuple[Bool[Array, " time"], Bool[Array, " time"]]:
    """Whether all observations and all rewards are finite, for each step of an episode."""
    agent_key, reset_key, key = jax.random.split(key, 3)
    state, count = agent.init(task, agent_key), agent.num_envs

    def step(
        carry: tuple[PyTree, Bool[Array, " environment"]], key: PRNGKeyArray
    ) -> tuple[tuple[PyTree, Bool[Array, " environment"]], tuple[Array, Array]]:
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
        fine = (seen | over).all(), (jnp.isfinite(after.reward) | over).all()
        return (after.state, over | after.terminated), fine

    start = jax.vmap(task.reset)(jax.random.split(reset_key, count)), jnp.zeros(count, bool)
    return lax.scan(step, start, jax.random.split(key, episode_steps(task, agent)))[1]
