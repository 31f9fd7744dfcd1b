import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.simplex import FEW, grid, project


def test_projection_by_hand():
    np.testing.assert_allclose(project(jnp.array([0.2, 0.3, 0.5])), [0.2, 0.3, 0.5], atol=1e-7)
    np.testing.assert_allclose(project(jnp.array([5.0, 1.0, -2.0])), [1, 0, 0])
    np.testing.assert_allclose(project(jnp.array([0.6, 0.9, -2.0])), [0.35, 0.65, 0], atol=1e-7)
    cap = jnp.array([1.0, 0.3, 0.3])
    np.testing.assert_allclose(project(jnp.array([-1.0, 3.0, 2.5]), cap), [0.4, 0.3, 0.3])


@pytest.mark.parametrize("entries", [FEW, FEW + 1, 1000])
@pytest.mark.parametrize("cap", [1.0, 0.25])
def test_projection_is_the_nearest_point(cap, entries):
    """Optimality: no mass moves between two entries with room to move and comes nearer."""
    scores = 8 / entries * jax.random.normal(jax.random.key(0), (200, entries))
    weights = np.asarray(project(scores, cap))
    np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-6)
    assert weights.min() >= 0
    assert weights.max() <= cap + 1e-6
    excess = np.asarray(scores) - weights  # what each entry wants more of
    wants = np.where(weights < cap - 1e-6, excess, -np.inf).max(-1)
    gives = np.where(weights > 1e-6, excess, np.inf).min(-1)
    assert (wants <= gives + 1e-5).all()


def test_projection_gradient_against_finite_differences():
    scores = jnp.array([0.6, 0.9, -2.0, 0.3])
    jacobian = jax.jacobian(project)(scores, 0.5)
    for i, change in enumerate(1e-2 * jnp.eye(4)):
        slope = (project(scores + change, 0.5) - project(scores - change, 0.5)) / 2e-2
        np.testing.assert_allclose(jacobian[:, i], slope, atol=1e-4)


@pytest.mark.parametrize("spread", [1e-6, 1e-3, 1.0, 1e3])
def test_projection_of_many_entries_equals_that_of_few(monkeypatch, spread):
    """The value and the gradient, with other caps for each entry and some scores alike."""
    key, cap_key, row_key = jax.random.split(jax.random.key(1), 3)
    scores = spread * jnp.round(jax.random.normal(key, (20, 60)), 2)
    cap = jax.random.uniform(cap_key, (60,), minval=0.02, maxval=0.1)
    row = jax.random.normal(row_key, (60,))

    def found(scores):
        return project(scores, cap), jax.grad(lambda x: (project(x, cap) @ row).sum())(scores)

    many = found(scores)
    monkeypatch.setattr("qfolio.core.simplex.FEW", 60)
    for one, other in zip(found(scores), many, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_weights_of_many_entries_stay_as_they_are():
    weights = jax.random.dirichlet(jax.random.key(2), jnp.full(1000, 0.1), (20,))
    np.testing.assert_allclose(project(weights), weights, atol=1e-7)


def test_grid():
    np.testing.assert_array_equal(grid(2, 4)[:, 1], [0, 0.25, 0.5, 0.75, 1])
    points = grid(3, 4)
    assert len(points) == 15  # (4 + 2 choose 2)
    assert len(np.unique(points, axis=0)) == 15
    np.testing.assert_allclose(points.sum(1), 1)
    assert points.min() == 0
