"""The weights that a mandate allows."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class Feasible(eqx.Module):
    """A set of weights, cash first."""

    @property
    def long_only(self) -> bool:
        """Whether no weight of the set is negative, cash included."""
        return True

    @property
    def gross(self) -> float:
        """The largest sum of absolute weights of the assets."""
        return 1.0

    @abc.abstractmethod
    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """Weights of the set for the wanted weights (on the simplex) and the weights held.

        Weights of the set are returned unchanged; differentiable almost everywhere.
        """

    @abc.abstractmethod
    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        """Random weights of the set, for a learner to start from."""

    @abc.abstractmethod
    def violations(self, weights: Any) -> dict[str, Any]:
        """How far weights of shape (..., entry) lie outside the set, of shape (...), by condition.

        Takes numpy and jax arrays. 0 or less if a condition holds, NaN if a weight is NaN.
        """


class CappedSimplex(Feasible):
    """Long-only weights of sum 1, each asset's at most its limit; cash has no limit."""

    limits: Float[Array, " asset"]  # 0 where an asset cannot be traded

    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """The excess over an asset's limit stays in cash."""
        allowed = jnp.minimum(wanted[1:], self.limits)
        cash = wanted[:1] + (wanted[1:] - allowed).sum(keepdims=True)
        return jnp.concatenate([cash, allowed])

    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        """Random concentration, from nearly equal weights to nearly all in one."""
        spread_key, key = jax.random.split(key)
        spread = jax.random.uniform(spread_key, maxval=4.0)
        weights = jax.nn.softmax(spread * jax.random.gumbel(key, (self.limits.shape[0] + 1,)))
        return self.project(weights, weights)

    def violations(self, weights: Any) -> dict[str, Any]:
        xp = weights.__array_namespace__()
        return {
            "the sum is off 1 by": abs(weights.sum(-1) - 1),
            "a weight is below 0 by": -weights.min(-1),
            "a weight is above its limit by": (weights[..., 1:] - xp.asarray(self.limits)).max(-1),
        }
