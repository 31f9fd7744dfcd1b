"""Networks for portfolios that are linear in positions: values, and a policy of tilts.

Rewards are nearly linear in weights, and a few ranked signals say more about the next return than a
window of past ones (Brandt, Santa-Clara & Valkanov 2009). So one coefficient for each signal serves
all assets, all actions and all states. Everything starts at 0: values, and tilts of the anchor.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from qfolio.core.market import View
from qfolio.learning.trading import ratio

START = 0.3
"""The share of the way to its target that a new policy trades at a step."""

LEAST_CASH, LEAST = 1e-3, 1e-6
"""The least weights of cash and of an asset, so that their logarithms are finite. All logits are
relative to that of cash, so its floor is far above the rounding error of 1 less the others' sum."""


class Values(eqx.Module):
    """The value of the positions that each action orders or, without choices, of those held.

    Q(s, a) = Σᵢ (bᵢ − anchorᵢ) θ·xᵢ − p Σᵢ |bᵢ − hᵢ| − q Σᵢ |bᵢ − anchorᵢ| + v, where b are the
    weights that action a orders, h those held, and x the latest features of an asset except the
    first, its return. p is the price of a trade, and q that of the way back to the anchor, without
    which departures look cheaper than they are. As one θ serves all actions, the value is one of
    the state after a decision (Powell 2011, section 4.6).
    """

    linear: Float[Array, " channel"]  # θ
    price: Float[Array, ""]  # p
    way_back: Float[Array, ""]  # q
    value: Float[Array, ""]  # v

    def __init__(self, view: View) -> None:
        self.linear = jnp.zeros(view.features.shape[-1] - 1)
        self.price, self.way_back, self.value = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())

    def __call__(self, view: View) -> Float[Array, "batch action"]:
        held, signals = view.holding[..., None, :], view.features[..., -1, 1:]
        choices = held if view.choices is None else view.choices
        active = choices if view.anchor is None else choices - view.anchor[..., None, :]
        traded = jnp.abs(choices - held).sum(-1)
        costs = self.price * traded + self.way_back * jnp.abs(active).sum(-1)
        return self.value + (active @ signals) @ self.linear - costs


class OrderValue(eqx.Module):
    """The value of one order of weights, cash first, as a critic reads it."""

    values: Values

    def __call__(self, seen: tuple[View, Float[Array, "batch entry"]]) -> Float[Array, "batch 1"]:
        view, order = seen
        return self.values(view._replace(choices=order[..., None, 1:]))


class Tilting(eqx.Module):
    """Logarithms of an order's weights: a share of the way from the holding to a tilted anchor.

    The target is the anchor times exp(θ·x), with the anchor's sum and an asset's latest features x
    as in ``Values``. The logarithms of cash and of each asset come first; with ``spread``, a number
    for each asset follows, the same for all: the log standard deviation of a stochastic policy.
    """

    linear: Float[Array, " channel"]  # θ
    rate: Float[Array, ""]  # logit of the share of the way
    spread: Float[Array, ""] | None

    def __init__(self, view: View, *, spread: bool) -> None:
        self.linear = jnp.zeros(view.features.shape[-1] - 1)
        self.rate = jnp.array(math.log(START / (1 - START)))
        self.spread = jnp.array(math.log(START)) if spread else None

    def __call__(self, view: View) -> Float[Array, "batch output"]:
        assert view.anchor is not None
        tilted = view.anchor * jnp.exp(view.features[..., -1, 1:] @ self.linear)
        tilted = tilted * ratio(view.anchor.sum(-1), tilted.sum(-1))[..., None]
        assets = view.holding + jax.nn.sigmoid(self.rate) * (tilted - view.holding)
        cash = jnp.maximum(1 - assets.sum(-1, keepdims=True), LEAST_CASH)
        outputs = [jnp.log(cash), jnp.log(jnp.maximum(assets, LEAST))]
        if self.spread is not None:
            outputs.append(jnp.full_like(assets, self.spread))
        return jnp.concatenate(outputs, -1)
