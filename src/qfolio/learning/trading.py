"""How a policy trades from the weights that it holds towards a target."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from qfolio.core import simplex

RATE = 0.3
"""Share of the way to a target that is traded at a step, unless another is learned."""

BAND = 0.2
"""How far a weight may drift from an anchor before it is traded, in units of the equal weight: a
fifth, as Daryanani (2008) found for portfolios that are rebalanced. Without a band, an agent that
stays at its anchor pays for trades at every row."""


class Trading(eqx.Module):
    """Trades a learned share of the way to the target, outside a learned band."""

    rate: Float[Array, ""]  # logit of the share of the way that is traded at a step
    band: Float[Array, ""]  # log of the untraded deviation, in units of the equal weight

    @staticmethod
    def start(rate: float = RATE, band: float = 0.05) -> "Trading":
        """What learning starts from.

        rate: share of the way. band: in units of the equal weight (default: 5%).
        """
        return Trading(jnp.array(math.log(rate / (1 - rate))), jnp.array(math.log(band)))

    @staticmethod
    def resting() -> "Trading":
        """What keeps a portfolio near an anchor: ``RATE``, outside ``BAND``."""
        return Trading.start(RATE, BAND)

    @property
    def described(self) -> dict[str, Array]:
        """The share of the way, and the band in units of the equal weight, as named scalars."""
        return {"rate": jax.nn.sigmoid(self.rate), "band": jnp.exp(self.band)}

    @property
    def mean(self) -> "Trading":
        """The mean over a leading axis."""
        return jax.tree.map(lambda x: x.mean(0), self)

    def towards(self, other: "Trading", share: Array) -> "Trading":
        """A share of the way from this to another."""
        return jax.tree.map(lambda one, there: one + share * (there - one), self, other)

    def __call__(
        self,
        held: Float[Array, "*batch asset"],
        target: Float[Array, "*batch entry"],
        anchor: Float[Array, "*batch asset"],
    ) -> Float[Array, "*batch entry"]:
        """The order, cash first: part of the way from the weights held to the target.

        Cash above the target's is invested at once, in proportion to the target; missing cash is
        raised at once, in proportion to the holdings. Then an asset's deviation beyond the band is
        traded at the rate. Where this would buy more than it sells, what pays for the rest is sold
        within the band, in proportion to deviations there, and likewise the other way around: one
        asset that outgrows its band is sold even if none of the others has fallen below theirs.
        """
        idle = 1 - held.sum(-1, keepdims=True) - target[..., :1]
        source = jnp.where(idle > 0, target[..., 1:], held)
        held = held + idle * source * ratio(1.0, source.sum(-1, keepdims=True))
        gap = target[..., 1:] - held
        band = jnp.exp(self.band) * equal(anchor)
        beyond = gap - jnp.clip(gap, -band, band)
        excess = beyond.sum(-1, keepdims=True)  # of purchases over sales
        within = jnp.maximum(jnp.where(excess > 0, beyond - gap, gap - beyond), 0.0)
        trade = beyond - excess * within * ratio(1.0, within.sum(-1, keepdims=True))
        return simplex.with_rest(held + jax.nn.sigmoid(self.rate) * trade)


def equal(anchor: Float[Array, "*batch asset"]) -> Float[Array, "*batch asset"]:
    """The anchor's sum, in equal parts over the assets that can be traded."""
    open_to = anchor > 0
    share = anchor.sum(-1, keepdims=True) / open_to.sum(-1, keepdims=True)
    return jnp.where(open_to, share, 0.0)


def ratio(part: Array | float, whole: Array) -> Array:
    """The ratio of ``part`` to ``whole``; 0 if ``whole`` is not positive."""
    return jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), 0.0)
