"""Evidence that a learned policy earns more than the one it departs from, beyond luck."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from qfolio.core.fields import require, require_counts
from qfolio.core.mdp import ExogenousTask, Transition
from qfolio.learning.targets import Scalar
from qfolio.learning.trading import ratio


class EvidenceConfig(NamedTuple):
    """An agent's settings for its evidence, by the names that they have there."""

    members: int
    blocks: int
    threshold: Scalar
    memory: Scalar

    def check(self) -> None:
        """Raises QfolioError if a setting is out of range."""
        require_counts(self, "blocks")
        wanted = f"from 2 to the number of blocks, {self.blocks}, of which each leaves some out"
        require(self, "members", lambda x: 2 <= x <= self.blocks, wanted)
        require(self, "threshold", lambda x: 0 <= x <= 1e3, "from 0 to 1,000")
        require(self, "memory", lambda x: 0 < x < 1, "above 0 and below 1")


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

        The positive-part estimator of James & Stein (1961), for a single number. With a threshold
        of 0 it is always 1.
        """
        t = jnp.maximum(self.t, 1e-9)
        return jnp.maximum(1 - (threshold / t) ** 2, 0.0)


def block_of(task: ExogenousTask, market: PyTree, blocks: int) -> Int[Array, ""]:
    """The block of the data that a move is in; the first one if moves are drawn anew."""
    share = jnp.clip(task.place(market) / task.moves, 0.0, 1.0)
    return jnp.minimum((blocks * share).astype(jnp.int32), blocks - 1)


def blocks_of(
    task: ExogenousTask, rollout: Transition, blocks: int, every: int = 1
) -> Int[Array, "time path"]:
    """The block of each step; if moves are drawn anew, each path belongs to one block.

    Then every ``every``-th path is in the next block, so that these alone are in many, too.
    """
    found = jax.vmap(jax.vmap(lambda one: block_of(task, one, blocks)))(rollout.state.market)
    count = found.shape[1]
    path, rounds = jnp.arange(count), -(-count // every)
    own = (path % every * rounds + path // every) % blocks
    return jnp.where(jnp.isfinite(task.moves), found, own)


def left_out(block: Int[Array, "time path"], members: int) -> Bool[Array, "member time path"]:
    """The steps that each member does not learn from: those of every ``members``-th block."""
    return block % members == jnp.arange(members)[:, None, None]
