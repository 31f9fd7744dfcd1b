"""Limits on volatility and tracking error.

Both are estimated from the last returns, of which squares are averaged: a mean of returns is lost
in the noise of so few. A sum of products of two assets' returns is divided by the geometric mean of
how many returns of each are known, so that the estimate is positive semidefinite where assets join.

Weights with so little risk form an ellipsoid. A tangent plane of it is one more row of linear
limits, and a line to a safe portfolio stays within all convex limits and meets the ellipsoid at the
root of a quadratic equation. Repeated, the two lead to the nearest point of the ellipsoid within
all other limits (cutting planes, Veinott 1967).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

TINY = 1e-12

ROOM = 2**24
"""Most numbers in the covariances of all rows; with more, each is computed where it is needed."""


class Risk(NamedTuple):
    """What is known of risk at a row."""

    covariance: Float[Array, "asset asset"]  # of returns, a year
    benchmark: Float[Array, " asset"]  # weights held by the benchmark

    def of(self, weights: Float[Array, " asset"]) -> Float[Array, ""]:
        """The annual volatility of weights; at least 1e-6, so that it can be divided by."""
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
        size = jnp.maximum(abs(slope).max(), TINY)
        row = slope / size
        return row, most * self.of(active) / size + row @ center


class Past(eqx.Module):
    """What is known of returns at a row; risk is estimated from it where it is needed."""

    log_relatives: Float[Array, "row asset"]  # 0 up to an asset's first price
    joined: Int[Array, " asset"]  # the row of this price
    covariances: Float[Array, "estimated asset asset"]  # of each row, if there is room for them
    benchmarks: Float[Array, "benchmarked asset"]  # weights; no rows without a benchmark
    row: Int[Array, ""]
    year: Float[Array, ""]  # rows in a year
    rows: int = eqx.field(static=True)  # returns that risk is estimated from, if there are as many

    @property
    def risk(self) -> Risk:
        weights = jnp.zeros(self.log_relatives.shape[1])
        if self.benchmarks.shape[0]:
            weights = lax.dynamic_index_in_dim(self.benchmarks, self.row, keepdims=False)
        if self.covariances.shape[0]:
            known = lax.dynamic_index_in_dim(self.covariances, self.row, keepdims=False)
            return Risk(known, weights)
        size = min(self.rows, len(self.log_relatives))
        start = jnp.maximum(self.row + 1 - size, 0)
        past = start + jnp.arange(size) <= self.row
        logs = lax.dynamic_slice_in_dim(self.log_relatives, start, size)
        returns = jnp.where(past[:, None], jnp.expm1(logs), 0.0)
        returns *= jnp.sqrt(self.year / jnp.clip(self.row - self.joined, 1, self.rows))
        return Risk(returns.T @ returns, weights)


def covariances(
    log_relatives: Float[np.ndarray, "row asset"],
    joined: Int[np.ndarray, " asset"],
    past: int,
    year: float,
) -> Float[np.ndarray, "estimated asset asset"]:
    """What ``Past`` estimates at each row; no rows if they need more numbers than ``ROOM``."""
    rows, assets = log_relatives.shape
    if rows * assets**2 > ROOM:
        return np.zeros((0, assets, assets))
    returns = np.expm1(log_relatives)
    products = returns[:, :, None] * returns[:, None]
    sums = np.cumsum(products, axis=0, out=products)
    sums[past:] -= sums[:-past].copy()
    # A sum of fewer returns than past is scaled up; so is that of an asset with a short history.
    scale = np.sqrt(year / np.clip(np.arange(rows)[:, None] - joined, 1, past))
    sums *= scale[:, :, None]
    sums *= scale[:, None]
    return np.asarray(sums)
