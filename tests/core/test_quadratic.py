"""The best weights: exact, within their bounds, and differentiable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core import quadratic
from qfolio.solvers.minimum_variance import minimum_variance

best = jax.jit(quadratic.best)


def covariances(assets, count, seed=0):
    """With two factors, in units of the mean variance."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        loads = rng.normal(size=(assets, 2)) * rng.uniform(0.1, 2)
        sigma = loads @ loads.T + np.diag(rng.uniform(0.01, 1, assets))
        yield sigma / np.trace(sigma) * assets


def test_two_assets_by_hand():
    sigma = jnp.diag(jnp.array([1.0, 4.0]))
    nothing, both = jnp.zeros(2), jnp.ones(2, bool)
    np.testing.assert_allclose(best(sigma, nothing, both), [0.8, 0.2], atol=1e-6)
    # The slopes w₁ − 1 and 4w₂ are equal.
    np.testing.assert_allclose(best(sigma, jnp.array([0.5, 0.0]), both), [0.9, 0.1], atol=1e-6)
    np.testing.assert_allclose(best(sigma, jnp.array([9.0, 0.0]), both), [1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("assets", [2, 5, 17, 40])
@pytest.mark.parametrize("cap", [1.0, 0.7])
def test_least_variance_as_the_exact_solver(assets, cap):
    for sigma in covariances(assets, 30):
        found = best(
            jnp.asarray(sigma, jnp.float32), jnp.zeros(assets), jnp.ones(assets, bool), cap
        )
        np.testing.assert_allclose(found, minimum_variance(sigma, cap), atol=1e-4)


@pytest.mark.parametrize("cap", [1.0, 0.3])
def test_no_change_improves_the_best(cap):
    """The conditions of Karush, Kuhn & Tucker, which are sufficient here."""
    rng = np.random.default_rng(1)
    for sigma in covariances(12, 50, seed=1):
        gain = rng.normal(0, 0.3, 12)
        w = np.asarray(
            best(jnp.asarray(sigma, jnp.float32), jnp.asarray(gain), jnp.ones(12, bool), cap), float
        )
        slope = gain - sigma @ w
        grow, shrink = w < cap - 1e-5, w > 1e-5
        assert slope[grow].max() - slope[shrink].min() < 1e-3
        np.testing.assert_allclose(w.sum(), 1, atol=1e-5)
        assert w.min() >= 0
        assert w.max() <= cap + 1e-6


@pytest.mark.parametrize("cap", [1.0, 0.2])
def test_a_similar_problem_leads_to_the_same_weights(cap):
    rng = np.random.default_rng(2)
    found = []
    for _ in range(50):
        moves = rng.normal(size=(250, 20)) * rng.uniform(0.5, 2, 20) + rng.normal(size=(250, 1))
        sigma = np.cov(moves.T)
        given = (
            jnp.asarray(sigma / np.trace(sigma) * 20, jnp.float32),
            jnp.asarray(rng.normal(0, 0.05, 20), jnp.float32),
        )
        every = jnp.ones(20, bool)
        least = best(given[0], jnp.zeros(20), every, cap)
        found.append(abs(best(*given, every, cap, least) - best(*given, every, cap)).max())
    assert np.mean(np.array(found) < 1e-4) >= 0.98


def test_assets_that_are_not_open_have_no_weight():
    sigma = next(covariances(6, 1))
    open_to = np.array([True, False, True, True, False, True])
    found = np.asarray(best(jnp.asarray(sigma), jnp.zeros(6), jnp.asarray(open_to)))
    assert not found[~open_to].any()
    wanted = minimum_variance(sigma[np.ix_(open_to, open_to)])
    np.testing.assert_allclose(found[open_to], wanted, atol=1e-4)


@pytest.mark.parametrize("near", [None, jnp.full((2, 4), 0.25)])
def test_nothing_is_held_where_nothing_is_open(near):
    """Beside a case of its batch in which something is open."""
    sigma = jnp.stack([jnp.asarray(next(covariances(4, 1)), jnp.float32)] * 2)
    open_to = jnp.array([[False] * 4, [True] * 4])

    def weights(scale):
        return best(scale * sigma, jnp.zeros((2, 4)), open_to, 1.0, near)

    closed, opened = weights(1.0)
    np.testing.assert_array_equal(closed, 0)
    assert opened.sum() == pytest.approx(1)
    assert np.isfinite(jax.grad(lambda scale: (weights(scale) ** 2).sum())(1.0))


def test_gradient_is_that_of_finite_differences():
    sigma = jnp.asarray(next(covariances(8, 1, seed=3)), jnp.float32)
    change = jax.random.normal(jax.random.key(0), (8, 8))
    change = (change + change.T) / 20
    worth, gain = jnp.arange(8.0), jnp.linspace(-0.1, 0.1, 8)

    def value(step):
        return best(sigma + step * change, gain * (1 + step), jnp.ones(8, bool)) @ worth

    numeric = (value(0.01) - value(-0.01)) / 0.02
    assert abs(numeric) > 0.05
    np.testing.assert_allclose(jax.grad(value)(0.0), numeric, rtol=0.02)
