"""Projections against a convex solver."""

import warnings

import cvxpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from projections import ASSETS, CASES, KINDS, cases
from qfolio.portfolio.mandate.projection import Limits, excess, nearest


def solved(wanted, held, limits):
    weights, given = cvxpy.Variable(ASSETS), np.isfinite(limits.most)
    conditions = [weights >= limits.low, weights <= limits.high,
                  limits.rows[given] @ weights <= limits.most[given]]  # fmt: skip
    for most, of in ((limits.gross, weights), (limits.turnover, weights - held)):
        conditions += [cvxpy.norm1(of) <= most] if np.isfinite(most) else []
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(weights - wanted)), conditions)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(cvxpy.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    return weights.value


@pytest.mark.parametrize(("short", "turnover"), KINDS)
def test_it_is_the_point_that_a_convex_solver_finds(short, turnover):
    made, stacked = cases(0, short, turnover)
    expected = np.array([solved(*one) for one in made])
    with jax.enable_x64(True):
        exact = jax.jit(jax.vmap(nearest))(*stacked)
        over = jax.vmap(excess)(exact, jnp.asarray(stacked[1]), stacked[2])
        np.testing.assert_allclose(over.max(1), np.minimum(over.max(1), 0), atol=1e-12)
        again = jax.jit(jax.vmap(nearest))(exact, *stacked[1:])
        np.testing.assert_allclose(again, exact, atol=1e-12)
        exact = np.asarray(exact)
    np.testing.assert_allclose(exact, expected, atol=1e-6)
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), stacked)
    np.testing.assert_allclose(jax.jit(jax.vmap(nearest))(*single), exact, atol=2e-6)


def test_weights_within_the_limits_stay_to_the_bit():
    limits = Limits(np.zeros(3), np.full(3, 0.4), np.ones((1, 3)), np.ones(1), 1.0, 0.5)
    held = jnp.array([0.3, 0.3, 0.3])
    for wanted in ([0.3, 0.3, 0.4], [0.2, 0.4, 0.1], [0.3, 0.3, 0.3]):
        found = nearest(jnp.array(wanted), held, jax.tree.map(jnp.asarray, limits))
        np.testing.assert_array_equal(found, jnp.array(wanted))


def test_turnover_yields_to_the_other_limits_as_far_as_it_must():
    limits = Limits(np.zeros(3), np.full(3, 0.4), -np.ones((1, 3)), np.array([-0.8]), 1.0, 0.2)
    found = nearest(jnp.array([0.4, 0.4, 0.2]), jnp.zeros(3), jax.tree.map(jnp.asarray, limits))
    np.testing.assert_allclose(found.sum(), 0.8, atol=1e-5)


def test_without_other_limits_it_is_the_capped_simplex():
    rng = np.random.default_rng(3)
    caps = np.array([0.4, 0.0, 0.7])
    limits = Limits(np.zeros(3), caps, np.ones((1, 3)), np.ones(1), np.inf, np.inf)
    wanted = rng.dirichlet(np.ones(4), 50)[:, 1:].astype(np.float32)
    found = jax.vmap(lambda x: nearest(x, x, jax.tree.map(jnp.asarray, limits)))(wanted)
    np.testing.assert_array_equal(found, np.minimum(wanted, caps.astype(np.float32)))


def test_a_batch_of_batches_is_one_batch():
    _, stacked = cases(4, short=True, turnover=True)
    with jax.enable_x64(True):
        apart = jax.tree.map(lambda x: jnp.asarray(x).reshape(CASES // 3, 3, *x.shape[1:]), stacked)
        flat = jax.jit(jax.vmap(nearest))(*stacked)
        twice = jax.jit(jax.vmap(jax.vmap(nearest)))(*apart)
        alone = nearest(*jax.tree.map(lambda x: jnp.asarray(x[7]), stacked))
    np.testing.assert_allclose(twice.reshape(CASES, ASSETS), flat, atol=1e-13)
    np.testing.assert_allclose(alone, flat[7], atol=1e-13)
