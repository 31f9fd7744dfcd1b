"""Networks that score assets."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.learning.scores import NETWORKS


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_start_at_zero_and_do_not_depend_on_the_order_of_assets(name):
    network = NETWORKS[name](4, 3, jax.random.key(0))
    inputs = jax.random.normal(jax.random.key(1), (2, 5, 4))
    assert not network(inputs).any()
    network = eqx.tree_at(lambda n: n.output, network, jnp.arange(1.0, 4.0))
    np.testing.assert_allclose(network(inputs[:, ::-1]), network(inputs)[:, ::-1], rtol=1e-5)
    moved = inputs.at[:, 0].add(1.0)
    assert abs(network(moved) - network(inputs))[:, 1:].max() > 1e-3  # assets see each other
