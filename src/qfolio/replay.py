"""The replay buffer: a ring of the latest transitions (Lin 1992; Mnih et al. 2015)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, PRNGKeyArray, PyTree


class Replay(eqx.Module):
    """Rows of any pytree; the oldest are overwritten.

    Rows are written ``width`` at a time and the capacity is rounded up to a multiple of it, so that
    a write never wraps and stays one in-place copy.
    """

    rows: PyTree
    written: Int[Array, ""]  # since the beginning, overwritten ones included

    @staticmethod
    def empty(row: PyTree, capacity: int, width: int) -> "Replay":
        """Room for ``capacity`` rows shaped like ``row``."""
        capacity = -(-capacity // width) * width
        rows = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), row)
        return Replay(rows, jnp.array(0, jnp.int32))

    @property
    def capacity(self) -> int:
        return jax.tree.leaves(self.rows)[0].shape[0]

    def add(self, rows: PyTree) -> "Replay":
        """Appends ``width`` rows."""
        width = jax.tree.leaves(rows)[0].shape[0]
        at = self.written % self.capacity
        put = lambda old, new: lax.dynamic_update_slice_in_dim(old, new, at, axis=0)  # noqa: E731
        return Replay(jax.tree.map(put, self.rows, rows), self.written + width)

    def sample(self, key: PRNGKeyArray, n: int) -> PyTree:
        """``n`` rows drawn uniformly with replacement; the cost does not grow with capacity."""
        size = jnp.minimum(self.written, self.capacity)
        # One draw of uniforms instead of randint's two; float32 splits [0, 1) into 2²³ parts.
        index = (jax.random.uniform(key, (n,)) * size).astype(jnp.int32)
        return jax.tree.map(lambda x: x[index], self.rows)
