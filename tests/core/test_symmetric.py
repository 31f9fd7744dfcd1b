"""Symmetric matrices: exact, differentiable, and never waiting for ever."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.symmetric import solve, spectrum

from jobs import LIMIT

PROGRAM = """
from qfolio.core import devices
devices.configure()
import jax, jax.numpy as jnp
from qfolio.core.symmetric import solve, spectrum
many = jax.random.normal(jax.random.key(0), (200, 36, 36))
many = many @ jnp.swapaxes(many, 1, 2) + jnp.eye(36)
both = jax.jit(lambda x: (spectrum(x), solve(x, x[..., :2])))
for _ in range(100):
    devices.side_by_side(lambda _: jax.block_until_ready(both(many)), max(2, len(devices.cores())))
"""


def test_batches_end_in_several_programs_at_once():
    environment = {k: v for k, v in os.environ.items() if k not in ("NPROC", "XLA_FLAGS")}
    subprocess.run([sys.executable, "-c", PROGRAM], env=environment, timeout=LIMIT, check=True)


@pytest.fixture
def matrices():
    factors = jax.random.normal(jax.random.key(0), (3, 2, 4, 4))
    return factors @ jnp.swapaxes(factors, -1, -2) + jnp.eye(4)


def test_solutions_and_their_derivatives(matrices):
    sides = jax.random.normal(jax.random.key(1), (3, 2, 4, 2))
    found, change = jax.jvp(solve, (matrices, sides), (sides @ sides.swapaxes(-1, -2), sides))
    wanted, expected = jax.jvp(
        jnp.linalg.solve, (matrices, sides), (sides @ sides.swapaxes(-1, -2), sides)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(change, expected, rtol=1e-3, atol=1e-5)
    mapped = jax.vmap(jax.grad(lambda a, b: solve(a, b).sum()))(matrices, sides)
    direct = jax.grad(lambda a: jnp.linalg.solve(a, sides).sum())(matrices)
    symmetric = lambda x: x + jnp.swapaxes(x, -1, -2)  # noqa: E731
    np.testing.assert_allclose(symmetric(mapped), symmetric(direct), rtol=1e-3, atol=1e-4)


def test_a_batch_is_decomposed_as_its_matrices(matrices):
    values, vectors = jax.vmap(spectrum)(matrices)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(np.asarray(matrices)), rtol=1e-4)
    again = (vectors * values[..., None, :]) @ jnp.swapaxes(vectors, -1, -2)
    np.testing.assert_allclose(again, matrices, rtol=1e-4, atol=1e-4)


def test_spectrum_has_the_derivative_of_functions_of_the_matrix():
    """The square of a matrix with equal eigenvalues, made from its eigenvectors."""
    matrix = jnp.diag(jnp.array([1.0, 1.0, 3.0]))
    change = jnp.array([[0.1, 0.5, 0.2], [0.5, -0.3, 0.4], [0.2, 0.4, 0.6]])

    def square(x):
        values, vectors = spectrum(x)
        return (vectors * values**2) @ vectors.T

    _, found = jax.jvp(square, (matrix,), (change,))
    wanted = matrix @ change + change @ matrix
    equal = np.zeros((3, 3), bool)
    equal[:2, :2] = ~np.eye(2, dtype=bool)  # the terms that are left out
    np.testing.assert_allclose(found[~equal], wanted[~equal], atol=1e-5)
