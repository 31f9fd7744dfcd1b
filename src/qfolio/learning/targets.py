"""Targets and losses of values and policies, as pure functions."""

from functools import reduce
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, PyTree

Weights = TypeVar("Weights", bound=PyTree)

Scalar = Float[Array, ""] | float
"""A number that may be an input of a compiled program."""


def chosen(
    values: Float[Array, "batch action *atom"], action: Int[Array, " batch"]
) -> Float[Array, "batch *atom"]:
    """The values of the action chosen in each row."""
    index = action.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def bootstrap(
    q_next: Float[Array, "batch action *atom"], selector: Float[Array, "batch action"]
) -> Float[Array, "batch *atom"]:
    """The next state's value: ``q_next`` at the best action of ``selector``.

    Double Q-learning (van Hasselt et al. 2016, eq. 4) lets the online network select and the target
    network evaluate; with ``selector = q_next`` this is max_a Q'(s', a) (Mnih et al. 2015).
    """
    return chosen(q_next, selector.argmax(1))


def smallest(values: Float[Array, "critic *batch"]) -> Float[Array, "*batch"]:
    """The smallest of several estimates, with its gradient.

    It is selected by comparisons, because the gradient of ``min`` asks which estimate equals the
    minimum. If a compiler computes the estimates twice and rounds them differently, none does, and
    that gradient is 0/0.
    """
    return reduce(lambda least, other: jnp.where(other < least, other, least), values)


def td_target(
    reward: Float[Array, "*batch"],
    terminal: Bool[Array, "*batch"],
    following: Float[Array, "*batch"],
    discount: Float[Array, "*#batch"] | float,
) -> Float[Array, "*batch"]:
    """Bellman target r + γ V(s'), or r if the transition is terminal."""
    return reward + jnp.where(terminal, 0.0, discount * following)


def possible_values(rewards: Float[Array, "2"], discount: Scalar) -> Float[Array, "2"]:
    """The lowest and highest possible return over one step or more, given the range of rewards."""
    forever = rewards / jnp.maximum(1 - discount, 1e-9)
    lowest, highest = jnp.stack([rewards, forever], axis=1)
    return jnp.stack([lowest.min(), highest.max()])


def squash(value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """sign(v)(√(1 + |v|) − 1): like v/2 near zero and like a square root far from it.

    Value rescaling of Pohlen et al. (2018, proposition A.2) without its small linear term. That
    term bounds the slope of the inverse; here the slope grows with the root.
    """
    return value / (1 + jnp.sqrt(1 + jnp.abs(value)))


def unsquash(root: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The value whose ``squash`` is ``root``."""
    return root * (2 + jnp.abs(root))


class Scale(NamedTuple):
    """Whether networks output values or their roots, which give small values more weight.

    If returns are random, the mean of the targets' roots is not the root of their mean: a value
    learned this way is biased towards zero.
    """

    roots: bool

    def values(self, outputs: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The values of a network's outputs."""
        return unsquash(outputs) if self.roots else outputs

    def outputs(self, values: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The outputs that stand for values."""
        return squash(values) if self.roots else values


def n_step(
    reward: Float[Array, "step batch"],
    last: Bool[Array, "step batch"],
    discount: Scalar,
) -> tuple[Float[Array, " batch"], Int[Array, " batch"]]:
    """Σ γᵏ rₖ up to the episode's last step, and the number k of that step.

    If the episode continues, the sum ends with the last step given (Sutton & Barto 2018, eq. 7.1).
    """
    before = jnp.concatenate([jnp.zeros_like(last[:1]), last[:-1]])
    counts = jnp.cumprod(1.0 - before, axis=0)
    power = discount ** jnp.arange(len(reward))[:, None]
    return (counts * power * reward).sum(0), counts.sum(0).astype(jnp.int32) - 1


def huber_loss(error: Float[Array, "*batch"], delta: Scalar) -> Float[Array, "*batch"]:
    """½e² up to |e| = δ and δ(|e| − ½δ) beyond (Huber 1964); δ = ∞ gives the squared error."""
    clipped = jnp.clip(error, -delta, delta)
    return clipped * (error - clipped / 2)


def advantages(
    reward: Float[Array, "time environment"],
    value: Float[Array, "time environment"],
    next_value: Float[Array, "time environment"],
    terminated: Bool[Array, "time environment"],
    truncated: Bool[Array, "time environment"],
    discount: Scalar,
    gae_lambda: Scalar,
) -> Float[Array, "time environment"]:
    """Generalized advantage estimates (Schulman et al. 2016, eq. 16; ``gae_lambda`` is λ).

    ``next_value`` is that of the true next observation: a truncation bootstraps from it, while the
    sum of later errors stops there.
    """
    error = td_target(reward, terminated, next_value, discount) - value

    def back(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, goes_on = step
        now = error + discount * gae_lambda * goes_on * following
        return now, now

    goes_on = 1.0 - (terminated | truncated)
    return lax.scan(back, jnp.zeros_like(error[0]), (error, goes_on), reverse=True)[1]


def follow(target: Weights, online: Weights, rate: Scalar) -> Weights:
    """The target network after a step of ``rate`` towards the online one; exact for 0 and 1."""
    return jax.tree.map(lambda t, w: (1 - rate) * t + rate * w, target, online)


def follow_when(due: Bool[Array, ""], target: Weights, online: Weights, rate: Scalar) -> Weights:
    """``follow`` if it is due, and otherwise the target as it is, without a pass over its memory.

    Members in lockstep pass over all of their targets if it is due for one of them.
    """

    def step() -> Weights:
        return follow(target, online, jnp.where(due, rate, 0))

    return lax.cond(_for_any(due), step, lambda: target)


@custom_vmap
def _for_any(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """The flag, or in a batch whether any is set.

    By one flag for all, ``lax.cond`` runs one branch; by a batch of them it would run both.
    """
    return flag


@_for_any.def_vmap
def _(size: int, batched: list[bool], flags: Bool[Array, " member"]) -> tuple[Array, bool]:
    return _for_any(flags.any()), False
