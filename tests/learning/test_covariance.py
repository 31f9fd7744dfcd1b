"""The learned covariance: what it estimates at its start, and gradients of all that it learns."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core import quadratic
from qfolio.learning.covariance import STALE, Covariance, Means, filled

ALL = jnp.ones(4, bool)


def returns(rows=500, assets=4, seed=0):
    rng = np.random.default_rng(seed)
    common = rng.normal(0, 1, (1, rows))
    own = rng.normal(0, 1, (assets, rows)) * np.linspace(0.5, 2, assets)[:, None]
    return jnp.asarray(common + own, jnp.float32)


def exact(**changes):
    """Without limits, shrinkage or a network; half-lives so long that all rows count alike."""
    start = Covariance(3, jax.random.key(0))
    values = {"volatility": 20.0, "correlation": 20.0, "limit": 9.0, "shrinkage": -30.0, **changes}
    where = lambda c: [getattr(c, name) for name in values]  # noqa: E731
    return eqx.tree_at(where, start, [jnp.asarray(x) for x in values.values()])


def test_without_cleaning_it_is_the_second_moments():
    seen = returns()
    moments = np.asarray(seen @ seen.T, float) / seen.shape[1]
    wanted = moments / np.trace(moments) * 4
    np.testing.assert_allclose(exact()(seen, ALL), wanted, rtol=1e-3, atol=1e-3)


def test_half_lives_weigh_late_rows_more():
    rows = np.ones((2, 100))
    rows[0, :90], rows[1, 90:] = 1e-3, 0.5  # returns of 0 would be unknown
    found = exact(volatility=np.log(10.0))(jnp.asarray(rows), jnp.ones(2, bool))
    early = 0.5 - 0.5**10  # what the rows before the last ten weigh, over all but what is cut
    ratio = (0.5 / (early + 0.5 * 0.25)) * 1.0
    np.testing.assert_allclose(found[0, 0] / found[1, 1], ratio, rtol=0.01)


def test_a_crash_counts_up_to_the_limit():
    """A day of 50 deviations, which alone would make the asset look seven times as volatile."""
    seen = np.array(returns())
    seen[0, 100] = 50 * seen[0].std()
    found = np.asarray(exact(limit=np.log(2.0))(jnp.asarray(seen), ALL), float)
    most = 2 * np.sqrt((seen**2).mean(1, keepdims=True))
    cut = most * np.tanh(seen / most)
    moments = cut @ cut.T / seen.shape[1]
    np.testing.assert_allclose(found, moments / np.trace(moments) * 4, rtol=1e-3, atol=1e-3)
    plain = np.asarray(exact()(jnp.asarray(seen), ALL), float)
    assert plain[0, 0] / plain[1, 1] > 3 * found[0, 0] / found[1, 1]


def test_the_identity_takes_its_share_of_the_correlations():
    seen = returns()
    raw, shrunk = exact()(seen, ALL), exact(shrinkage=np.log(0.25 / 0.75))(seen, ALL)
    off = ~np.eye(4, dtype=bool)
    np.testing.assert_allclose(shrunk[off], 0.75 * raw[off], rtol=1e-4)
    np.testing.assert_allclose(np.diag(shrunk), np.diag(raw), rtol=1e-5)


def test_assets_that_are_not_open_count_for_nothing():
    seen = returns()
    open_to = jnp.array([True, True, False, True])
    start = Covariance(3, jax.random.key(0))
    start = eqx.tree_at(lambda c: c.output, start, jnp.array([0.3, -0.2, 0.1]))
    found = start(seen, open_to)
    kept = np.array([0, 1, 3])
    wanted = start(seen[kept], jnp.ones(3, bool))
    np.testing.assert_allclose(found[np.ix_(kept, kept)], wanted, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("alike", [0.0, 0.5])
@pytest.mark.parametrize("rows", [0, 1, 5, 21, 63, 252])
def test_a_new_asset_is_held_like_the_others(rows, alike):
    """From its first row on it has about a tenth; as if its unknown returns were 0, almost all."""
    rng = np.random.default_rng(0)
    own, common = rng.normal(0, 0.01, (10, 504)), rng.normal(0, 0.01, (1, 504))
    seen = np.sqrt(1 - alike) * own + np.sqrt(alike) * common
    seen[0, : 504 - rows] = 0.0
    every = jnp.ones(10, bool)
    sigma = Covariance(3, jax.random.key(0))(jnp.asarray(seen, jnp.float32), every)
    assert 0.03 < float(quadratic.best(sigma, jnp.zeros(10), every)[0]) < 0.17


def test_what_is_unknown_has_the_mean_variance_and_the_mean_correlation():
    seen = returns(rows=2000).at[3].set(0.0)
    found = np.asarray(exact()(seen, ALL))
    known = np.asarray(seen[:3] @ seen[:3].T) / 2000
    np.testing.assert_allclose(found[3, 3] / np.diag(found)[:3].mean(), 1.0, rtol=1e-3)
    mean, typical = known.mean(), np.trace(known) / 3
    alike = (3 * mean / typical - 1) / 2
    np.testing.assert_allclose(found[3, :3].mean() / found[3, 3], alike, rtol=1e-2)


def test_only_what_is_unknown_is_filled():
    seen = np.array(returns())
    seen[0, :STALE], seen[1, : STALE + 1], seen[2] = 0.0, 0.0, 0.0
    kept, none = filled(jnp.asarray(seen), jnp.array([True, False, False, True]))
    np.testing.assert_array_equal(kept, seen)
    assert not none.any()
    some, missing = filled(jnp.asarray(seen), jnp.array([True, True, False, True]))
    unknown = np.zeros(seen.shape, bool)
    unknown[1, : STALE + 1] = True
    np.testing.assert_array_equal(missing > 0, unknown)
    np.testing.assert_array_equal(np.where(unknown, 0, some), np.where(unknown, 0, seen))
    assert some[unknown].all()


def test_a_new_asset_is_one_of_ten_in_a_short_window():
    seen = np.random.default_rng(0).normal(0, 0.05, (10, 20))
    seen[0] = 0.0
    returns, open_to = jnp.array(seen, jnp.float32), jnp.ones(10, bool)
    sigma = Covariance(3, jax.random.key(0))(returns, open_to)
    assert quadratic.best(sigma, jnp.zeros(10), open_to)[0] < 0.2


def test_a_new_asset_is_not_expected_to_earn_or_lose_much():
    """A single return over the root mean square of a window of zeros would be a large number."""
    seen = returns().at[0, :-1].set(0.0)
    means = eqx.tree_at(lambda m: m.coefficients, Means(), jnp.array([1.0, 0.0, 0.0, 0.0]))
    assert abs(means(seen, ALL)).max() < 3


def test_learned_parts_all_have_gradients_also_with_fewer_rows_than_assets():
    seen = returns(rows=6, assets=10)  # four eigenvalues are zero
    worth = jax.random.normal(jax.random.key(1), (10, 10))

    def value(one):
        return (one(seen, jnp.ones(10, bool)) * worth).sum()

    start = Covariance(3, jax.random.key(0))
    start = eqx.tree_at(lambda c: c.output, start, jnp.array([0.3, -0.2, 0.1]))
    for leaf in jax.tree.leaves(jax.grad(value)(start)):
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() > 1e-5


def test_means_are_relative_and_nothing_at_the_start():
    seen = returns()
    start = Means()
    assert not start(seen, ALL).any()
    found = eqx.tree_at(lambda m: m.coefficients, start, jnp.array([0.0, 0.0, 0.0, 1.0]))(seen, ALL)
    np.testing.assert_allclose(found.sum(), 0, atol=1e-4)
    higher = eqx.tree_at(lambda m: m.coefficients, start, jnp.array([0.0, 0.0, 0.0, 1.0]))(
        seen.at[1, -100:].add(1.0), ALL
    )
    assert higher[1] > found[1]
