"""Gradient steps: Adam (Kingma & Ba 2015), or RMSProp and plain descent where a paper uses them.

The learning rate follows a cosine (Loshchilov & Hutter 2017).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
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


class Optimizer(eqx.Module):
    """The state of an optimizer; arrays that its kind does not use stay zero."""

    count: Int[Array, ""]  # gradient steps so far
    mu: PyTree  # running means of the gradients
    nu: PyTree  # running means of their squares
    config: OptimizerConfig = eqx.field(static=True)

    def direction(self, gradient: Weights) -> tuple[Weights, "Optimizer"]:
        """The direction of descent, and the new state."""
        kind, decay, epsilon = self.config
        if kind == "adam":
            state = optax.ScaleByAdamState(self.count, self.mu, self.nu)
            direction, state = optax.scale_by_adam(eps=epsilon).update(gradient, state)
            return direction, Optimizer(state.count, state.mu, state.nu, self.config)
        direction, mu, nu = gradient, self.mu, self.nu
        if kind != "sgd":
            mean = lambda old, new: decay * old + (1 - decay) * new  # noqa: E731
            nu = jax.tree.map(lambda n, g: mean(n, g**2), nu, gradient)
            mu = jax.tree.map(mean, mu, gradient) if kind == "rmsprop-centered" else mu
            scaled = lambda g, m, n: g / jnp.sqrt(jnp.maximum(n - m**2, 0) + epsilon)  # noqa: E731
            direction = jax.tree.map(scaled, gradient, mu, nu)
        return direction, Optimizer(self.count + 1, mu, nu, self.config)


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
    state = optax.scale_by_adam().init(weights)
    return Optimizer(state.count, state.mu, state.nu, config)


def descend(
    weights: Weights, gradient: Weights, optimizer: Optimizer, rate: Scalar
) -> tuple[Weights, Optimizer]:
    """One step down the gradient."""
    direction, optimizer = optimizer.direction(gradient)
    updates = jax.tree.map(lambda d: -rate * d, direction)
    return optax.apply_updates(weights, updates), optimizer


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


def clip(gradient: Weights, norm: Scalar) -> Weights:
    """The gradient, rescaled to ``norm`` if it is longer."""
    return optax.clip_by_global_norm(norm).update(gradient, optax.EmptyState())[0]
