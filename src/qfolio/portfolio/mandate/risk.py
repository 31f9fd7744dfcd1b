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

    returns: Float[Array, "past asset"]  # the last ones; 0 where there are none yet
    benchmark: Float[Array, " asset"]  # weights held by the benchmark
    rate: Float[Array, ""]  # rows in a year over known returns: it annualizes sums of squares

    @staticmethod
    def at(
        log_relatives: Float[Array, "row asset"],
        benchmarks: Float[Array, "benchmarked asset"],
        row: Int[Array, ""],
        past: int,
        year: Float[Array, ""],
    ) -> "Risk":
        """The risk as a row knows it, from ``past`` returns up to it.

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
        return Risk(returns, weights, year / jnp.maximum(known.sum(), 1))

    def of(self, weights: Float[Array, " asset"]) -> Float[Array, ""]:
        """The annual volatility of weights."""
        return jnp.sqrt(self.rate * ((self.returns @ weights) ** 2).sum())

    def share(
        self,
        start: Float[Array, " asset"],
        change: Float[Array, " asset"],
        most: float,
    ) -> Float[Array, ""]:
        """The largest share of a change whose sum with the start has at most some volatility.

        Where none has, the share of the least volatility.
        """
        one, other = self.returns @ start, self.returns @ change
        square, cross = jnp.maximum((other**2).sum(), TINY), (one * other).sum()
        over = (one**2).sum() - most**2 / self.rate
        inside = cross**2 - square * over
        root = jnp.sqrt(jnp.where(inside > 0, inside, 1.0))
        found = (jnp.where(inside > 0, root, 0.0) - cross) / square
        return jnp.clip(found, 0.0, 1.0)
