"""Exploration: ε-greedy actions, correlated noise and uniformly drawn actions."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

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


class LinearSchedule(NamedTuple):
    """ε, which decays linearly to a constant (Mnih et al. 2015)."""

    epsilon_start: Scalar
    epsilon_end: Scalar
    epsilon_steps: Scalar  # length of the decay

    def __call__(self, steps: Float[Array, ""]) -> Float[Array, ""]:
        """ε after this many steps."""
        left = jnp.maximum(1 - steps / self.epsilon_steps, 0.0)
        return self.epsilon_end + left * (self.epsilon_start - self.epsilon_end)


def epsilon_greedy(
    key: PRNGKeyArray,
    values: Float[Array, "batch action"],
    epsilon: Scalar,
    last: Int[Array, " batch"] | None = None,
    persistence: float = 0.0,
) -> Int[Array, " batch"]:
    """The best action or, with probability ε, a random one.

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


class OrnsteinUhlenbeck(eqx.Module):
    """Correlated noise: x ← (1 − θ) x + N(0, 1), from 0 in each episode (Lillicrap et al. 2016)."""

    value: Float[Array, "environment entry"]  # of the next actions
    key: UInt32[Array, "2"]

    @staticmethod
    def begin(key: PRNGKeyArray, shape: tuple[int, int]) -> "OrnsteinUhlenbeck":
        """The noise of the first step; ``shape`` is (environment, entry)."""
        noise = OrnsteinUhlenbeck(jnp.zeros(shape), jax.random.key_data(key))
        return noise.step(1.0, jnp.ones(shape[0], bool))

    def step(self, theta: Scalar, finished: Bool[Array, " environment"]) -> "OrnsteinUhlenbeck":
        """The noise of the next step; ``finished`` environments start again from 0."""
        key, draw_key = jax.random.split(jax.random.wrap_key_data(self.key))
        kept = jnp.where(finished[:, None], 0.0, (1 - theta) * self.value)
        drawn = jax.random.normal(draw_key, kept.shape)
        return OrnsteinUhlenbeck(kept + drawn, jax.random.key_data(key))


def uniform(actions: Actions, key: PRNGKeyArray, n: int) -> Array:
    """``n`` actions drawn uniformly: weights without a cap, coordinates without bounds in ±1."""
    if isinstance(actions, Discrete):
        return jax.random.randint(key, (n,), 0, actions.n, jnp.int32)
    if isinstance(actions, Simplex):
        # Dirichlet(1) draws; jax.random.dirichlet rejects candidates, which is slower.
        drawn = jax.random.exponential(key, (n, actions.assets + 1))
        return drawn / drawn.sum(-1, keepdims=True)
    return jax.random.uniform(key, (n, actions.n), minval=-actions.unit, maxval=actions.unit)
