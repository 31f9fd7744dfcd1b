"""Exploration: ε-greedy, or by uniformly drawn actions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.mdp import Actions, Discrete, Simplex
from qfolio.learning.targets import Scalar


class EpsilonSchedule(NamedTuple):
    """ε, which decays by a factor per finished episode, down to a lower bound."""

    epsilon_start: Scalar
    epsilon_end: Scalar
    epsilon_decay: Scalar

    def __call__(self, episodes: Int[Array, ""]) -> Float[Array, ""]:
        """ε after this many finished episodes."""
        return jnp.maximum(self.epsilon_end, self.epsilon_start * self.epsilon_decay**episodes)


def epsilon_greedy(
    key: PRNGKeyArray,
    values: Float[Array, "batch action"],
    epsilon: Scalar,
    last: Int[Array, " batch"] | None = None,
    persistence: float = 0.0,
) -> Int[Array, " batch"]:
    """The best action, or with probability ε a random one.

    If ``last`` is given, its actions are repeated with probability ε · persistence before anything
    is chosen, so that exploration persists for several steps (after Dabney et al. 2021,
    "Temporally-extended ε-greedy exploration").
    """
    if last is not None:
        key, again_key = jax.random.split(key)
        drawn = epsilon_greedy(key, values, epsilon)
        again = jax.random.uniform(again_key, last.shape) < epsilon * persistence
        return jnp.where(again, last, drawn)
    n, greedy = values.shape[-1], values.argmax(-1)
    # One draw decides both whether to explore (below ε) and which action (its place below ε).
    drawn = jax.random.uniform(key, greedy.shape)
    explored = jnp.minimum(drawn / jnp.maximum(epsilon, 1e-30) * n, n - 1).astype(jnp.int32)
    return jnp.where(drawn < epsilon, explored, greedy)


def uniform(actions: Actions, key: PRNGKeyArray, n: int) -> Array:
    """``n`` actions drawn uniformly; from [−1, 1] if they have no bounds."""
    if isinstance(actions, Discrete):
        return jax.random.randint(key, (n,), 0, actions.n, jnp.int32)
    if isinstance(actions, Simplex):
        return jax.random.dirichlet(key, jnp.ones(actions.assets + 1), (n,))
    return jax.random.uniform(key, (n, actions.n), minval=-actions.unit, maxval=actions.unit)
