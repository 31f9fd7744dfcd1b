"""The best weights for a covariance and expected returns, differentiable in both."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from qfolio.core import symmetric

ITERATIONS = 8
CLOSE = 1e-5
"""Mean product of weights and multipliers at which the method stops."""
EXCHANGES = 3
"""How often the guess of which weights lie between their bounds is corrected."""
FROM_NEAR = 5
"""The same, if the first guess comes from the solution of a similar problem."""
SLOPE = 1e-6
"""A slope up to this does not free a weight at its bound."""


def best(
    covariance: Float[Array, "*batch asset asset"],
    gain: Float[Array, "*batch asset"],
    open_to: Bool[Array, "*batch asset"],
    cap: Float[Array, "*batch 1"] | Float[Array, ""] | float = 1.0,
    near: Float[Array, "*batch asset"] | None = None,
) -> Float[Array, "*batch asset"]:
    """The weights w that maximize gain·w − w'Σw/2 with 1'w = 1, 0 ≤ w ≤ cap, and 0 if not open.

    All are 0 if none is open.

    An interior-point method, as in ``solvers.minimum_variance``, finds which weights lie strictly
    between their bounds. Given that, they follow from one linear system, which is what is
    differentiated. A covariance should be in units of its mean variance, and positive definite.
    A cap below 1.01 times the equal weight is raised to it.

    near: weights that solve a similar problem, from which to start instead of from the interior.
    This takes half the time and rarely misses the solution.
    """
    both = open_to[..., :, None] & open_to[..., None, :]
    sigma = jnp.where(both, covariance, 0.0) + (~open_to)[..., None] * jnp.eye(covariance.shape[-1])
    gain = jnp.where(open_to, gain, 0.0)
    count = jnp.maximum(open_to.sum(-1, keepdims=True), 1)
    roof = jnp.maximum(cap, 1.01 / count)  # room for the interior
    given = lax.stop_gradient((sigma, gain))
    if near is None:
        free, full = _between(*given, open_to, roof)
    else:
        full = open_to & (near >= roof) & (roof < 1)
        free = open_to & (near > 0) & ~full
    for _ in range(EXCHANGES if near is None else FROM_NEAR):
        weights, slope = _solved(*given, free, full, roof)
        low, high = weights <= 0, weights >= roof
        rising, falling = open_to & (slope < -SLOPE), slope > SLOPE
        free, full = (
            jnp.where(free, ~low & ~(high & (roof < 1)), jnp.where(full, falling, rising)),
            jnp.where(free, high & (roof < 1), full & ~falling),
        )
    weights, _ = _solved(sigma, gain, free, full, roof)
    weights = jnp.clip(weights, 0.0, roof)
    total = weights.sum(-1, keepdims=True)
    return weights / jnp.where(total > 0, total, 1.0)


def _solved(
    sigma: Float[Array, "*batch asset asset"],
    gain: Float[Array, "*batch asset"],
    free: Bool[Array, "*batch asset"],
    full: Bool[Array, "*batch asset"],
    roof: Float[Array, "*batch 1"],
) -> tuple[Float[Array, "*batch asset"], Float[Array, "*batch asset"]]:
    """The best weights if some are free and some at the roof, and the slopes Σw − gain − level."""
    inside = free[..., :, None] & free[..., None, :]
    system = jnp.where(inside, sigma, 0.0) + (~free)[..., None] * jnp.eye(sigma.shape[-1])
    fixed = jnp.where(full, roof, 0.0)
    push = jnp.where(free, gain - _times(sigma, fixed), 0.0)
    pushed, lifted = _both_solved(system, push, 1.0 * free)
    missing = 1 - fixed.sum(-1, keepdims=True) - pushed.sum(-1, keepdims=True)
    lift = lifted.sum(-1, keepdims=True)
    level = missing / jnp.where(lift > 0, lift, 1.0)
    weights = fixed + pushed + level * lifted
    slope = _times(sigma, weights) - gain
    # If none is free, the highest slope at the roof is the level.
    highest = jnp.where(full, slope, -jnp.inf).max(-1, keepdims=True)
    return weights, slope - jnp.where(lift > 0, level, highest)


def _between(
    sigma: Float[Array, "*batch asset asset"],
    gain: Float[Array, "*batch asset"],
    open_to: Bool[Array, "*batch asset"],
    roof: Float[Array, "*batch 1"],
) -> tuple[Bool[Array, "*batch asset"], Bool[Array, "*batch asset"]]:
    """Which weights of the solution lie between their bounds, and which lie at the upper bound.

    Wright (1997, Primal-dual interior-point methods, chapter 5), from equal weights, with
    multipliers z of w ≥ 0 and v of w ≤ roof.
    """
    count = jnp.maximum(open_to.sum(-1, keepdims=True), 1)
    eye = jnp.eye(sigma.shape[-1])

    def improve(_: Array, point: tuple) -> tuple:
        w, z, v = point
        room = roof - w
        gap = (open_to * (w * z + room * v)).sum(-1, keepdims=True) / (2 * count)
        target = 0.1 * gap
        push = target / w - target / room - _times(sigma, w) + gain
        system = sigma + (z / w + v / room)[..., None] * eye
        moved, lifted = _both_solved(system, jnp.where(open_to, push, 0.0), 1.0 * open_to)
        lift = lifted.sum(-1, keepdims=True)
        step = moved - moved.sum(-1, keepdims=True) / jnp.where(lift > 0, lift, 1.0) * lifted
        step_z = target / w - z - z / w * step
        step_v = target / room - v + v / room * step
        length = jnp.ones_like(gap)
        for value, change in ((w, step), (room, -step), (z, step_z), (v, step_v)):
            falling = open_to & (change < 0)
            most = jnp.where(falling, -value / jnp.where(falling, change, -1.0), 2.0)
            length = jnp.minimum(length, 0.99 * most.min(-1, keepdims=True))
        length = jnp.where(gap > CLOSE, length, 0.0)
        return w + length * step, z + length * step_z, v + length * step_v

    w = jnp.where(open_to, 1 / count, roof / 2)
    ones = jnp.ones_like(w)
    w, z, v = lax.fori_loop(0, ITERATIONS, improve, (w, ones, ones))
    full = open_to & (roof - w < v) & (roof < 1)  # a roof of 1 follows from the sum
    return open_to & ~full & (w > z), full


def _both_solved(system: Array, one: Array, other: Array) -> tuple[Array, Array]:
    found = symmetric.solve(system, jnp.stack([one, other], -1))
    return found[..., 0], found[..., 1]


def _times(matrix: Array, vector: Array) -> Array:
    return jnp.einsum("...ab,...b->...a", matrix, vector)
