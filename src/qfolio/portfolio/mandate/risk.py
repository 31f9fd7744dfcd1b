"""Limits on volatility and tracking error.

Both are estimated from the last returns, of which squares are averaged: a mean of returns is lost
in the noise of so few.

Weights with so little risk form an ellipsoid. A tangent plane of it is one more row of linear
limits, and a line to a safe portfolio stays within all convex limits and meets the ellipsoid at the
root of a quadratic equation. Repeated, the two lead to the nearest point of the ellipsoid within
all other limits (cutting planes, Veinott 1967); once is enough for training.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

TINY = 1e-12


class Risk(NamedTuple):
    """What is known of risk at a row."""

    covariance: Float[Array, "asset asset"]  # of returns, a year
    benchmark: Float[Array, " asset"]  # weights held by the benchmark

    @staticmethod
    def at(
        log_relatives: Float[Array, "row asset"],
        benchmarks: Float[Array, "benchmarked asset"],
        row: Int[Array, ""],
        past: int,
        year: Float[Array, ""],
    ) -> "Risk":
        """The risk as a row knows it, from ``past`` returns up to it, or as many as there are.

        log_relatives: those of the first row are not known. benchmarks: weights at each row; no
        rows without a benchmark. year: rows in a year.
        """
        count, assets = log_relatives.shape
        size = min(past, count)
        start = jnp.maximum(row + 1 - size, 0)
        rows = start + jnp.arange(size)
        known = (rows > 0) & (rows <= row)
        logs = lax.dynamic_slice_in_dim(log_relatives, start, size)
        returns = jnp.where(known[:, None], jnp.expm1(logs), 0.0)
        weights = jnp.zeros(assets)
        if benchmarks.shape[0]:
            weights = lax.dynamic_index_in_dim(benchmarks, row, keepdims=False)
        return Risk(year / jnp.maximum(known.sum(), 1) * (returns.T @ returns), weights)

    def of(self, weights: Float[Array, " asset"]) -> Float[Array, ""]:
        """The annual volatility of weights; at least 1e-6, so that its derivative is finite."""
        return jnp.sqrt(jnp.maximum(self.between(weights, weights), TINY))

    def between(
        self, one: Float[Array, " asset"], other: Float[Array, " asset"]
    ) -> Float[Array, ""]:
        """The annual covariance of weights."""
        return one @ self.covariance @ other

    def share(
        self,
        start: Float[Array, " asset"],
        change: Float[Array, " asset"],
        most: float,
    ) -> Float[Array, ""]:
        """The largest share of a change whose sum with the start has at most some volatility.

        If no sum has so little, it is the share with the least volatility.
        """
        square = jnp.maximum(self.between(change, change), TINY)
        cross, over = self.between(start, change), self.between(start, start) - most**2
        inside = cross**2 - square * over
        root = jnp.sqrt(jnp.where(inside > 0, inside, 1.0))
        found = (jnp.where(inside > 0, root, 0.0) - cross) / square
        return jnp.clip(found, 0.0, 1.0)

    def tangent(
        self, weights: Float[Array, " asset"], center: Float[Array, " asset"], most: float
    ) -> tuple[Float[Array, " asset"], Float[Array, ""]]:
        """A tangent plane of the ellipsoid of weights with at most ``most`` risk: a row, its limit.

        Risk is the volatility of weights minus the center. The plane touches the ellipsoid in the
        direction from the center to the given weights; row · w ≤ limit for all w in the ellipsoid.
        """
        active = weights - center
        slope = self.covariance @ active
        size = jnp.maximum(lax.stop_gradient(abs(slope).max()), TINY)
        row = slope / size
        return row, most * self.of(active) / size + row @ center
