"""Adam (Kingma & Ba 2015) with a cosine learning rate (Loshchilov & Hutter 2017)."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.fields import require
from qfolio.core.mdp import Metrics

Weights = TypeVar("Weights", bound=PyTree)

Optimizer: TypeAlias = optax.ScaleByAdamState


def begin(weights: Weights) -> Optimizer:
    return optax.scale_by_adam().init(weights)


def descend(
    agent: Any,
    weights: Weights,
    gradient: Weights,
    optimizer: Optimizer,
    rate: Float[Array, ""] | None = None,
) -> tuple[Weights, Optimizer]:
    """One step down the gradient, at ``rate`` or else the one that ``agent``'s settings tell."""
    direction, optimizer = optax.scale_by_adam().update(gradient, optimizer)
    if rate is None:
        rate = learning_rate(agent, optimizer.count)
    return jax.tree.map(lambda w, d: w - rate * d, weights, direction), optimizer


def repeat(
    update: Callable[[Weights, PRNGKeyArray], tuple[Weights, Metrics]],
    weights: Weights,
    times: int,
    key: PRNGKeyArray,
) -> tuple[Weights, Metrics]:
    """``times`` gradient steps one after the other, and the means of their metrics."""
    if times == 1:
        return update(weights, key)
    weights, metrics = lax.scan(update, weights, jax.random.split(key, times))
    return weights, {name: value.mean() for name, value in metrics.items()}


def clip(gradient: Weights, norm: Float[Array, ""] | float) -> Weights:
    """The gradient, or where it is longer than ``norm``, its direction at that length."""
    factor = jnp.minimum(1.0, norm / jnp.maximum(optax.tree.norm(gradient), 1e-30))
    return jax.tree.map(lambda g: factor * g, gradient)


def learning_rate(agent: Any, update: Int[Array, ""]) -> Float[Array, ""]:
    """A cosine from ``learning_rate`` to its final share, over ``learning_rate_steps`` updates."""
    done = jnp.minimum(update / agent.learning_rate_steps, 1.0)
    weight = (1 + jnp.cos(jnp.pi * done)) / 2
    final = agent.learning_rate_final
    return agent.learning_rate * (final + weight * (1 - final))


def require_schedule(agent: Any) -> None:
    """Raises QfolioError where the settings of the learning rate are out of range."""
    scales = "learning_rate learning_rate_steps"
    require(agent, scales, lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
    require(agent, "learning_rate_final", lambda x: 0 <= x <= 1, "between 0 and 1")
