"""What values and policies are learned towards: pure functions of a few numbers."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

Weights = TypeVar("Weights", bound=PyTree)


def bootstrap(
    q_next: Float[Array, "batch action"], selector: Float[Array, "batch action"]
) -> Float[Array, " batch"]:
    """The next state's value: ``q_next`` at the action that ``selector`` finds best.

    Double Q-learning (van Hasselt et al. 2016, eq. 4) lets the online network select and the target
    network evaluate; with ``selector = q_next`` this is max_a Q'(s', a) (Mnih et al. 2015).
    """
    return jnp.take_along_axis(q_next, selector.argmax(1)[:, None], axis=1)[:, 0]


def td_target(
    reward: Float[Array, " batch"],
    terminal: Bool[Array, " batch"],
    following: Float[Array, " batch"],
    discount: Float[Array, ""] | float,
) -> Float[Array, " batch"]:
    """Bellman target r + γ V(s'), where nothing follows a terminal transition."""
    return reward + jnp.where(terminal, 0.0, discount * following)


def huber_loss(
    error: Float[Array, "*batch"], delta: Float[Array, ""] | float
) -> Float[Array, "*batch"]:
    """½e² up to |e| = δ and δ(|e| − ½δ) beyond (Huber 1964); δ = ∞ squares everything."""
    clipped = jnp.clip(error, -delta, delta)
    return clipped * (error - clipped / 2)


def advantages(
    reward: Float[Array, "time environment"],
    value: Float[Array, "time environment"],
    next_value: Float[Array, "time environment"],
    terminated: Bool[Array, "time environment"],
    truncated: Bool[Array, "time environment"],
    discount: Float[Array, ""] | float,
    trace: Float[Array, ""] | float,
) -> Float[Array, "time environment"]:
    """Generalised advantage estimates (Schulman et al. 2016, eq. 16; ``trace`` is λ).

    ``next_value`` is that of the true next observation, so that a truncation is bootstrapped
    through while the sum of what follows stops there.
    """
    error = td_target(reward, terminated, next_value, discount) - value

    def back(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, goes_on = step
        now = error + discount * trace * goes_on * following
        return now, now

    goes_on = 1.0 - (terminated | truncated)
    return lax.scan(back, jnp.zeros_like(error[0]), (error, goes_on), reverse=True)[1]


def follow(target: Weights, online: Weights, rate: Float[Array, ""] | float) -> Weights:
    """A target network, moved towards the online one by ``rate``; exact for rates of 0 and 1."""
    return jax.tree.map(lambda t, w: (1 - rate) * t + rate * w, target, online)
