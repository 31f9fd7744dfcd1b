"""Adam (Kingma & Ba 2015) with a cosine learning rate (Loshchilov & Hutter 2017)."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.fields import require
from qfolio.core.mdp import Metrics
from qfolio.learning.targets import Scalar

Weights = TypeVar("Weights", bound=PyTree)

Optimizer: TypeAlias = optax.ScaleByAdamState


class CosineSchedule(NamedTuple):
    """A learning rate that falls along a cosine; the names are those of the agents' settings."""

    learning_rate: Scalar  # at the start
    learning_rate_final: Scalar  # share of it that remains at the end
    learning_rate_steps: Scalar  # gradient steps until then

    def __call__(self, update: Int[Array, ""]) -> Float[Array, ""]:
        """The learning rate of a gradient step."""
        done = jnp.minimum(update / self.learning_rate_steps, 1.0)
        weight = (1 + jnp.cos(jnp.pi * done)) / 2
        final = self.learning_rate_final
        return self.learning_rate * (final + weight * (1 - final))

    def check(self) -> None:
        """Raises QfolioError if a setting is out of range."""
        scales = "learning_rate learning_rate_steps"
        require(self, scales, lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        require(self, "learning_rate_final", lambda x: 0 <= x <= 1, "between 0 and 1")


def begin(weights: Weights) -> Optimizer:
    return optax.scale_by_adam().init(weights)


def descend(
    weights: Weights, gradient: Weights, optimizer: Optimizer, rate: Scalar
) -> tuple[Weights, Optimizer]:
    """One step down the gradient."""
    direction, optimizer = optax.scale_by_adam().update(gradient, optimizer)
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
