"""Trading from the weights that are held towards a target."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.learning.trading import Trading

FIFTHS = jnp.full(5, 0.2)


def trading(rate: float, band: float) -> Trading:
    return Trading(jnp.log(rate / (1 - rate)), jnp.log(band))


def order(trade: Trading, held, target=FIFTHS, cash: float = 0.0, anchor=FIFTHS):
    target = jnp.concatenate([jnp.array([cash]), jnp.asarray(target)])
    return np.asarray(trade(jnp.asarray(held), target, anchor))


@pytest.mark.parametrize(
    ("held", "wanted"),
    [
        # Nothing is traded within the band of half of the equal weight, 0.1.
        ([0.28, 0.12, 0.2, 0.2, 0.2], [0.28, 0.12, 0.2, 0.2, 0.2]),
        # Half of what is beyond it is traded.
        ([0.4, 0.0, 0.2, 0.2, 0.2], [0.35, 0.05, 0.2, 0.2, 0.2]),
        # A winner is sold though nothing else is beyond the band; deviations within it take it.
        ([0.4, 0.15, 0.15, 0.15, 0.15], [0.35, 0.1625, 0.1625, 0.1625, 0.1625]),
        (
            [0.42, 0.18, 0.2, 0.1, 0.1],
            [0.36, 0.18 + 0.06 * 2 / 22, 0.2, 0.1 + 0.06 * 10 / 22, 0.1 + 0.06 * 10 / 22],
        ),
        # So is a loser bought. It is 0.04 beyond the band, and two others are above their target.
        ([0.06, 0.3, 0.24, 0.2, 0.2], [0.08, 0.3 - 0.02 * 5 / 7, 0.24 - 0.02 * 2 / 7, 0.2, 0.2]),
    ],
)
def test_what_is_beyond_the_band_is_traded_at_the_rate(held, wanted):
    found = order(trading(0.5, 0.5), held)
    np.testing.assert_allclose(found, [0.0, *wanted], atol=1e-7)


def test_an_order_within_the_band_is_what_is_held_to_the_bit():
    held = np.array([0.28, 0.12, 0.21, 0.19, 0.2], np.float32)
    assert (order(trading(0.5, 0.5), held)[1:] == held).all()


def test_cash_comes_first():
    held = [0.3, 0.1, 0.2, 0.2, 0.1]  # and 0.1 in cash, which is invested in proportion to targets
    invested = [0.32, 0.12, 0.22, 0.22, 0.12]
    np.testing.assert_allclose(order(trading(0.5, 0.9), held), [0.0, *invested], atol=1e-7)
    np.testing.assert_allclose(order(trading(0.5, 0.9), [0.0] * 5), [0.0, *FIFTHS], atol=1e-7)
    raised = np.array(held) * 0.7 / 0.9
    target = FIFTHS * 0.7
    found = order(trading(0.5, 0.9), held, target, 0.3, FIFTHS * 0.7)
    np.testing.assert_allclose(found, [0.3, *raised], atol=1e-7)


def test_an_asset_that_left_the_anchor_is_sold():
    fourths = jnp.array([0.0, 0.25, 0.25, 0.25, 0.25])
    found = order(trading(0.5, 0.9), [0.2] * 5, fourths, 0.0, fourths)
    np.testing.assert_allclose(found, [0.0, 0.1, 0.225, 0.225, 0.225, 0.225], atol=1e-7)


def test_orders_are_weights_and_have_derivatives():
    keys = jax.random.split(jax.random.key(0))
    held, target = (jax.random.dirichlet(key, jnp.full(6, 0.3), (200,)) for key in keys)
    anchor = jnp.full((200, 5), 0.2)

    def first(trade: Trading, held, target) -> jax.Array:
        return trade(held[:, 1:], target, anchor)[:, 1].sum()

    for rate, band in ((0.1, 0.01), (0.5, 0.5), (0.99, 2.0)):
        trade = trading(rate, band)
        weights = trade(held[:, 1:], target, anchor)
        np.testing.assert_allclose(weights.sum(-1), 1.0, atol=1e-6)
        assert weights.min() > -1e-6
        # No asset overshoots its target, once cash has been invested or raised.
        whole = held.at[:, 0].set(target[:, 0])
        whole = whole.at[:, 1:].multiply((1 - whole[:, :1]) / whole[:, 1:].sum(-1, keepdims=True))
        moved = trade(whole[:, 1:], target, anchor)
        away, left = abs(whole - target), abs(moved - target)
        assert (left <= away + 1e-6).all()
        slopes = jax.grad(first, argnums=(0, 1, 2))(trade, held, target)
        assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))
