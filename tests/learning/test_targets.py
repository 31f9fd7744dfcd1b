"""Target networks that follow at intervals."""

import jax
import jax.numpy as jnp
import numpy as np

from qfolio.learning.targets import follow_when


def test_a_batch_follows_where_it_is_due_and_skips_the_pass_where_none_is():
    due = jnp.array([True, False])
    target, online = jnp.zeros((2, 3)), jnp.ones((2, 3))
    step = jax.vmap(lambda due, t, w: follow_when(due, t, w, 0.25))
    np.testing.assert_array_equal(step(due, target, online), [[0.25] * 3, [0.0] * 3])
    program = str(jax.make_jaxpr(step)(due, target, online))
    assert "cond[" in program  # instead of a selection from two results
