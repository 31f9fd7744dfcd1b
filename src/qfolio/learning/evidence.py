"""Evidence that a learned policy earns more than the one it departs from, beyond luck."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import ExogenousTask, Transition
from qfolio.learning.trading import ratio


class Evidence(NamedTuple):
    """Active rewards (a policy's less those of the one it departs from), by block of the data."""

    steps: Float[Array, " block"]  # number of steps; earlier ones count less
    total: Float[Array, " block"]  # sum of active rewards
    square: Float[Array, " block"]  # sum of their squares

    @staticmethod
    def none(blocks: int) -> "Evidence":
        """Evidence before the first step."""
        return Evidence(*jnp.zeros((3, blocks)))

    def add(
        self,
        block: Int[Array, "time path"],
        active: Float[Array, "member time path"],
        unseen: Bool[Array, "member time path"],
        memory: Array | float,
    ) -> "Evidence":
        """The evidence with a rollout's steps added.

        unseen: whether a member has not learned from a step; the step counts only then. memory:
        factor on all steps, so that older ones fade.
        """
        counted, earned = 1.0 * unseen.any(0), (unseen * active).sum(0)
        new = (counted, earned, earned**2)
        where = block.ravel()
        return Evidence(
            *(memory * old.at[where].add(x.ravel()) for old, x in zip(self, new, strict=True))
        )

    @property
    def t(self) -> Float[Array, ""]:
        """The t-statistic, over blocks, of each block's mean over its deviation.

        So calm and volatile blocks weigh the same.
        """
        known = self.steps > 1
        mean = ratio(self.total, self.steps)
        deviation = jnp.sqrt(jnp.maximum(ratio(self.square, self.steps) - mean**2, 0.0))
        each, blocks = ratio(mean, deviation), known.sum()
        center = ratio((known * each).sum(), blocks)
        spread = ratio((known * (each - center) ** 2).sum(), jnp.maximum(blocks - 1.0, 0.0))
        return ratio(center * jnp.sqrt(1.0 * blocks), jnp.sqrt(spread))

    def share(self, threshold: Array | float) -> Float[Array, ""]:
        """The share of a departure that it leaves: 1 − (threshold/t)², or 0 for t ≤ threshold.

        The positive-part estimator of James & Stein (1961), for a single number.
        """
        t = jnp.maximum(self.t, 1e-9)
        return jnp.maximum(1 - (threshold / t) ** 2, 0.0)


def block_of(task: ExogenousTask, market: PyTree, blocks: int) -> Int[Array, ""]:
    """The block of the data that a move is in; the first one if moves are drawn anew."""
    share = jnp.clip(task.place(market) / task.moves, 0.0, 1.0)
    return jnp.minimum((blocks * share).astype(jnp.int32), blocks - 1)


def blocks_of(task: ExogenousTask, rollout: Transition, blocks: int) -> Int[Array, "time path"]:
    """The block of each step; if moves are drawn anew, each path belongs to one block."""
    found = jax.vmap(jax.vmap(lambda one: block_of(task, one, blocks)))(rollout.state.market)
    own = jnp.arange(found.shape[1]) % blocks
    return jnp.where(jnp.isfinite(task.moves), found, own)


def require_members(members: int, blocks: int) -> None:
    """Raises QfolioError unless each member can leave out a block and learn from another."""
    if not 2 <= members <= blocks:
        raise QfolioError(
            f"members is {members}; each leaves blocks out, so it must be from 2 to the number of "
            f"blocks, {blocks}."
        )


def left_out(block: Int[Array, "time path"], members: int) -> Bool[Array, "member time path"]:
    """The steps that each member does not learn from: those of every ``members``-th block."""
    return block % members == jnp.arange(members)[:, None, None]
