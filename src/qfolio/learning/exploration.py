"""How agents that value actions explore."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


def epsilon_now(agent: Any, episodes: Int[Array, ""]) -> Float[Array, ""]:
    """ε of the agent's settings after so many finished episodes: it falls with each of them."""
    return jnp.maximum(agent.epsilon_end, agent.epsilon * agent.epsilon_decay**episodes)


def epsilon_greedy(
    key: PRNGKeyArray,
    values: Float[Array, "batch action"],
    epsilon: Float[Array, ""] | float,
    last: Int[Array, " batch"] | None = None,
    persistence: float = 0.0,
) -> Int[Array, " batch"]:
    """The best action, or with probability ε any.

    Where the ``last`` actions are given, they come again with probability ε · persistence, before
    anything is chosen: what explores goes on with it for a while (after Dabney et al. 2021,
    "Temporally-extended ε-greedy exploration").
    """
    if last is not None:
        key, again_key = jax.random.split(key)
        drawn = epsilon_greedy(key, values, epsilon)
        again = jax.random.uniform(again_key, last.shape) < epsilon * persistence
        return jnp.where(again, last, drawn)
    n, greedy = values.shape[-1], values.argmax(-1)
    # One uniform decides both: below ε explore, and where below ε it fell picks the action.
    uniform = jax.random.uniform(key, greedy.shape)
    explored = jnp.minimum(uniform / jnp.maximum(epsilon, 1e-30) * n, n - 1).astype(jnp.int32)
    return jnp.where(uniform < epsilon, explored, greedy)
