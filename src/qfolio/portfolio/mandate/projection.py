"""The point of a set of weights that is nearest to the weights wanted.

The set is low ≤ w ≤ high, rows·w ≤ most, Σ|w| ≤ gross and Σ|w − held| ≤ turnover. Given a
multiplier for each condition but the first, the problem falls apart into one for each asset, which
has a closed form. The multipliers maximize a concave, piecewise quadratic function: a semismooth
Newton method (Qi & Sun 1993), projected onto their bounds (Bertsekas 1982), finds the piece of the
maximum, and then its last step is exact. The piece, a face of the set, also gives the derivative.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from qfolio.core import symmetric

T = TypeVar("T")

LARGEST, OF_TURNOVER, OF_PLANES = 100.0, 10.0, 1.0
"""Bounds of the multipliers. That of turnover is lower than that of the other limits: where these
contradict it, turnover is exceeded by as little as they require (an exact penalty). Planes (see
``below``) yield to all limits."""

ITERATIONS, FEW = 60, 12
"""Most steps of a search. A few are enough unless limits contradict each other."""

LENGTHS, SHORTENING = 8, 4.0
"""Steps are tried at so many lengths, each a quarter of the one before."""

LONGEST = 16.0
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
    penalty: Any = None  # (row,), bounds of the multipliers (default: LARGEST)


class Face(NamedTuple):
    """The face of the set on which the nearest weights lie."""

    free: Bool[Array, "asset *path"]  # neither at a bound nor at a kink
    stays: Bool[Array, "asset *path"]  # as held
    binding: Bool[Array, "condition *path"]


class _Found(NamedTuple):
    """Where a search is."""

    multipliers: Array
    value: Array
    error: Array


def nearest(
    wanted: Float[Array, " asset"], held: Float[Array, " asset"], limits: Limits
) -> Float[Array, " asset"]:
    """The weights within the limits that are nearest to those wanted, which may be anywhere.

    Weights within the limits are returned unchanged. It has no derivative; see ``order.py``.
    """
    return approximate(search(wanted, held, limits), wanted, held, _arrays(limits, wanted))


def search(
    wanted: Float[Array, " asset"],
    held: Float[Array, " asset"],
    limits: Limits,
    start: Float[Array, " condition"] | None = None,
    iterations: int | Int[Array, ""] = ITERATIONS,
) -> Float[Array, " condition"]:
    """The multipliers of ``nearest``.

    start: multipliers to search from, such as those of limits that differ little (default: 0).
    iterations: at most so many steps; contradictory limits need most.
    """
    limits = _arrays(limits, wanted)
    start = none_binds(limits) if start is None else start
    most = jnp.asarray(iterations, jnp.int32)
    given = jax.tree.map(lambda x: x[..., None], (wanted, held, limits, start, most))
    found: Array = _search(*given)[..., 0]
    return found


@custom_vmap
def _search(
    wanted: Float[Array, "asset path"],
    held: Float[Array, "asset path"],
    limits: Limits,
    start: Float[Array, "condition path"],
    iterations: Int[Array, " path"],
) -> Float[Array, "condition path"]:
    """As ``search``, with a last axis of paths, which the processor takes side by side."""
    largest = _largest(limits)
    accuracy = ROUNDING * jnp.finfo(wanted.dtype).eps

    def value(multipliers: Array) -> tuple[Array, Array]:
        """What is maximized, and how far the multipliers are from the maximum's conditions."""
        weights = approximate(multipliers, wanted, held, limits)
        over = excess(weights, held, limits)
        worth = ((weights - wanted) ** 2).sum(0) / 2 + (multipliers * over).sum(0)
        return worth, _error(multipliers, over, largest)

    def improve(found: _Found) -> _Found:
        system, over = _newton(found.multipliers, wanted, held, limits)
        direction = _bounded(symmetric.eliminate(system, over[:, None])[:, 0])

        def at(length: Array) -> _Found:
            tried = jnp.clip(found.multipliers + length * direction, 0.0, largest)
            return _Found(tried, *value(tried))

        def shorter(tries: tuple[Array, _Found]) -> tuple[Array, _Found]:
            i, best = tries
            tried = at(SHORTENING ** -i.astype(wanted.dtype))
            return i + 1, choose(tried.value > best.value, tried, best)

        whole, done = at(jnp.ones((), wanted.dtype)), found.error <= accuracy
        # Near the maximum the differences of values are rounding errors, and errors tell more.
        nearer = (whole.value >= found.value - accuracy) & (whole.error <= found.error / 2)
        well = jnp.where(done, whole.error < found.error, nearer)

        def falling(tries: tuple[Array, _Found]) -> Array:
            i, best = tries
            return (i < LENGTHS) & ~(well | done | (best.value > found.value)).all()

        best = lax.while_loop(falling, shorter, (jnp.array(1, jnp.int32), whole))[1]
        return choose(done & ~well, found, choose(well, whole, best))

    def going(search: tuple[Array, Array, _Found]) -> Array:
        step, last, _ = search
        return (step < iterations.max()) & ~last

    def advance(search: tuple[Array, Array, _Found]) -> tuple[Array, Array, _Found]:
        step, _, found = search
        # One extra step reduces rounding errors.
        return step + 1, (found.error <= accuracy).all(), improve(found)

    begin = jnp.array(0, jnp.int32), jnp.array(False), _Found(start, *value(start))
    return lax.while_loop(going, advance, begin)[2].multipliers


@_search.def_vmap
def _search_many(size: int, batched: Any, *given: Any) -> tuple[Array, bool]:
    """One batch of all paths."""
    paths = given[0].shape[-1]

    def joined(x: Array, batched: bool) -> Array:
        every = x if batched else jnp.broadcast_to(x, (size, *x.shape))
        return jnp.moveaxis(every, 0, -2).reshape(*every.shape[1:-1], size * paths)

    found = _search(*jax.tree.map(joined, given, tuple(batched)))
    return jnp.moveaxis(found.reshape(-1, size, paths), 1, 0), True


def below(
    limits: Limits, rows: Float[Array, "plane asset"], most: Float[Array, " plane"]
) -> Limits:
    """The limits and, as further rows, planes. Planes yield."""
    limits = _arrays(limits, most)
    penalty = jnp.full(len(limits.most), LARGEST, most.dtype)
    return limits._replace(
        rows=jnp.concatenate([limits.rows, rows]),
        most=jnp.concatenate([limits.most, most]),
        penalty=jnp.concatenate([penalty, jnp.full_like(most, OF_PLANES)]),
    )


def none_binds(limits: Limits) -> Float[Array, " condition"]:
    """The multipliers of weights that no condition moves."""
    return jnp.zeros_like(_largest(limits))


# Arrays of the functions below may have further axes behind those named.


def approximate(
    multipliers: Float[Array, "condition *path"],
    wanted: Float[Array, "asset *path"],
    held: Float[Array, "asset *path"],
    limits: Limits,
) -> Float[Array, "asset *path"]:
    """The weights for given multipliers, as exact as these are.

    They are the minimum of ½(w − v)² + gross·|w| + turnover·|w − held| between the bounds, where
    v = wanted − rows'·λ.
    """
    *_, gross, turnover = multipliers
    center = wanted - (multipliers[:-2, None] * limits.rows).sum(0)
    short = held < 0
    first, second = jnp.where(short, held, 0.0), jnp.where(short, 0.0, held)
    at_first = jnp.where(short, turnover, gross)
    at_second = gross + turnover - at_first
    below, above = center + (gross + turnover), center - (gross + turnover)
    between = jnp.clip(center - at_first + at_second, first, second)
    found = jnp.where(below < first, below, jnp.where(above > second, above, between))
    return jnp.clip(found, limits.low, limits.high)


def excess(
    weights: Float[Array, "asset *path"], held: Float[Array, "asset *path"], limits: Limits
) -> Float[Array, "condition *path"]:
    """By how much each condition is exceeded; −1 for one that does not apply."""
    long, change = abs(weights).sum(0), abs(weights - held).sum(0)
    over = jnp.concatenate([(limits.rows * weights).sum(1), jnp.stack([long, change])])
    most = jnp.concatenate([limits.most, jnp.stack([limits.gross, limits.turnover])])
    applies = jnp.isfinite(most)
    return jnp.where(applies, over - jnp.where(applies, most, 0.0), -1.0)


def face(
    multipliers: Float[Array, "condition *path"],
    weights: Float[Array, "asset *path"],
    held: Float[Array, "asset *path"],
    limits: Limits,
) -> Face:
    """The face on which weights lie, given their multipliers."""
    over = excess(weights, held, limits) > ROUNDING * jnp.finfo(weights.dtype).eps
    inside = (weights > limits.low) & (weights < limits.high)
    stays = inside & (multipliers[-1] > 0) & (weights == held)
    free = inside & ~stays & ~((multipliers[-2] > 0) & (weights == 0))
    # A limit that yields is exceeded although its multiplier is as large as it may be.
    binding = jnp.where(multipliers > 0, (multipliers < _largest(limits)) | ~over, over)
    return Face(free, stays, binding)


def slopes(
    weights: Float[Array, "asset *path"],
    held: Float[Array, "asset *path"],
    rows: Float[Array, "row asset *path"],
    binding: Bool[Array, "condition *path"],
) -> Float[Array, "condition asset *path"]:
    """The slopes of the conditions that bind; 0 for the others."""
    signs = jnp.stack([jnp.sign(weights), jnp.sign(weights - held)])
    return jnp.where(binding[:, None], jnp.concatenate([rows, signs]), 0.0)


def ridge(
    squares: Float[Array, "condition *path"], binding: Bool[Array, "condition *path"]
) -> Float[Array, "condition *path"]:
    """What the diagonal of a system of conditions gets so that it can be solved."""
    least = 100 * jnp.finfo(squares.dtype).eps * jnp.maximum(squares.max(0), 1.0)
    return jnp.where(binding, least, 1.0)


def _newton(
    multipliers: Array, wanted: Array, held: Array, limits: Limits
) -> tuple[Float[Array, "condition condition *path"], Float[Array, "condition *path"]]:
    """The equations of the step to the maximum, if no asset and no multiplier left its piece on
    the way."""
    weights = approximate(multipliers, wanted, held, limits)
    free, _, binding = face(multipliers, weights, held, limits)
    sloped = jnp.where(free, slopes(weights, held, limits.rows, binding), 0.0)
    over = jnp.where(binding, excess(weights, held, limits), 0.0)
    more = ridge((sloped**2).sum(1), binding)
    one = jnp.expand_dims(jnp.eye(len(more), dtype=weights.dtype), range(2, 1 + more.ndim))
    return (sloped[:, None] * sloped).sum(2) + one * more, over


def _bounded(step: Array) -> Array:
    """If no asset is free, the step has no length; weights differ by 1."""
    return step / jnp.maximum(abs(step).max(0) / LONGEST, 1.0)


def _error(multipliers: Array, over: Array, largest: Array) -> Array:
    """How far multipliers with these excesses are from the conditions of the maximum."""
    return abs(multipliers - jnp.clip(multipliers + over, 0.0, largest)).max(0)


def _largest(limits: Limits) -> Array:
    rows = jnp.full_like(limits.most, LARGEST) if limits.penalty is None else limits.penalty
    others = jnp.stack([jnp.full_like(limits.gross, x) for x in (LARGEST, OF_TURNOVER)])
    return jnp.concatenate([rows, others])


def _arrays(limits: Limits, like: Array) -> Limits:
    return jax.tree.map(lambda x: jnp.asarray(x, like.dtype), limits)


def choose(first: Bool[Array, "*path"], one: T, other: T) -> T:
    """One tree of arrays where a condition holds, and another elsewhere."""
    found: T = jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)
    return found
