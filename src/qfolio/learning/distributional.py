"""Action values as an expectation or as a distribution of returns: how each is read and learned.

A network outputs ``atoms`` numbers z for each action. Each kind of value interprets them: ``mean``
is the action value, ``outcomes`` are the possible returns, each of which makes a target, and
``loss`` is the distance of z from the targets, with the value's absolute error, which sets
priorities. Outputs that represent returns may be their roots (``Scale``).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from qfolio.core.fields import require
from qfolio.learning.targets import Scalar, Scale, huber_loss

Losses = tuple[Float[Array, " batch"], Float[Array, " batch"]]


class Expected(NamedTuple):
    """The expected return alone (Mnih et al. 2015)."""

    scale: Scale
    huber_delta: Scalar

    @property
    def atoms(self) -> int:
        return 1

    def mean(self, z: Float[Array, "*batch 1"]) -> Float[Array, "*batch"]:
        return self.scale.values(z[..., 0])

    def outcomes(self, z: Float[Array, "batch 1"]) -> Float[Array, "batch 1"]:
        return self.scale.values(z)

    def loss(
        self,
        z: Float[Array, "batch 1"],
        target: Float[Array, "batch 1"],
        following: Float[Array, "batch 1"],
    ) -> Losses:
        error = (self.scale.outputs(target) - z)[:, 0]
        return huber_loss(error, self.huber_delta), jnp.abs(error)


class Categorical(NamedTuple):
    """Logits of equally spaced returns, or of their roots (Bellemare et al. 2017)."""

    scale: Scale
    atoms: int
    low: Scalar
    high: Scalar

    @property
    def support(self) -> Float[Array, " atom"]:
        low, high = (self.scale.outputs(jnp.asarray(end)) for end in (self.low, self.high))
        return self.scale.values(low + (high - low) * jnp.linspace(0.0, 1.0, self.atoms))

    def mean(self, z: Float[Array, "*batch atom"]) -> Float[Array, "*batch"]:
        return (jax.nn.softmax(z) * self.support).sum(-1)

    def outcomes(self, z: Float[Array, "batch atom"]) -> Float[Array, "batch atom"]:
        return jnp.broadcast_to(self.support, z.shape)

    def loss(
        self,
        z: Float[Array, "batch atom"],
        target: Float[Array, "batch atom"],
        following: Float[Array, "batch atom"],
    ) -> Losses:
        """Cross-entropy, and its distance from the minimum, the KL divergence."""
        wanted = project(target, jax.nn.softmax(following), self.support)
        loss = -(wanted * jax.nn.log_softmax(z)).sum(-1)
        return loss, jnp.maximum(loss - jax.scipy.special.entr(wanted).sum(-1), 0.0)


class Quantile(NamedTuple):
    """The return's quantiles at the middles of equal parts (Dabney et al. 2018)."""

    scale: Scale
    atoms: int
    huber_delta: Scalar

    def mean(self, z: Float[Array, "*batch atom"]) -> Float[Array, "*batch"]:
        return self.scale.values(z).mean(-1)

    def outcomes(self, z: Float[Array, "batch atom"]) -> Float[Array, "batch atom"]:
        return self.scale.values(z)

    def loss(
        self,
        z: Float[Array, "batch atom"],
        target: Float[Array, "batch atom"],
        following: Float[Array, "batch atom"],
    ) -> Losses:
        off = jnp.abs(target.mean(-1) - self.mean(z))
        return quantile_huber_loss(z, self.scale.outputs(target), self.huber_delta), off


Values = Expected | Categorical | Quantile

KINDS = ("expected", "categorical", "quantile")


class ValueConfig(NamedTuple):
    """An agent's settings for its action values, by the names that they have there."""

    values: str  # one of KINDS
    atoms: int  # numbers for each action, if values are a distribution
    v_min: Scalar  # ends of the categorical support
    v_max: Scalar
    huber_delta: Scalar  # |error| beyond which the loss is linear
    value_rescaling: bool  # whether outputs are roots of returns

    def check(self) -> None:
        """Raises QfolioError if the settings are invalid."""
        require(self, "values", lambda x: x in KINDS, f"one of {', '.join(KINDS)}")
        require(self, "atoms", lambda x: 2 <= x <= 1001, "from 2 to 1001")
        require(self, "v_min v_max", lambda x: -1e30 <= x <= 1e30, "from -1e30 to 1e30")
        require(self, "huber_delta", lambda x: x >= 1e-30, "greater than 0")
        if self.values == "categorical":
            require(self, "v_max", lambda x: x > self.v_min, f"above v_min ({self.v_min})")
        if self.values == "quantile":
            require(self, "huber_delta", math.isfinite, "finite for quantiles, such as 1")

    def build(self) -> Values:
        """The kind of values that the settings choose."""
        scale = Scale(self.value_rescaling)
        if self.values == "categorical":
            return Categorical(scale, self.atoms, self.v_min, self.v_max)
        if self.values == "quantile":
            return Quantile(scale, self.atoms, self.huber_delta)
        return Expected(scale, self.huber_delta)


def project(
    outcomes: Float[Array, "batch outcome"],
    probabilities: Float[Array, "batch outcome"],
    support: Float[Array, " atom"],
) -> Float[Array, "batch atom"]:
    """Outcomes' probabilities, projected onto an increasing support (Bellemare et al. 2017, eq. 7).

    Each outcome's probability is split linearly between its two neighbors, which preserves the
    mean; outcomes beyond the support go to its ends.
    """
    gaps = jnp.diff(support)[:, None]
    passed = jnp.clip((outcomes[:, None, :] - support[:-1, None]) / gaps, 0.0, 1.0)
    above = jnp.einsum("bgo,bo->bg", passed, probabilities)  # mass beyond each gap's lower end
    total = probabilities.sum(-1, keepdims=True)
    reached = jnp.concatenate([total, above, jnp.zeros_like(total)], axis=1)
    return jnp.maximum(reached[:, :-1] - reached[:, 1:], 0.0)


def quantile_huber_loss(
    quantiles: Float[Array, "batch quantile"],
    outcomes: Float[Array, "batch outcome"],
    delta: Scalar,
) -> Float[Array, " batch"]:
    """Sum over quantiles of the mean over outcomes (Dabney et al. 2018, eq. 10 and algorithm 1).

    Negative errors are weighted by 1 − level, positive ones by the quantile's level.
    """
    n = quantiles.shape[-1]
    error = outcomes[:, None, :] - quantiles[:, :, None]
    level = ((jnp.arange(n) + 0.5) / n)[:, None]
    weight = jnp.where(error < 0, 1 - level, level)
    return (weight * huber_loss(error, delta)).mean(-1).sum(-1)
