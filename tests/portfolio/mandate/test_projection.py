"""Projections against a convex solver, and their derivatives against finite differences."""

import warnings

import cvxpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.mandate.projection import Limits, excess, nearest

ASSETS, CASES = 10, 60

KINDS = [(False, False), (False, True), (True, False), (True, True)]


def case(rng: np.random.Generator, short: bool, turnover: bool):
    """Wanted and held weights, and limits that some weights meet, most of them barely."""
    low = np.where(rng.random(ASSETS) < 0.3, rng.random(ASSETS) / 20, 0.0) - 0.3 * short
    high = np.maximum(low, 0.05 + 0.4 * rng.random(ASSETS))
    inside = rng.uniform(low, high)
    if not short:
        inside = low + (inside - low) * min(1, (0.99 - low.sum()) / (inside - low).sum())
    groups = 1.0 * (rng.random((4, ASSETS)) < 0.4)  # they overlap
    rows = np.concatenate([np.ones((1, ASSETS)), -np.ones((1, ASSETS)), groups, -groups])
    most = rows @ inside + 0.1 * rng.random(10) * (rng.random(10) < 0.7)
    most[rng.random(10) < 0.3] = np.inf
    held = 0.9 * rng.dirichlet(np.ones(ASSETS))
    gross = abs(inside).sum() * (1 + 0.1 * rng.random()) if short else np.inf
    limit = abs(inside - held).sum() * (1 + 0.2 * rng.random()) if turnover else np.inf
    wanted = rng.normal(size=ASSETS) / 2 if short else rng.dirichlet(np.full(ASSETS, 0.5))
    return wanted, held, Limits(low, high, rows, most, np.array(gross), np.array(limit))


def cases(seed: int, short: bool, turnover: bool):
    rng = np.random.default_rng(seed)
    made = [case(rng, short, turnover) for _ in range(CASES)]
    return made, jax.tree.map(lambda *x: np.stack(x), *made)


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


@pytest.mark.parametrize(("short", "turnover"), KINDS)
@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences(short, turnover):
    _, (wanted, held, limits) = cases(1, short, turnover)
    rng = np.random.default_rng(2)
    along = 1e-6 * rng.normal(size=(2, *wanted.shape))

    with jax.enable_x64(True):
        one = lambda wanted, held, limits, by, by_held: jax.jvp(  # noqa: E731
            lambda x, h: nearest(x, h, limits), (wanted, held), (by, by_held)
        )[1]
        found = jax.jit(jax.vmap(one))(wanted, held, limits, *along)
        moved = jax.jit(jax.vmap(nearest))
        ahead = moved(wanted + along[0], held + along[1], limits)
        behind = moved(wanted - along[0], held - along[1], limits)
        weight = rng.normal(size=wanted.shape)
        pulled = jax.jit(jax.vmap(jax.grad(lambda x, h, of, v: nearest(x, h, of) @ v)))(
            wanted, held, limits, weight
        )
        alone = jax.jit(jax.vmap(one))(wanted, held, limits, along[0], 0 * along[1])
        np.testing.assert_allclose(
            (pulled * along[0]).sum(1), (alone * weight).sum(1), atol=1e-9 * abs(weight).max()
        )
        off = abs(np.asarray(found - (ahead - behind) / 2)).max(1) / 1e-6
    assert (off < 1e-3).mean() > 0.95  # the others have a kink within 1e-6


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
