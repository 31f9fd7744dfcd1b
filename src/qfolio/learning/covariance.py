"""A forecast of the covariance of the next returns that is learned end to end.

Its parts are those of Bongiorno, Manolakis & Mantegna (2025, "End-to-end large portfolio
optimization for variance minimization with neural networks through covariance cleaning"): weights
of past days, a limit to what the largest returns count, a cleaning of the eigenvalues of the
correlations by a network that does not depend on the number of assets, and volatilities. Here the
weights of days decay exponentially with their age, one limit serves all days, and the network sees
one eigenvalue at a time.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from qfolio.core.symmetric import spectrum
from qfolio.learning.trading import ratio

LEAST = 1e-3
"""Smaller eigenvalues of correlations are raised to this."""

TINY = 1e-9
"""Added to variances, in units of the squared scale of returns."""

STALE = 21
"""Most returns of 0 at the start of a window that count as days without a move, not as unknown; at
most a quarter of the window."""


class Covariance(eqx.Module):
    """The estimate Σ = D C D of volatilities D and cleaned correlations C.

    Both see a return r as c tanh(r / c), so that a single day of a crash or a takeover does not
    rule the estimate; c is a learned multiple of the asset's root mean square return.

    C has the eigenvectors of the weighted sample correlations. Their eigenvalues λ become
    ((1 − a)λ + a) exp(g(log λ, log λ₊)), with a learned share a of the identity and a layer g of
    tanh units; then the diagonal is made 1 again. λ₊ = (1 + √q)² is the largest eigenvalue of noise
    (Marčenko & Pastur 1967), where q is the number of assets over the effective number of days.
    """

    volatility: Float[Array, ""]  # log of a half-life in rows
    correlation: Float[Array, ""]  # likewise
    limit: Float[Array, ""]  # log of that multiple
    shrinkage: Float[Array, ""]  # logit of a
    layer: Float[Array, "input unit"]
    offset: Float[Array, " unit"]
    output: Float[Array, " unit"]

    def __init__(self, units: int, key: PRNGKeyArray) -> None:
        """Starts with half-lives of 60 and 250 rows, a limit of 4, a = 10% and g = 0."""
        self.volatility, self.correlation = jnp.log(60.0), jnp.log(250.0)
        self.limit = jnp.log(4.0)
        self.shrinkage = jnp.array(math.log(0.1 / 0.9))
        first, second = jax.random.split(key)
        self.layer = jax.random.normal(first, (2, units))
        self.offset = jax.random.normal(second, (units,))
        self.output = jnp.zeros(units)

    @property
    def described(self) -> dict[str, Array]:
        """Half-lives in rows, the limit and the share of the identity, as named scalars."""
        return {
            "volatility_half_life": jnp.exp(self.volatility),
            "correlation_half_life": jnp.exp(self.correlation),
            "limit": jnp.exp(self.limit),
            "shrinkage": jax.nn.sigmoid(self.shrinkage),
        }

    def __call__(
        self, returns: Float[Array, "*batch asset time"], open_to: Bool[Array, "*batch asset"]
    ) -> Float[Array, "*batch asset asset"]:
        """Σ in units of the mean variance of the open assets; the others have almost no variance.

        returns: in the same unit for all assets, the latest last. open_to: the assets that can be
        traded.
        """
        returns, missing = filled(returns, open_to)
        returns = self._limited(jnp.where(open_to[..., None], returns, 0.0), missing)
        weights = _decay(self.correlation, returns.shape[-1])
        seen = returns * jnp.sqrt(weights)
        count = jnp.maximum(open_to.sum(-1, keepdims=True), 1)
        moments = jnp.einsum("...at,...bt->...ab", seen, seen)
        # Fixed, so that the gradients of complete windows are rounded as without it.
        unknown = missing @ lax.stop_gradient(weights)
        moments += unknown[..., None] * jnp.eye(moments.shape[-1])
        cleaned = self._cleaned(_correlations(moments), count * (weights**2).sum())
        variance = ((returns**2 + missing) @ _decay(self.volatility, returns.shape[-1])) + TINY
        scale = jnp.sqrt(variance / (variance.sum(-1, keepdims=True) / count))
        return cleaned * scale[..., :, None] * scale[..., None, :]

    def _limited(
        self, returns: Float[Array, "*batch asset time"], missing: Float[Array, "*batch asset time"]
    ) -> Float[Array, "*batch asset time"]:
        square = (returns**2 + missing).mean(-1, keepdims=True)
        limit = jnp.exp(self.limit) * jnp.sqrt(square + TINY)
        return limit * jnp.tanh(returns / limit)

    def _cleaned(
        self, correlations: Float[Array, "*batch asset asset"], per_day: Float[Array, "*batch 1"]
    ) -> Float[Array, "*batch asset asset"]:
        values, vectors = spectrum(correlations)
        values = jnp.maximum(values, LEAST)
        edge = jnp.broadcast_to(2 * jnp.log1p(jnp.sqrt(per_day)), values.shape)
        inputs = jnp.stack([jnp.log(values), edge], -1)
        share = jax.nn.sigmoid(self.shrinkage)
        factor = jnp.exp(jnp.tanh(inputs @ self.layer + self.offset) @ self.output)
        cleaned = (share + (1 - share) * values) * factor
        return _correlations((vectors * cleaned[..., None, :]) @ jnp.swapaxes(vectors, -1, -2))


class Means(eqx.Module):
    """Expected returns of assets in units of their volatility, from their own past.

    They are the sum of each asset's mean returns over several half-lives, less their mean over the
    assets, times learned coefficients: momentum where these are positive, reversal where negative.
    """

    half_lives: Float[Array, " speed"]  # logs, in rows
    coefficients: Float[Array, " speed"]

    def __init__(self) -> None:
        """Starts with half-lives of 1, 5, 21 and 126 rows and coefficients of 0."""
        self.half_lives = jnp.log(jnp.array([1.0, 5.0, 21.0, 126.0]))
        self.coefficients = jnp.zeros(4)

    @property
    def described(self) -> dict[str, Array]:
        """Each coefficient and its half-life, as named scalars."""
        speeds = range(len(self.coefficients))
        return {f"mean_{i}": self.coefficients[i] for i in speeds} | {
            f"mean_{i}_half_life": jnp.exp(self.half_lives[i]) for i in speeds
        }

    def __call__(
        self, returns: Float[Array, "*batch asset time"], open_to: Bool[Array, "*batch asset"]
    ) -> Float[Array, "*batch asset"]:
        weights = jax.vmap(lambda one: _decay(one, returns.shape[-1]), out_axes=1)(self.half_lives)
        returns, missing = filled(returns, open_to)
        spread = jnp.sqrt((returns**2 + missing).mean(-1, keepdims=True) + TINY)
        # A mean over more days is smaller; divided by its standard error, it is not.
        means = (returns / spread) @ (weights / jnp.sqrt((weights**2).sum(0)))
        means = jnp.where(open_to[..., None], means, 0.0)
        count = jnp.maximum(open_to.sum(-1), 1)[..., None, None]
        centered = means - means.sum(-2, keepdims=True) / count
        return jnp.where(open_to, centered @ self.coefficients, 0.0)


def filled(
    returns: Float[Array, "*batch asset time"], open_to: Bool[Array, "*batch asset"]
) -> tuple[Float[Array, "*batch asset time"], Float[Array, "*batch asset time"]]:
    """Returns with expected ones in place of unknown ones, and the variances of what is unknown.

    Returns from before an asset's first price are 0, so that a new asset would seem to have no
    risk. It is taken for one like the others: as if all had the same variance v and correlation ρ,
    its return is expected from the mean of theirs on that day.
    """
    rows = jnp.arange(returns.shape[-1])
    first = jnp.where(returns != 0, rows, len(rows)).min(-1, keepdims=True)
    known = (rows >= first) | (first <= min(STALE, len(rows) // 4)) | ~open_to[..., None]
    there = known & open_to[..., None]

    def fill() -> tuple[Array, Array]:
        count = 1.0 * there.sum(-2, keepdims=True)
        mean = ratio(jnp.where(there, returns, 0.0).sum(-2, keepdims=True), count)
        total, days = count.sum(-1, keepdims=True), 1.0 * (count > 0).sum(-1, keepdims=True)
        variance = ratio(jnp.where(there, returns**2, 0.0).sum((-2, -1), keepdims=True), total)
        of_mean, assets = ratio((mean**2).sum(-1, keepdims=True), days), ratio(total, days)
        # The mean of n assets has the variance v (ρ + (1 − ρ)/n).
        alike = ratio(assets * of_mean - variance, (assets - 1) * variance).clip(0.0, 1.0)
        slope = ratio(alike * variance, of_mean)
        left = (1 - slope * alike) * variance
        return jnp.where(known, returns, slope * mean), jnp.where(known, 0.0, left)

    # Most windows have nothing to fill, and skip the work.
    return lax.cond(known.all(), lambda: (returns, jnp.zeros_like(returns)), fill)


def _decay(half_life: Float[Array, ""], rows: int) -> Float[Array, " time"]:
    """Weights of rows, which sum to 1 and halve with each half-life of age (given as its log)."""
    age = jnp.arange(rows)[::-1]
    return jax.nn.softmax(-math.log(2) * age * jnp.exp(-half_life))


def _correlations(moments: Float[Array, "*batch asset asset"]) -> Array:
    """Correlations from second moments; those of assets whose moments are 0 are 0."""
    eye = jnp.eye(moments.shape[-1])
    moments = moments + TINY * eye
    scale = jnp.sqrt(jnp.diagonal(moments, axis1=-2, axis2=-1))
    return moments / scale[..., :, None] / scale[..., None, :]
