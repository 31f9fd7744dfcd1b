"""The simplex of weights: projection onto it, and a grid over it."""

from itertools import combinations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float


def project(
    scores: Float[Array, "*batch entry"], cap: Float[Array, " entry"] | float = 1.0
) -> Float[Array, "*batch entry"]:
    """The weights nearest to ``scores``: between 0 and ``cap``, summing to 1.

    They are clip(scores − τ, 0, cap) for the one τ that makes the sum 1 (Duchi et al. 2008; with a
    cap: Wang & Lu 2015). Scores on the simplex are returned as they are; small ones become exactly
    zero. The sum falls piecewise linearly in τ, and its kinks are at the scores and at the scores
    less their caps; the two kinks around τ tell which entries lie strictly between their bounds,
    and these determine the value and its gradient. The caps must add up to 1 or more.
    """
    scores = jnp.asarray(scores)
    cap = jnp.broadcast_to(jnp.asarray(cap, scores.dtype), scores.shape)
    fixed = lax.stop_gradient(scores)
    kinks = jnp.concatenate([fixed, fixed - cap], -1)
    # All pairs at once: bisection or sorting takes longer for so few entries.
    above = fixed[..., None, :] - kinks[..., :, None]
    sums = jnp.clip(above, 0, cap[..., None, :]).sum(-1)
    low = jnp.where(sums >= 1, kinks, -jnp.inf).max(-1, keepdims=True)
    high = jnp.where(sums < 1, kinks, jnp.inf).min(-1, keepdims=True)
    tau = (low + high) / 2
    full = fixed - tau >= cap
    between = (fixed > tau) & ~full
    missing = 1 - jnp.where(full, cap, 0).sum(-1, keepdims=True)
    count = jnp.maximum(between.sum(-1, keepdims=True), 1)
    shift = (jnp.where(between, scores, 0).sum(-1, keepdims=True) - missing) / count
    return jnp.where(full, cap, jnp.where(between, jnp.clip(scores - shift, 0, cap), 0))


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
