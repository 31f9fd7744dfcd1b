"""Eigenvectors of symmetric matrices, and their linear systems.

On a CPU a batch is taken one matrix at a time, unless its systems are small. The library behind jax
splits a batch over threads that all devices share, and waits in one of them for the others: several
devices at once can wait for ever. One at a time is no slower.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

from qfolio.core.devices import LOCKSTEP

SMALL = 12
"""Largest systems that a batch solves side by side. For 8 equations this takes a fifth of the time,
for 16 as long."""

APART = 1e-4
"""Eigenvalues that are closer count as equal in derivatives."""


def solve(
    positive: Float[Array, "*batch n n"], sides: Float[Array, "*batch n m"]
) -> Float[Array, "*batch n m"]:
    """X of AX = B for positive definite matrices A, differentiable in both."""
    shapes = "(n,n),(n,m)->(n,m)"
    small = positive.shape[-1] <= SMALL
    one = jnp.vectorize(eliminate, signature=shapes) if small else _each(_solved, shapes)
    return lax.custom_linear_solve(
        lambda x: positive @ x, sides, lambda _, b: one(positive, b), symmetric=True
    )


def eliminate(
    positive: Float[Array, "n n *batch"], sides: Float[Array, "n m *batch"]
) -> Float[Array, "n m *batch"]:
    """As ``solve``, by elimination, which needs no pivoting for positive definite matrices."""
    size = len(positive)
    rows = jnp.expand_dims(jnp.arange(size), range(1, positive.ndim))

    def step(i: Array, table: Array) -> Array:
        row = lax.dynamic_index_in_dim(table, i, 0)
        column = lax.dynamic_index_in_dim(table, i, 1)
        row /= lax.dynamic_index_in_dim(row, i, 1)
        return jnp.where(rows == i, row, table - column * row)

    table = jnp.concatenate([positive, sides], 1)
    return lax.fori_loop(0, size, step, table)[:, size:]


@jax.custom_jvp
def spectrum(symmetric: Float[Array, "*batch n n"]) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors, with a derivative where eigenvalues are equal.

    Vectors of equal eigenvalues are not defined one by one, and jax gives no number for their
    derivatives. What is made from vectors and a smooth function of values has one nevertheless; the
    terms left out here are zero for it.
    """
    found: tuple[Array, Array] = _each(_decomposed, "(n,n)->(n),(n,n)")(symmetric)
    return found


@spectrum.defjvp
def _spectrum_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple:
    values, vectors = spectrum(*primals)
    turned = jnp.swapaxes(vectors, -1, -2) @ tangents[0] @ vectors
    gap = values[..., None, :] - values[..., :, None]
    apart = jnp.abs(gap) > APART
    rotation = jnp.where(apart, turned / jnp.where(apart, gap, 1.0), 0.0)
    change = jnp.diagonal(turned, axis1=-2, axis2=-1)
    return (values, vectors), (change, vectors @ rotation)


def _solved(positive: Array, sides: Array) -> Array:
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(positive), True), sides)


def _decomposed(symmetric: Array) -> tuple[Array, Array]:
    return tuple(jnp.linalg.eigh(symmetric))


def _each(function: Callable, signature: str) -> Callable:
    """The function over leading axes, also those that a later vmap adds."""
    lockstep = jax.default_backend() in LOCKSTEP
    return jnp.vectorize(function if lockstep else sequential_vmap(function), signature=signature)
