"""Following paths in blocks of a few at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.paths import in_blocks


@pytest.mark.parametrize("most", [1, 5, 6, 100])
def test_blocks_of_paths_give_the_same_values_and_derivatives(most):
    wealth, moves = jax.random.uniform(jax.random.key(0), (2, 4, 6, 3))

    def grown(paths):
        start, factors = paths
        return (start[0] * jnp.cumprod(factors, 0)).sum(-1)

    def total(function, moves):
        found = function((wealth, moves))
        return (found * jnp.arange(24).reshape(4, 6)).sum(), found

    blocked = lambda paths: in_blocks(grown, paths, most)  # noqa: E731
    gradient = jax.grad(total, argnums=1, has_aux=True)
    for found, exact in zip(gradient(blocked, moves), gradient(grown, moves), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-6)
