"""The replay buffer: a ring of the latest transitions (Lin 1992; Mnih et al. 2015)."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from qfolio.mdp import Transition


class Experience(NamedTuple):
    """What the buffer keeps of a transition; nothing is bootstrapped behind ``terminal``."""

    observation: PyTree
    action: Array
    reward: Float[Array, "*batch"]
    next_observation: PyTree
    terminal: Bool[Array, "*batch"]

    @staticmethod
    def of(rollout: Transition, *, time_limit_terminal: bool = False) -> "Experience":
        """A rollout's experiences in one row, by time and then environment."""
        step = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)
        terminal = step.terminated
        if time_limit_terminal:
            terminal = terminal | step.truncated
        return Experience(
            step.observation, step.action, step.reward, step.next_observation, terminal
        )


class Replay(eqx.Module):
    """Rows of any pytree of numbers; the oldest are overwritten.

    A row is packed into float32, which holds integers exactly up to 2²⁴. One matrix takes one
    in-place write and one gather; XLA would copy whole columns of one number a row at each step.
    Rows are written ``width`` at a time and the capacity is rounded up to a multiple of it, so that
    a write never wraps.
    """

    rows: Float[Array, "capacity numbers"]
    position: Int[Array, ""]  # of the next write
    size: Int[Array, ""]  # rows that hold something
    like: PyTree = eqx.field(static=True)  # shape and type of a row's leaves

    @staticmethod
    def empty(row: PyTree, capacity: int, width: int) -> "Replay":
        """Room for ``capacity`` rows shaped like ``row``."""
        capacity = -(-capacity // width) * width
        like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), row)
        numbers = sum(leaf.size for leaf in jax.tree.leaves(like))
        zero = jnp.array(0, jnp.int32)
        return Replay(jnp.zeros((capacity, numbers)), zero, zero, like)

    def add(self, rows: PyTree) -> "Replay":
        """Appends ``width`` rows."""
        leaves = jax.tree.leaves(rows)
        width = leaves[0].shape[0]
        packed = jnp.concatenate(
            [leaf.reshape(width, -1).astype(jnp.float32) for leaf in leaves], axis=1
        )
        capacity = self.rows.shape[0]
        return Replay(
            rows=lax.dynamic_update_slice_in_dim(self.rows, packed, self.position, axis=0),
            position=(self.position + width) % capacity,
            size=jnp.minimum(self.size + width, capacity),
            like=self.like,
        )

    def sample(self, key: PRNGKeyArray, n: int) -> PyTree:
        """``n`` rows drawn uniformly with replacement; the cost does not grow with capacity."""
        # One draw of uniforms instead of randint's two; float32 splits [0, 1) into 2²³ parts.
        index = (jax.random.uniform(key, (n,)) * self.size).astype(jnp.int32)
        return self.unpack(self.rows[index])

    def unpack(self, packed: Float[Array, "n numbers"]) -> PyTree:
        """Rows as they were before they were added."""
        leaves, structure = jax.tree.flatten(self.like)
        ends = [sum(leaf.size for leaf in leaves[: i + 1]) for i in range(len(leaves))]
        parts = jnp.split(packed, ends[:-1], axis=1)
        return jax.tree.unflatten(
            structure,
            [
                part.reshape(-1, *leaf.shape).astype(leaf.dtype)
                for part, leaf in zip(parts, leaves, strict=True)
            ],
        )
