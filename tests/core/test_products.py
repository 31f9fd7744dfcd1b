"""Long products round alike in pools of one thread and of many."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core import devices

PROGRAM = """
import hashlib
import jax, jax.numpy as jnp, numpy as np
from qfolio.core import devices, products

if {plain}:
    products.register = lambda: None
devices.configure()
rng = np.random.default_rng(0)
factors = [rng.standard_normal((2048, n)).astype(np.float32) for n in (300, 4)]
factors.append(rng.standard_normal((2, 2048, 32)).astype(np.float32))

def loss(w, x, y):
    return (jnp.tanh(x @ w) * y).sum()

found = {{
    "gradient": lambda x, y, stack: jax.grad(loss)(jnp.ones((300, 4)) / 300, x, y),
    "first axes": lambda x, y, stack: jnp.einsum("ki,kj->ij", x, y),
    "exchanged": lambda x, y, stack: jnp.einsum("ki,kj->ji", x, y),
    "turned before": lambda x, y, stack: x.T @ y,
    "turned after": lambda x, y, stack: (y.T @ x).T,
    "turned all": lambda x, y, stack: (jnp.tanh(x.T) @ y).T,
    "batch of both": lambda x, y, stack: jax.vmap(lambda u: u.T @ u)(stack),
    "gradient of a stack": lambda x, y, stack: jax.grad(
        lambda w: jnp.tanh(stack @ w).sum()
    )(jnp.ones((32, 3)) / 32),
}}
for name, product in found.items():
    compiled = jax.jit(product).lower(*factors).compile(compiler_options=devices.PRODUCTS_ONLY)
    print(name, hashlib.sha256(np.asarray(compiled(*factors)).tobytes()).hexdigest(), sep="|")
"""


def hashes(threads: int, *, plain: bool = False) -> dict[str, str]:
    environment = os.environ | {"NPROC": str(threads), "XLA_FLAGS": ""}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(plain=plain)],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return dict(line.split("|") for line in done.stdout.splitlines())


def test_products_do_not_depend_on_the_number_of_threads():
    one = hashes(1)
    assert len(one) == 8
    assert one == hashes(8)


@pytest.mark.slow
def test_products_would_depend_on_the_number_of_threads():
    """If this fails, products.py is no longer needed."""
    one, many = hashes(1, plain=True), hashes(8, plain=True)
    assert [name for name in one if one[name] == many[name]] == []


@pytest.mark.parametrize(
    ("sums", "shapes"),
    [
        ("ki,kj->ij", [(70, 3), (70, 4)]),
        ("ki,kj->ji", [(70, 3), (70, 4)]),
        ("ik,kj->ij", [(3, 70), (70, 4)]),
        ("ik,jk->ij", [(3, 70), (4, 70)]),
        ("bki,bkj->bij", [(2, 70, 3), (2, 70, 4)]),
        ("kbi,jkb->bij", [(70, 2, 3), (4, 70, 2)]),
        ("bki,bkj->ij", [(9, 8, 3), (9, 8, 4)]),
        ("bki,kj->bij", [(2, 70, 3), (70, 4)]),
        ("k,k->", [(70,), (70,)]),
        ("bki,bkj->bij", [(0, 70, 3), (0, 70, 4)]),
        ("ki,kj->ij", [(70, 3), (70, 0)]),
        ("ki,k->i", [(70, 3), (70,)]),
    ],
)
def test_arranged_products_have_the_same_value_and_derivative(sums, shapes):
    devices.configure()
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal(shape).astype(np.float32) for shape in shapes)
    product = jax.jit(lambda a, b: jnp.einsum(sums, a, b))
    np.testing.assert_allclose(product(a, b), np.einsum(sums, a, b), rtol=1e-4, atol=1e-4)
    left, right = jax.jit(jax.grad(lambda a, b: jnp.einsum(sums, a, b).sum(), (0, 1)))(a, b)
    inputs, result = sums.split("->")
    first, second = inputs.split(",")
    ones = np.ones_like(np.einsum(sums, a, b))
    np.testing.assert_allclose(
        left, np.einsum(f"{result},{second}->{first}", ones, b), rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(
        right, np.einsum(f"{result},{first}->{second}", ones, a), rtol=1e-4, atol=1e-4
    )


def test_a_program_of_any_length_can_be_exported():
    devices.configure()
    export = jax.export
    rows = jax.ShapeDtypeStruct(export.symbolic_shape("n, 3"), jnp.float32)
    gradient = jax.jit(jax.grad(lambda w, x: jnp.tanh(x @ w).sum()))
    program = export.export(gradient)(jax.ShapeDtypeStruct((3, 2), jnp.float32), rows)
    x, w = np.ones((70, 3), np.float32), np.ones((3, 2), np.float32)
    np.testing.assert_allclose(program.call(w, x), gradient(w, x), rtol=1e-5)
