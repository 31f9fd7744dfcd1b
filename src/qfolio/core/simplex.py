"""The simplex of weights: projection onto it, and a grid over it."""

from itertools import combinations
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

FEW = 8
"""Most entries that are compared in pairs; for more, bisection is faster."""

HALVINGS = 32
"""How often an interval is halved, which makes it as small as rounding allows."""


def project(
    scores: Float[Array, "*batch entry"],
    cap: Float[Array, " entry"] | Float[Array, "*batch entry"] | float = 1.0,
) -> Float[Array, "*batch entry"]:
    """The weights nearest to ``scores``: between 0 and ``cap``, summing to 1.

    They are clip(scores − τ, 0, cap) for the one τ that makes the sum 1 (Duchi et al. 2008; with a
    cap: Wang & Lu 2015). Scores on the simplex are returned as they are; small ones become exactly
    zero. The sum falls piecewise linearly in τ, and its kinks are at the scores and at the scores
    less their caps; a place between the same two kinks as τ tells which entries lie strictly
    between their bounds, and these determine the value and its gradient. The caps must add up to 1
    or more.
    """
    scores = jnp.asarray(scores)
    cap = jnp.broadcast_to(jnp.asarray(cap, scores.dtype), scores.shape)
    fixed = lax.stop_gradient(scores)
    low, high = (_kinks if scores.shape[-1] <= FEW else _interval)(fixed, cap)
    tau = (low + high) / 2
    full = fixed - tau >= cap
    between = (fixed > tau) & ~full
    missing = 1 - jnp.where(full, cap, 0).sum(-1, keepdims=True)
    count = jnp.maximum(between.sum(-1, keepdims=True), 1)
    shift = (jnp.where(between, scores, 0).sum(-1, keepdims=True) - missing) / count
    return jnp.where(full, cap, jnp.where(between, jnp.clip(scores - shift, 0, cap), 0))


def _kinks(
    scores: Float[Array, "*batch entry"], cap: Float[Array, "*batch entry"]
) -> tuple[Float[Array, "*batch 1"], Float[Array, "*batch 1"]]:
    """The kinks around τ, from the sums at all of them at once."""
    kinks = jnp.concatenate([scores, scores - cap], -1)
    above = scores[..., None, :] - kinks[..., :, None]
    sums = jnp.clip(above, 0, cap[..., None, :]).sum(-1)
    low = jnp.where(sums >= 1, kinks, -jnp.inf).max(-1, keepdims=True)
    high = jnp.where(sums < 1, kinks, jnp.inf).min(-1, keepdims=True)
    return low, high


def _interval(
    scores: Float[Array, "*batch entry"], cap: Float[Array, "*batch entry"]
) -> tuple[Float[Array, "*batch 1"], Float[Array, "*batch 1"]]:
    """A small interval around τ, by bisection: its time grows with the entries, not their pairs."""

    def halve(_: Any, interval: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = interval
        middle = (low + high) / 2
        enough = jnp.clip(scores - middle, 0, cap).sum(-1, keepdims=True) >= 1
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    start = (scores - cap).min(-1, keepdims=True), scores.max(-1, keepdims=True)
    low, high = lax.fori_loop(0, HALVINGS, halve, start)
    return low, high


def with_rest(assets: Float[Array, "*batch asset"]) -> Float[Array, "*batch entry"]:
    """Weights with cash first, which is 1 minus the sum of the assets' weights."""
    return jnp.concatenate([1 - assets.sum(-1, keepdims=True), assets], -1)


def grid(entries: int, parts: int) -> np.ndarray:
    """All weights that are multiples of 1/parts, shape (points, entries), the last varying fastest.

    With two entries, cash and one asset, the asset's weights are 0, 1/parts, …, 1.
    """
    bars = combinations(range(parts + entries - 1), entries - 1)
    edges = np.array([(-1, *bar, parts + entries - 1) for bar in bars])
    return (np.diff(edges, axis=1) - 1)[::-1] / parts
