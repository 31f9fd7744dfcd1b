import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.simplex import grid, project


def test_projection_by_hand():
    np.testing.assert_allclose(project(jnp.array([0.2, 0.3, 0.5])), [0.2, 0.3, 0.5], atol=1e-7)
    np.testing.assert_allclose(project(jnp.array([5.0, 1.0, -2.0])), [1, 0, 0])
    np.testing.assert_allclose(project(jnp.array([0.6, 0.9, -2.0])), [0.35, 0.65, 0], atol=1e-7)
    cap = jnp.array([1.0, 0.3, 0.3])
    np.testing.assert_allclose(project(jnp.array([-1.0, 3.0, 2.5]), cap), [0.4, 0.3, 0.3])


@pytest.mark.parametrize("cap", [1.0, 0.25])
def test_projection_is_the_nearest_point(cap):
    """Optimality: no mass moves between two entries with room to move and comes nearer."""
    scores = jax.random.normal(jax.random.key(0), (200, 9))
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


def test_grid():
    np.testing.assert_array_equal(grid(2, 4)[:, 1], [0, 0.25, 0.5, 0.75, 1])
    points = grid(3, 4)
    assert len(points) == 15  # (4 + 2 choose 2)
    assert len(np.unique(points, axis=0)) == 15
    np.testing.assert_allclose(points.sum(1), 1)
    assert points.min() == 0
