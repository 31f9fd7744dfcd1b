"""Priorities of the rows of a replay buffer (Schaul et al. 2016): a tree of sums in arrays."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.learning.targets import Scalar

FAN = 16
"""Children of a node."""


class Priorities(eqx.Module):
    """Rows' priorities; rows are drawn in proportion to them. Updates and draws cost O(log rows).

    The last level holds the rows' priorities, FAN to a node, and each level above holds the sums of
    the nodes below it. A wide tree is shallow: few dependent steps, each over many numbers at once.
    Sums are recomputed from their children, so that rounding errors do not accumulate.
    """

    levels: list[Float[Array, "_ 16"]]  # from the root's children to the rows
    highest: Float[Array, ""]  # of all rows so far; new rows get it

    @staticmethod
    def empty(capacity: int) -> "Priorities":
        """Priorities of 0, with which no row can be drawn yet."""
        levels: list[Array] = []
        nodes = capacity
        while not levels or nodes > 1:
            nodes = -(-nodes // FAN)
            levels.insert(0, jnp.zeros((nodes, FAN)))
        return Priorities(levels, jnp.array(1.0))

    @property
    def total(self) -> Float[Array, ""]:
        """The sum of all priorities."""
        return self.levels[0].sum()

    def of(self, index: Int[Array, " n"]) -> Float[Array, " n"]:
        """The priorities of rows."""
        return self.levels[-1][index // FAN, index % FAN]

    def set(self, index: Int[Array, " n"], values: Float[Array, " n"]) -> "Priorities":
        """Sets rows to ``values``; a row that is given twice must have equal values."""
        highest = jnp.maximum(self.highest, values.max())
        levels = []
        for level in reversed(self.levels):
            index, child = index // FAN, index % FAN
            level = level.at[index, child].set(values)
            values = level[index].sum(-1)
            levels.append(level)
        return Priorities(levels[::-1], highest)

    def draw(self, key: PRNGKeyArray, n: int) -> Int[Array, " n"]:
        """``n`` rows, one from each of ``n`` equal parts of the sum (stratified)."""
        strata = (jnp.arange(n) + jax.random.uniform(key, (n,))) / n
        return self.find(strata * self.total)

    def find(self, mass: Float[Array, " n"]) -> Int[Array, " n"]:
        """The rows at which the running sum of all rows' priorities first exceeds ``mass``."""
        node = jnp.zeros(mass.shape, jnp.int32)
        for level in self.levels:
            children = level[node]
            sums = children.cumsum(-1)
            # A child with zero sum is never taken, whatever the rounding.
            reached = jnp.where(children > 0, sums, -1.0)
            bound = jnp.minimum(mass, 0.9999999 * reached.max(-1))[:, None]
            child = jnp.argmax(reached > bound, axis=-1).astype(jnp.int32)
            before = jnp.take_along_axis(sums - children, child[:, None], axis=-1)[:, 0]
            mass = jnp.maximum(mass - before, 0.0)
            node = node * FAN + child
        return node

    def update(
        self, index: Int[Array, " n"], off: Float[Array, " n"], exponent: Scalar
    ) -> "Priorities":
        """Sets rows to their absolute errors ``off``, raised to the power α (``exponent``)."""
        return self.set(index, (off + 1e-6) ** exponent)  # above 0, so that any is drawn again

    def importance(self, index: Int[Array, " n"], exponent: Scalar) -> Float[Array, " n"]:
        """Weights (N P(i))^−exponent of drawn rows, scaled to a maximum of 1 (section 3.4)."""
        drawn = self.of(index)
        return (drawn.min() / drawn) ** exponent


class ImportanceSchedule(NamedTuple):
    """β, the exponent of importance weights, which rises linearly to 1."""

    importance_exponent: Scalar  # at the start
    importance_steps: Scalar  # gradient steps until it is 1

    def __call__(self, updates: Int[Array, ""]) -> Float[Array, ""]:
        """β after this many gradient steps."""
        done = jnp.minimum(updates / self.importance_steps, 1.0)
        return self.importance_exponent + (1 - self.importance_exponent) * done
