"""Limits on volatility and tracking error: how far towards a safer portfolio an order must go.

Both are estimated from the last returns, of which squares are averaged: a mean of returns is lost
in the noise of so few. An order that is too risky moves along a straight line, which stays within
all convex limits, so that one number has to be found: the root of a quadratic equation.
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
        """The annual volatility of weights."""
        return jnp.sqrt(jnp.maximum(self.between(weights, weights), 0.0))

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
