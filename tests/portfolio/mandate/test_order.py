"""Orders of a mandate: their derivatives, and where none is asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from projections import KINDS, cases
from qfolio.portfolio.mandate.order import Rules, ordered
from qfolio.portfolio.mandate.projection import nearest

INFINITE = float("inf")


def order(wanted, held, limits, asked=True, holdings=0, smallest_trade=0.0):
    rules = Rules(limits, None, holdings, smallest_trade, INFINITE, INFINITE)
    return ordered(rules, limits.turnover, jnp.asarray(asked), wanted, held)


@pytest.mark.parametrize(("short", "turnover"), KINDS)
def test_derivatives_are_those_of_finite_differences(short, turnover):
    _, (wanted, held, limits) = cases(1, short, turnover)
    rng = np.random.default_rng(2)
    by, by_held = rng.normal(size=(2, *wanted.shape))
    with jax.enable_x64(True):
        by_turnover = jnp.asarray(rng.normal(size=len(wanted)))
        score = jnp.asarray(rng.normal(size=wanted.shape))
        limits = jax.tree.map(jnp.asarray, limits)

        def worth(wanted, held, turnover, limits, score):
            return order(wanted, held, limits._replace(turnover=turnover)) @ score

        each, given = jax.jit(jax.vmap(worth)), (wanted, held, limits.turnover)
        slopes = jax.jit(jax.vmap(jax.grad(worth, (0, 1, 2))))(*given, limits, score)
        along = by, by_held, by_turnover
        total = sum(
            (s * d).reshape(len(wanted), -1).sum(1) for s, d in zip(slopes, along, strict=True)
        )
        step = 1e-6
        ahead, back = (
            each(*(x + sign * step * d for x, d in zip(given, along, strict=True)), limits, score)
            for sign in (1, -1)
        )
        off = np.asarray(abs(total - (ahead - back) / (2 * step)))
    assert (off < 1e-6).mean() > 0.95  # the others have a kink within 1e-6


def test_a_trade_that_is_too_small_is_left_out_and_so_is_its_slope():
    _, (_, held, limits) = cases(3, short=False, turnover=False)
    rng = np.random.default_rng(2)
    near = held + rng.normal(0, 0.02, held.shape)
    with jax.enable_x64(True):
        one = lambda w, h, of: order(w, h, of, smallest_trade=0.02)  # noqa: E731
        found = jax.jit(jax.vmap(one))(near, held, limits)
        stays = np.asarray(found == held)
        assert 0.2 < stays.mean() < 0.8
        slope = jax.vmap(jax.jacobian(one, (0, 1)))(near, held, limits)
        of_wanted, of_held = (np.asarray(x) for x in slope)
    for case, asset in np.argwhere(stays):
        np.testing.assert_array_equal(of_wanted[case, asset], 0.0)
        np.testing.assert_allclose(of_held[case, asset], np.eye(held.shape[1])[asset], atol=1e-9)


def test_only_what_is_asked_for_is_ordered_however_it_is_mapped():
    _, stacked = cases(5, short=True, turnover=True)
    wanted, held, limits = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), stacked)
    asked = np.random.default_rng(0).random((4, len(wanted))) < 0.2
    over_cases = jax.vmap(order, in_axes=(0, 0, 0, 0))
    found = jax.jit(jax.vmap(over_cases, in_axes=(None, None, None, 0)))(
        wanted, held, limits, asked
    )
    expected = jax.vmap(nearest)(wanted, held, limits)
    np.testing.assert_allclose(found, np.where(asked[..., None], expected, 0.0), atol=1e-6)

    def total(wanted, asked):
        each = jax.vmap(order, in_axes=(0, 0, 0, 0))(wanted, held, limits, asked)
        return (each * jnp.arange(each.shape[1])).sum()

    slope = np.asarray(jax.jit(jax.grad(total))(wanted, asked[0]))
    assert not slope[~asked[0]].any()
    assert slope[asked[0]].any()
