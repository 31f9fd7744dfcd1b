"""Bootstrapped heads: several networks of action values, each learned from its own sample.

Their spread estimates the error of the values (Osband et al. 2016, "Deep exploration via
bootstrapped DQN"). The heads share no layers, and the data are sampled in blocks of consecutive
moves, because signals change slowly. Each head counts a block twice or not at all (double or
nothing, Owen & Eckles 2012), and this choice never changes.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core.mdp import ExogenousTask
from qfolio.learning.evidence import block_of
from qfolio.learning.networks import Network
from qfolio.learning.targets import Scalar

BLOCKS = 32
"""Number of blocks of equal length that the data are cut into."""


class Heads(eqx.Module):
    """Networks of equal shape, with a leading head axis."""

    networks: Network

    @staticmethod
    def build(make: Callable[[PRNGKeyArray], Network], count: int, key: PRNGKeyArray) -> "Heads":
        """``count`` networks from ``make``, each with a key of its own."""
        return Heads(jax.vmap(make)(jax.random.split(key, count)))


def samples(task: ExogenousTask, market: PyTree, heads: int) -> Float[Array, "head batch"]:
    """How often each head counts each move of a batch: twice or never.

    If moves are drawn anew, there is nothing to sample, and each move counts once.
    """
    block = jax.vmap(lambda one: block_of(task, one, BLOCKS))(market)
    counts = 2.0 * jax.random.bernoulli(jax.random.key(0), shape=(heads, BLOCKS))
    return jnp.where(jnp.isfinite(task.moves), counts[:, block], 1.0)


def cautious(
    values: Float[Array, "head batch action"], caution: Scalar
) -> Float[Array, "batch action"]:
    """Advantages over the first action, less ``caution`` times their standard error.

    The first action goes part of the way to the anchor, or orders nothing, and needs no evidence.
    """
    advantage = values - values[..., :1]
    return advantage.mean(0) - caution * advantage.std(0, ddof=1)
