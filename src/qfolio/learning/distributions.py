"""Distributions of a stochastic policy's actions, one for each kind of action.

All have leading batch axes. ``sample`` draws an action, ``log_prob`` is the log density (or log
probability) of a drawn action, and ``mode`` is the action without exploration. Distributions that
are made from normal numbers have ``coordinates`` of them, and ``at`` maps standard normal numbers
to an action.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.mdp import Actions, Discrete, Simplex


class Categorical(eqx.Module):
    """One of n actions, with probabilities softmax(logits)."""

    logits: Float[Array, "*batch action"]

    def sample(self, key: PRNGKeyArray) -> Int[Array, "*batch"]:
        return jax.random.categorical(key, self.logits).astype(jnp.int32)

    def log_prob(self, action: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
        logs = jax.nn.log_softmax(self.logits)
        return jnp.take_along_axis(logs, action[..., None], axis=-1)[..., 0]

    def entropy(self) -> Float[Array, "*batch"]:
        logs = jax.nn.log_softmax(self.logits)
        return -(jnp.exp(logs) * logs).sum(-1)

    def mode(self) -> Int[Array, "*batch"]:
        return self.logits.argmax(-1).astype(jnp.int32)


class Gaussian(eqx.Module):
    """Independent normal numbers; tasks clip them to their bounds."""

    mean: Float[Array, "*batch n"]
    log_std: Float[Array, "*#batch n"]

    @property
    def coordinates(self) -> int:
        """How many normal numbers make an action."""
        return self.mean.shape[-1]

    def at(self, noise: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        """The action of standard normal numbers."""
        return self.mean + jnp.exp(self.log_std) * noise

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch n"]:
        return self.at(jax.random.normal(key, self.mean.shape))

    def log_prob(self, action: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
        z = (action - self.mean) * jnp.exp(-self.log_std)
        return (-(z**2) / 2 - self.log_std - math.log(2 * math.pi) / 2).sum(-1)

    def entropy(self) -> Float[Array, "*batch"]:
        each = self.log_std + math.log(2 * math.pi * math.e) / 2
        return jnp.broadcast_to(each, self.mean.shape).sum(-1)

    def mode(self) -> Float[Array, "*batch n"]:
        return self.mean


class Squashed(eqx.Module):
    """Normal numbers squashed into ±``bound`` by tanh (Haarnoja et al. 2018, appendix C)."""

    normal: Gaussian
    bound: float = eqx.field(static=True)

    @property
    def coordinates(self) -> int:
        return self.normal.coordinates

    def at(self, noise: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        return self.bound * jnp.tanh(self.normal.at(noise))

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch n"]:
        return self.sample_and_log_prob(key)[0]

    def sample_and_log_prob(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch"]]:
        """A draw and its log density; gradients flow through both."""
        x = self.normal.sample(key)
        # log(1 − tanh² x) without cancellation when tanh x is close to ±1.
        slope = 2 * (math.log(2) - x - jax.nn.softplus(-2 * x)) + math.log(self.bound)
        return self.bound * jnp.tanh(x), self.normal.log_prob(x) - slope.sum(-1)

    def mode(self) -> Float[Array, "*batch n"]:
        return self.bound * jnp.tanh(self.normal.mode())


class LogisticNormal(eqx.Module):
    """Weights softmax(0, y) of cash and assets, with normal y (Aitchison & Shen 1980)."""

    normal: Gaussian

    @property
    def coordinates(self) -> int:
        return self.normal.coordinates

    def at(self, noise: Float[Array, "*batch asset"]) -> Float[Array, "*batch entry"]:
        return self._weights(self.normal.at(noise))

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch entry"]:
        return self._weights(self.normal.sample(key))

    def sample_and_log_prob(
        self, key: PRNGKeyArray
    ) -> tuple[Float[Array, "*batch entry"], Float[Array, "*batch"]]:
        """A draw and its log density on the simplex; gradients flow through both."""
        y = self.normal.sample(key)
        return self._weights(y), self._density(y)

    def log_prob(self, action: Float[Array, "*batch entry"]) -> Float[Array, "*batch"]:
        logs = jnp.log(jnp.maximum(action, 1e-30))
        return self._density(logs[..., 1:] - logs[..., :1])

    def entropy(self) -> Float[Array, "*batch"]:
        """The entropy of y; that of the weights differs by a term that depends on y's mean."""
        return self.normal.entropy()

    def mode(self) -> Float[Array, "*batch entry"]:
        """The weights of y's mean."""
        return self._weights(self.normal.mode())

    def _density(self, y: Float[Array, "*batch asset"]) -> Float[Array, "*batch"]:
        slope = jax.nn.log_softmax(_with_cash(y)).sum(-1)
        return self.normal.log_prob(y) - slope

    def _weights(self, y: Float[Array, "*batch asset"]) -> Float[Array, "*batch entry"]:
        return jax.nn.softmax(_with_cash(y))


Distribution = Categorical | Gaussian | LogisticNormal


def policy_of(
    actions: Actions,
    output: Float[Array, "*batch output"],
    log_std: Float[Array, " coordinate"],
) -> Distribution:
    """The policy that a network's output defines.

    output: as many numbers as ``networks.outputs_of(actions)``, in units of the bound if actions
    have one. log_std: of each coordinate, or one for all, in the same units.
    """
    if isinstance(actions, Discrete):
        return Categorical(output)
    if isinstance(actions, Simplex):
        y = output[..., 1:] - output[..., :1]
        return LogisticNormal(Gaussian(y, jnp.broadcast_to(log_std, y.shape[-1:])))
    log_std = jnp.broadcast_to(log_std + math.log(actions.unit), output.shape[-1:])
    return Gaussian(actions.unit * output, log_std)


def _with_cash(y: Float[Array, "*batch asset"]) -> Float[Array, "*batch entry"]:
    return jnp.concatenate([jnp.zeros_like(y[..., :1]), y], -1)
