"""Eigenvectors of symmetric matrices, and their linear systems.

On a CPU a batch is taken one matrix at a time. The library behind jax splits a batch over threads
that all devices share, and waits in one of them for the others: several devices at once can wait
for ever. One at a time is no slower.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

from qfolio.core.devices import LOCKSTEP

APART = 1e-4
"""Eigenvalues that are closer count as equal in derivatives."""


def solve(
    positive: Float[Array, "*batch n n"], sides: Float[Array, "*batch n m"]
) -> Float[Array, "*batch n m"]:
    """X of AX = B for positive definite matrices A, differentiable in both."""
    one = _each(_solved, "(n,n),(n,m)->(n,m)")
    return lax.custom_linear_solve(
        lambda x: positive @ x, sides, lambda _, b: one(positive, b), symmetric=True
    )


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
