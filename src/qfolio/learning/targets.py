"""What values and policies are learned towards: pure functions of a few numbers."""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

Weights = TypeVar("Weights", bound=PyTree)

Scalar = Float[Array, ""] | float
"""A number that may be an input of a compiled program."""


def chosen(
    values: Float[Array, "batch action *atom"], action: Int[Array, " batch"]
) -> Float[Array, "batch *atom"]:
    """What ``values`` says of one action of each row."""
    index = action.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def bootstrap(
    q_next: Float[Array, "batch action *atom"], selector: Float[Array, "batch action"]
) -> Float[Array, "batch *atom"]:
    """The next state's value: ``q_next`` at the action that ``selector`` finds best.

    Double Q-learning (van Hasselt et al. 2016, eq. 4) lets the online network select and the target
    network evaluate; with ``selector = q_next`` this is max_a Q'(s', a) (Mnih et al. 2015).
    """
    return chosen(q_next, selector.argmax(1))


def td_target(
    reward: Float[Array, "*batch"],
    terminal: Bool[Array, "*batch"],
    following: Float[Array, "*batch"],
    discount: Float[Array, "*#batch"] | float,
) -> Float[Array, "*batch"]:
    """Bellman target r + γ V(s'), where nothing follows a terminal transition."""
    return reward + jnp.where(terminal, 0.0, discount * following)


def possible_values(rewards: Float[Array, "2"], discount: Scalar) -> Float[Array, "2"]:
    """The lowest and the highest return over one step or more, of rewards between two numbers."""
    forever = rewards / jnp.maximum(1 - discount, 1e-9)
    lowest, highest = jnp.stack([rewards, forever], axis=1)
    return jnp.stack([lowest.min(), highest.max()])


def squash(value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """sign(v)(√(1 + |v|) − 1): like v/2 near zero, like a root far from it.

    Value rescaling of Pohlen et al. (2018, proposition A.2) without its small linear term. That
    term bounds the slope of the inverse; here the slope grows with the root.
    """
    return value / (1 + jnp.sqrt(1 + jnp.abs(value)))


def unsquash(root: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The value whose ``squash`` is ``root``."""
    return root * (2 + jnp.abs(root))


class Scale(NamedTuple):
    """Whether networks give values, or roots of them, among which small values weigh more.

    Where there is chance, the mean of the targets' roots is not the root of their mean: a value
    learned so is nearer to zero than the mean.
    """

    roots: bool

    def values(self, outputs: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """What a network's outputs say."""
        return unsquash(outputs) if self.roots else outputs

    def outputs(self, values: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """What a network should give for values."""
        return squash(values) if self.roots else values


def n_step(
    reward: Float[Array, "step batch"],
    last: Bool[Array, "step batch"],
    discount: Scalar,
) -> tuple[Float[Array, " batch"], Int[Array, " batch"]]:
    """Σ γᵏ rₖ up to the first step that is its episode's last, and the number of that step.

    Without such a step, up to the last one given (Sutton & Barto 2018, eq. 7.1, its sum alone).
    """
    before = jnp.concatenate([jnp.zeros_like(last[:1]), last[:-1]])
    counts = jnp.cumprod(1.0 - before, axis=0)
    power = discount ** jnp.arange(len(reward))[:, None]
    return (counts * power * reward).sum(0), counts.sum(0).astype(jnp.int32) - 1


def huber_loss(error: Float[Array, "*batch"], delta: Scalar) -> Float[Array, "*batch"]:
    """½e² up to |e| = δ and δ(|e| − ½δ) beyond (Huber 1964); δ = ∞ squares everything."""
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
    """Generalised advantage estimates (Schulman et al. 2016, eq. 16; ``gae_lambda`` is λ).

    ``next_value`` is that of the true next observation, so that a truncation is bootstrapped
    through while the sum of what follows stops there.
    """
    error = td_target(reward, terminated, next_value, discount) - value

    def back(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, goes_on = step
        now = error + discount * gae_lambda * goes_on * following
        return now, now

    goes_on = 1.0 - (terminated | truncated)
    return lax.scan(back, jnp.zeros_like(error[0]), (error, goes_on), reverse=True)[1]


def follow(target: Weights, online: Weights, rate: Scalar) -> Weights:
    """A target network, moved towards the online one by ``rate``; exact for rates of 0 and 1."""
    return jax.tree.map(lambda t, w: (1 - rate) * t + rate * w, target, online)
