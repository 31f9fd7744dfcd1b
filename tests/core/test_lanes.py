"""Functions that are computed only where they are needed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from qfolio.core.lanes import where_needed


def affine(own, shared):
    (x, y), (matrix, row) = own, shared
    return {"vector": matrix @ x + y, "sum": row @ x}


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
def test_each_item_gets_its_own_result_however_it_is_mapped(share):
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(7, 5, 9, 3)), rng.normal(size=(7, 5, 9, 2))
    matrix, row = rng.normal(size=(7, 9, 2, 3)), rng.normal(size=(5, 3))
    needed = rng.random((7, 5, 9)) < share

    def one(needed, x, y, matrix, row):
        return where_needed(affine, needed, (x, y), (matrix, row))

    # Its three axes are mapped in turn, and each of what is shared has only some of them.
    mapped = jax.vmap(one, in_axes=(0, 0, 0, 0, None))
    mapped = jax.vmap(mapped, in_axes=(0, 0, 0, None, 0))
    mapped = jax.vmap(mapped, in_axes=(0, 0, 0, 0, None))
    found = jax.jit(mapped)(needed, x, y, matrix, row)
    vector = np.einsum("iklm,ijkm->ijkl", matrix, x) + y
    expected = np.where(needed[..., None], vector, 0.0)
    np.testing.assert_allclose(found["vector"], expected, atol=1e-5)
    expected = np.where(needed, np.einsum("jm,ijkm->ijk", row, x), 0.0)
    np.testing.assert_allclose(found["sum"], expected, atol=1e-5)


def test_items_that_need_nothing_are_not_computed():
    """A loop that would never end for them shows it."""

    def endless_below(x, _):
        return lax.while_loop(lambda x: x < 1.0, lambda x: x + 0.5 * (x > 0), x)

    xs = jnp.concatenate([jnp.full(100, -1.0), jnp.array([0.1, 0.3])])
    found = jax.vmap(lambda x: where_needed(endless_below, x > 0, x, ()))(xs)
    np.testing.assert_allclose(found, [0.0] * 100 + [1.1, 1.3], rtol=1e-6)
