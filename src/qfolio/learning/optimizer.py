"""Gradient steps: Adam (Kingma & Ba 2015), or RMSProp and plain descent where a paper uses them.

The learning rate follows a cosine (Loshchilov & Hutter 2017).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.fields import require
from qfolio.core.mdp import Metrics
from qfolio.learning.targets import Scalar, Weights

KINDS = ("adam", "rmsprop", "rmsprop-centered", "sgd")
"""Optimizers by name: RMSProp as in Mnih et al. (2016), or centered as in Mnih et al. (2015)."""


class OptimizerConfig(NamedTuple):
    """An agent's settings for its optimizer, by the names that they have there."""

    optimizer: str = "adam"
    rmsprop_decay: float = 0.99  # of the running mean of squared gradients
    optimizer_epsilon: float = 1e-8  # added to the divisor of a gradient

    def check(self) -> None:
        """Raises QfolioError if the settings are invalid."""
        require(self, "optimizer", lambda x: x in KINDS, f"one of {', '.join(KINDS)}")
        require(self, "rmsprop_decay", lambda x: 0 <= x < 1, "at least 0 and below 1")
        require(self, "optimizer_epsilon", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")


ADAM = OptimizerConfig()

FIRST_DECAY, SECOND_DECAY = 0.9, 0.999
"""Adam's decay rates β₁ and β₂ of the running means of gradients and of their squares."""


class Optimizer(eqx.Module):
    """The state of an optimizer; arrays that its kind does not use stay zero."""

    count: Int[Array, ""]  # gradient steps so far
    mu: PyTree  # running means of the gradients
    nu: PyTree  # running means of their squares
    config: OptimizerConfig = eqx.field(static=True)

    def direction(self, gradient: Weights) -> tuple[Weights, "Optimizer"]:
        """The direction of descent, and the new state."""
        kind, decay, epsilon = self.config
        count, direction, mu, nu = self.count + 1, gradient, self.mu, self.nu
        if kind == "adam":
            mu = jax.tree.map(partial(_mean, FIRST_DECAY), mu, gradient)
            nu = jax.tree.map(partial(_mean, SECOND_DECAY), nu, _squares(gradient))
            # The correction of means that start at 0 is a factor of all weights (Adam, section 2);
            # to divide each mean by it takes longer.
            root = jnp.sqrt(1 - SECOND_DECAY**count)
            factor = root / (1 - FIRST_DECAY**count)
            direction = jax.tree.map(
                lambda m, n: factor * m / (jnp.sqrt(n) + epsilon * root), mu, nu
            )
        elif kind != "sgd":
            nu = jax.tree.map(partial(_mean, decay), nu, _squares(gradient))
            if kind == "rmsprop-centered":
                mu = jax.tree.map(partial(_mean, decay), mu, gradient)
            direction = jax.tree.map(
                lambda g, m, n: g / jnp.sqrt(jnp.maximum(n - m**2, 0) + epsilon), gradient, mu, nu
            )
        return direction, Optimizer(count, mu, nu, self.config)


class CosineSchedule(NamedTuple):
    """A learning rate that falls along a cosine; the names are those of agents' settings."""

    learning_rate: Scalar  # at the start
    learning_rate_final: Scalar  # share of it that remains at the end
    learning_rate_steps: Scalar  # gradient steps until then

    def __call__(self, update: Int[Array, ""]) -> Float[Array, ""]:
        """The learning rate of a gradient step, by its number."""
        done = jnp.minimum(update / self.learning_rate_steps, 1.0)
        weight = (1 + jnp.cos(jnp.pi * done)) / 2
        final = self.learning_rate_final
        return self.learning_rate * (final + weight * (1 - final))

    def check(self) -> None:
        """Raises QfolioError if a setting is out of range."""
        scales = "learning_rate learning_rate_steps"
        require(self, scales, lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        require(self, "learning_rate_final", lambda x: 0 <= x <= 1, "between 0 and 1")


def begin(weights: Weights, config: OptimizerConfig = ADAM) -> Optimizer:
    """The state before the first gradient step."""
    zeros = jax.tree.map(jnp.zeros_like, weights)
    return Optimizer(jnp.array(0, jnp.int32), zeros, zeros, config)


def descend(
    weights: Weights, gradient: Weights, optimizer: Optimizer, rate: Scalar
) -> tuple[Weights, Optimizer]:
    """One step down the gradient."""
    direction, optimizer = optimizer.direction(gradient)
    return jax.tree.map(lambda w, d: w - rate * d, weights, direction), optimizer


def minimize(
    loss: Callable[..., tuple[Float[Array, ""], Metrics]],
    weights: Weights,
    optimizer: Optimizer,
    rate: Scalar,
    *others: Any,
) -> tuple[Weights, Optimizer, Metrics]:
    """One step down the gradient in ``weights`` of ``loss(weights, *others)``."""
    gradient, metrics = jax.grad(loss, has_aux=True)(weights, *others)
    return *descend(weights, gradient, optimizer, rate), metrics


def repeat(
    update: Callable[[Weights, PRNGKeyArray], tuple[Weights, Metrics]],
    weights: Weights,
    times: int,
    key: PRNGKeyArray,
) -> tuple[Weights, Metrics]:
    """``times`` gradient steps in sequence, and the means of their metrics."""
    if times == 1:
        return update(weights, key)
    weights, metrics = lax.scan(update, weights, jax.random.split(key, times))
    return weights, {name: value.mean() for name, value in metrics.items()}


def norm(gradient: Weights) -> Float[Array, ""]:
    """The Euclidean norm over all weights."""
    return jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))


def clip(gradient: Weights, largest: Scalar) -> Weights:
    """The gradient, rescaled to the norm ``largest`` if it is longer."""
    length = norm(gradient)
    factor = jnp.where(length > largest, largest / length, 1.0)
    return jax.tree.map(lambda leaf: factor * leaf, gradient)


def _mean(decay: float, old: Array, new: Array) -> Array:
    return decay * old + (1 - decay) * new


def _squares(gradient: Weights) -> Weights:
    return jax.tree.map(jnp.square, gradient)
