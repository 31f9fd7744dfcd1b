"""The point of a set of weights that is nearest to the weights wanted.

The set is low ≤ w ≤ high, rows·w ≤ most, Σ|w| ≤ gross and Σ|w − held| ≤ turnover. Given a
multiplier for each condition but the first, the problem falls apart into one for each asset, which
has a closed form. The multipliers maximize a concave, piecewise quadratic function: a semismooth
Newton method (Qi & Sun 1993), projected onto their bounds (Bertsekas 1982), finds the piece of the
maximum, and then its last step is exact. That step is also what is differentiated.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from qfolio.core import symmetric

LARGEST, OF_TURNOVER = 100.0, 10.0
"""Bounds of the multipliers. That of turnover is the lower one: where the other limits contradict
it, turnover is exceeded by as little as they require (an exact penalty)."""

ITERATIONS = 60
HALVINGS = 16
LONGEST = 4.0
ROUNDING = 16
"""Excesses up to this many times the precision of a number count as none."""


class Limits(NamedTuple):
    """The conditions, arrays of jax or numpy; infinity for one that does not apply."""

    low: Any  # (asset,)
    high: Any  # (asset,)
    rows: Any  # (row, asset)
    most: Any  # (row,)
    gross: Any  # ()
    turnover: Any  # ()


def nearest(
    wanted: Float[Array, " asset"], held: Float[Array, " asset"], limits: Limits
) -> Float[Array, " asset"]:
    """The weights within the limits that are nearest to those wanted, which may be anywhere.

    Weights within the limits are returned unchanged. Differentiable almost everywhere in ``wanted``
    and ``held``.
    """
    limits = Limits(*(jnp.asarray(x, wanted.dtype) for x in limits))
    fixed, now, given = lax.stop_gradient((wanted, held, limits))
    largest = _largest(limits)
    accuracy = ROUNDING * jnp.finfo(wanted.dtype).eps

    def error_of(multipliers: Array) -> Array:
        """How far the multipliers are from the conditions of the maximum."""
        over = excess(_weights(multipliers, fixed, now, given), now, given)
        return abs(multipliers - jnp.clip(multipliers + over, 0.0, largest)).max()

    def value(multipliers: Array) -> Array:
        weights = _weights(multipliers, fixed, now, given)
        return ((weights - fixed) ** 2).sum() / 2 + multipliers @ excess(weights, now, given)

    lengths = 2.0 ** -jnp.arange(HALVINGS, dtype=wanted.dtype)

    def improve(search: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        step, multipliers, error = search
        direction = _newton(multipliers, fixed, now, given)
        tried = jnp.clip(multipliers + lengths[:, None] * direction, 0.0, largest)
        values, errors = jax.vmap(value)(tried), jax.vmap(error_of)(tried)
        # Near the maximum the differences of values are rounding errors, and errors tell more.
        as_good = values[0] >= value(multipliers) - accuracy
        chosen = jnp.where(as_good & (errors[0] <= error / 2), 0, values.argmax())
        return step + 1, tried[chosen], errors[chosen]

    def going(search: tuple[Array, Array, Array]) -> Array:
        step, _, error = search
        return (step < ITERATIONS) & (error > accuracy)

    start = jnp.zeros(limits.most.shape[0] + 2, wanted.dtype)
    begin = (jnp.array(0, jnp.int32), start, error_of(start))
    _, found, error = lax.stop_gradient(lax.while_loop(going, improve, begin))
    step = _newton(found, wanted, held, limits)
    last = lax.stop_gradient(step)
    # One more step rounds better, unless it has no length; its derivative counts in any case.
    better = error_of(found + last) < error
    return _weights(found + jnp.where(better, 0.0, -last) + step, wanted, held, limits)


def _largest(limits: Limits) -> Array:
    rows = jnp.full(limits.most.shape[0] + 1, LARGEST, limits.most.dtype)
    return jnp.append(rows, OF_TURNOVER)


def _newton(multipliers: Array, wanted: Array, held: Array, limits: Limits) -> Array:
    """The step to the maximum, if no asset and no multiplier left its piece on the way."""
    weights = _weights(multipliers, wanted, held, limits)
    over = excess(weights, held, limits)
    fixed, at, bounds = lax.stop_gradient((weights, over, limits))
    kinked = jnp.where(multipliers[-2] > 0, fixed == 0, False)
    kinked |= jnp.where(multipliers[-1] > 0, fixed == lax.stop_gradient(held), False)
    free = (fixed > bounds.low) & (fixed < bounds.high) & ~kinked
    signs = jnp.stack([jnp.sign(fixed), jnp.sign(fixed - lax.stop_gradient(held))])
    slopes = jnp.where(free, jnp.concatenate([bounds.rows, signs]), 0.0)
    precision = jnp.finfo(fixed.dtype).eps
    over_all = at > ROUNDING * precision
    moving = jnp.where(multipliers > 0, (multipliers < _largest(limits)) | ~over_all, over_all)
    slopes = jnp.where(moving[:, None], slopes, 0.0)
    system = slopes @ slopes.T
    ridge = 100 * precision * jnp.maximum(jnp.diagonal(system).max(), 1.0)
    system += jnp.diag(jnp.where(moving, ridge, 1.0))
    step = symmetric.solve(system, jnp.where(moving, over, 0.0)[:, None])[:, 0]
    # If no asset is free, the step has no length; weights differ by 1.
    return step / jnp.maximum(lax.stop_gradient(abs(step).max()) / LONGEST, 1.0)


def _weights(multipliers: Array, wanted: Array, held: Array, limits: Limits) -> Array:
    """The weights for given multipliers: the minimum of
    ½(w − v)² + gross·|w| + turnover·|w − held| between the bounds, where v = wanted − rows'·λ."""
    *_, gross, turnover = multipliers
    centre = wanted - multipliers[:-2] @ limits.rows
    short = held < 0
    first, second = jnp.where(short, held, 0.0), jnp.where(short, 0.0, held)
    at_first = jnp.where(short, turnover, gross)
    at_second = gross + turnover - at_first
    below, above = centre + (gross + turnover), centre - (gross + turnover)
    between = jnp.clip(centre - at_first + at_second, first, second)
    found = jnp.where(below < first, below, jnp.where(above > second, above, between))
    return jnp.clip(found, limits.low, limits.high)


def excess(
    weights: Float[Array, " asset"], held: Float[Array, " asset"], limits: Limits
) -> Float[Array, " condition"]:
    """By how much each condition is exceeded; −1 for one that does not apply."""
    long = abs(weights).sum()
    change = abs(weights - held).sum()
    over = jnp.append(limits.rows @ weights, jnp.stack([long, change]))
    most = jnp.append(limits.most, jnp.stack([limits.gross, limits.turnover]))
    applies = jnp.isfinite(most)
    return jnp.where(applies, over - jnp.where(applies, most, 0.0), -1.0)
