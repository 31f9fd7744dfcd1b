import jax
import jax.numpy as jnp
import numpy as np

from qfolio.portfolio.feasible import CappedSimplex

LIMITS = [0.4, 0.0, 0.7]


def largest(violations):
    return np.max([np.max(amount) for amount in violations.values()])


def test_what_is_projected_or_drawn_is_allowed():
    feasible = CappedSimplex(jnp.array(LIMITS))
    wanted = jnp.asarray(np.random.default_rng(0).dirichlet(np.ones(4), 200), jnp.float32)
    projected = jax.vmap(feasible.project)(wanted, wanted)
    drawn = jax.vmap(feasible.draw)(jax.random.split(jax.random.key(0), 200))
    for weights in (projected, drawn):
        assert largest(feasible.violations(weights)) <= 1e-6
    assert float(drawn[:, 1].max()) > 0.39  # up to the limit
    again = jax.vmap(feasible.project)(projected, wanted)
    np.testing.assert_allclose(again, projected, atol=1e-6)
    np.testing.assert_allclose(
        feasible.project(jnp.array([0.1, 0.5, 0.3, 0.1]), wanted[0]), [0.5, 0.4, 0, 0.1], atol=1e-6
    )


def test_violations_are_named_and_measured():
    feasible = CappedSimplex(jnp.array(LIMITS))
    weights = np.array([[0.5, 0.5, 0.0, 0.0], [0.5, -0.2, 0.0, 0.7], [0.5, 0.4, 0.0, 0.2],
                        [np.nan] * 4])  # fmt: skip
    found = feasible.violations(weights)
    np.testing.assert_allclose(found["a weight is above its limit by"], [0.1, 0, 0, np.nan],
                               atol=1e-7)  # fmt: skip
    np.testing.assert_allclose(found["a weight is below 0 by"], [0, 0.2, 0, np.nan], atol=1e-7)
    np.testing.assert_allclose(found["the sum is off 1 by"], [0, 0, 0.1, np.nan], atol=1e-7)
