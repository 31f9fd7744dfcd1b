"""The order of a mandate: the allowed weights that are nearest to those wanted, and its derivative.

``ordered`` computes both only where an order is asked for. On a day without a decision, and for
weights that no limit moves, it costs next to nothing.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from qfolio.core import symmetric
from qfolio.core.lanes import where_needed
from qfolio.core.market import SEARCHED
from qfolio.portfolio.mandate.projection import (
    FEW,
    ITERATIONS,
    Face,
    Limits,
    approximate,
    below,
    choose,
    excess,
    face,
    nearest,
    none_binds,
    ridge,
    search,
    slopes,
)
from qfolio.portfolio.mandate.risk import Past, Risk

Weights = Float[Array, " asset"]

Multipliers = Float[Array, " condition"]

ROUNDS = 16
"""Most projections of which each leaves what changed little in the one before."""

BARELY = 5e-6
"""Excesses of a limit up to this are rounding errors in float32."""

PLANES, KEPT = 32, 6
"""Most projections of an order that is too risky, and the planes of a limit that they keep."""


class Rules(eqx.Module):
    """What an order obeys."""

    limits: Limits
    risk: Risk | Past | None  # as known at a row, if there is a limit on it
    holdings: int = eqx.field(static=True)  # at most so many; 0: any number
    smallest_trade: float = eqx.field(static=True)
    volatility: float = eqx.field(static=True)  # a year, at most
    tracking_error: float = eqx.field(static=True)  # a year, at most

    def within(self, limits: Limits) -> "Rules":
        """The rules with other limits."""
        return dataclasses.replace(self, limits=limits)

    @property
    def estimated(self) -> "Rules":
        """The rules with an estimate of risk."""
        if not isinstance(self.risk, Past):
            return self
        return dataclasses.replace(self, risk=self.risk.risk)

    @property
    def limits_of_risk(self) -> list[tuple[Weights, float, int]]:
        """For each limit of risk: what weights are compared with, the limit, and its number."""
        assert isinstance(self.risk, Risk)
        cash, benchmark = jnp.zeros_like(self.risk.benchmark), self.risk.benchmark
        both = (cash, self.volatility, 0), (benchmark, self.tracking_error, 1)
        return [one for one in both if one[1] < float("inf")]

    def share_of_risk(self, weights: Weights) -> Float[Array, ""]:
        """The largest risk of weights, as a share of its limit."""
        assert isinstance(self.risk, Risk)
        risks = [self.risk.of(weights - center) / most for center, most, _ in self.limits_of_risk]
        return jnp.stack(risks).max()


class Order(NamedTuple):
    """The nearest allowed weights, and what their derivative needs."""

    weights: Weights
    face: Face
    pulls: Float[Array, " risk"]  # multipliers of volatility and tracking error, half squared


class _Round(NamedTuple):
    """A round of leaving small changes out."""

    step: Int[Array, ""]
    left: Bool[Array, " asset"]  # what stayed as it was held in this round
    leaves: Bool[Array, " asset"]  # what is to stay in the next
    found: Multipliers
    first: Multipliers  # those of the first round, in which nothing stayed


class _Search(NamedTuple):
    """Where the search for an order that is not too risky is."""

    step: Int[Array, ""]
    weights: Weights  # the nearest below the planes
    best: Weights  # the nearest so far that is not too risky
    rows: Float[Array, "plane risk asset"]
    most: Float[Array, "plane risk"]  # infinity for a plane that is not there
    found: Multipliers


@jax.custom_vjp
def ordered(
    rules: Rules,
    turnover: Float[Array, ""],
    asked: Bool[Array, ""],
    wanted: Weights,
    held: Weights,
) -> Weights:
    """The allowed weights that are nearest to those wanted; zeros if no order is asked for.

    turnover: at most so much, whatever the rules say. Differentiable almost everywhere in it, in
    ``wanted`` and in ``held``.
    """
    return _forward(rules, turnover, asked, wanted, held)[0]


def _forward(
    rules: Rules, turnover: Array, asked: Array, wanted: Weights, held: Weights
) -> tuple[Weights, tuple]:
    rules = rules.within(rules.limits._replace(turnover=turnover))
    found = where_needed(_find, asked, (wanted, held), rules)
    order = Order(*checkpoint_name(found, SEARCHED))
    return order.weights, (rules, asked, held, order)


def _backward(kept: tuple, gradient: Weights) -> tuple:
    rules, asked, held, order = kept
    found = where_needed(_gradients, asked, (gradient, held, order), rules)
    of_wanted, of_held, of_turnover = found
    return None, of_turnover, None, of_wanted, of_held


ordered.defvjp(_forward, _backward)


@jax.jit  # so that its Python runs once, however often it is mapped
def _find(account: tuple[Weights, Weights], rules: Rules) -> Order:
    """The order of an account, given the weights wanted and held."""
    (wanted, held), rules = account, rules.estimated
    limits, left = rules.limits, jnp.zeros(len(wanted), bool)
    if rules.holdings and rules.holdings < len(wanted):
        limits = _fewer(rules, wanted, held)
    within = limits
    if rules.smallest_trade:
        found, left = _without_small(rules, wanted, held, limits)
        within = _fixed(limits, left, held)
    else:
        found = search(wanted, held, limits)
    weights = approximate(found, wanted, held, within)
    on, pulls = face(found, weights, held, within), jnp.zeros(2, weights.dtype)
    if rules.risk is not None:
        too_risky = rules.share_of_risk(weights) > 1 + BARELY
        given = wanted, held, weights, limits, within
        safer = where_needed(_safer, too_risky, given, rules)
        weights, on, pulls = choose(too_risky, safer, (weights, on, pulls))
    return Order(weights, on._replace(stays=on.stays | left), pulls)


@jax.jit
def _safer(given: tuple, rules: Rules) -> tuple[Weights, Face, Array]:
    """The nearest weights that are not too risky, if there are any within the limits.

    The nearest weights move towards a safe portfolio until their risk is allowed. The tangent
    planes of the risk limits at that point become conditions of one more projection, which may be
    too risky again, but less so, and so on (cutting planes, Veinott 1967). The safe portfolio is
    the benchmark, with as much cash as gives both limits the same room, or cash if tracking error
    has no limit.

    given: weights wanted, held and nearest; the limits; and the limits with assets that are not
    traded fixed at the weights held. Returns the weights, their face and the pulls.
    """
    wanted, held, weights, limits, within = given
    risk = rules.risk
    assert isinstance(risk, Risk)
    centers = rules.limits_of_risk
    aim = jnp.zeros_like(weights)
    if rules.tracking_error < float("inf"):
        own = risk.of(risk.benchmark)
        room = rules.volatility - rules.tracking_error + own
        aim = risk.benchmark * jnp.clip(room / (2 * own), 0.0, 1.0)
    safe = nearest(aim, held, limits)

    def lowered(weights: Weights) -> Weights:
        change = weights - safe
        shares = [risk.share(safe - center, change, most) for center, most, _ in centers]
        return safe + jnp.stack(shares).min() * change

    share = rules.share_of_risk
    first = lowered(weights)
    reach = jnp.maximum(excess(first, held, within).max(), 0.0) + BARELY  # turnover may yield
    enough = 1e-10 if weights.dtype == jnp.float64 else BARELY
    bound, met = len(within.most), 1 + 20 * BARELY
    bounded = np.arange(bound, bound + KEPT * len(centers))  # the planes' places

    def closer(order: _Search) -> _Search:
        """One more projection, below one more tangent plane of each limit."""
        worth = order.found[bound:-2].reshape(order.most.shape)
        rows, most = order.rows, order.most
        for i, (center, at_most, _) in enumerate(centers):
            slot = worth[:, i].argmin()  # a plane that does not bind is replaced
            row, limit = risk.tangent(lowered(order.weights), center, at_most)
            rows, most = rows.at[slot, i].set(row), most.at[slot, i].set(limit)
        cut = below(within, rows.reshape(-1, len(weights)), most.reshape(-1))
        found = search(wanted, held, cut, order.found)
        weights_below = approximate(found, wanted, held, cut)
        new = lowered(weights_below)
        nearer = ((new - wanted) ** 2).sum() < ((order.best - wanted) ** 2).sum()
        safer = share(new) < share(order.best)
        better = jnp.where(share(order.best) > met, safer, nearer & (share(new) <= met))
        better &= excess(new, held, within).max() <= reach
        best = jnp.where(better, new, order.best)
        return _Search(order.step + 1, weights_below, best, rows, most, found)

    def going(order: _Search) -> Array:
        return (order.step < PLANES) & (share(order.weights) > 1 + enough)

    rows = jnp.zeros((KEPT, len(centers), len(weights)), weights.dtype)
    most = jnp.full(rows.shape[:2], jnp.inf, weights.dtype)
    none = none_binds(below(within, rows.reshape(-1, len(weights)), most.reshape(-1)))
    start = _Search(jnp.array(0, jnp.int32), weights, first, rows, most, none)
    order = lax.while_loop(going, closer, start)
    planes = order.found[bound:-2].reshape(order.most.shape)
    tight = (planes > 0).any(0)
    # The face is that of the last projection: rounding may move the weights off it.
    on = face(jnp.delete(order.found, bounded), order.weights, held, within)
    on = on._replace(free=on.free & (share(order.best) <= met))  # else nothing moves the order
    pressed = jnp.where(on.free, _conditions(order.best, held, on, rules, tight), 0.0)
    system = pressed @ pressed.T
    system += jnp.diag(ridge(jnp.diagonal(system), jnp.concatenate([on.binding, tight])))
    multipliers = symmetric.solve(system, (pressed @ (wanted - order.best))[:, None])[:, 0]
    pulls = jnp.zeros(2, weights.dtype)
    for (*_, which), pull in zip(centers, multipliers[len(on.binding) :], strict=True):
        pulls = pulls.at[which].set(jnp.maximum(pull, 0.0))
    return order.best, on, pulls


def _conditions(
    weights: Weights, held: Weights, on: Face, rules: Rules, tight: Bool[Array, " risk"]
) -> Float[Array, "condition asset"]:
    """The slopes of what binds at some weights: conditions, and limits of risk that are tight."""
    found = slopes(weights, held, rules.limits.rows, on.binding)
    if not isinstance(rules.risk, Risk):
        return found
    tangents = [rules.risk.covariance @ (weights - center) for center, *_ in rules.limits_of_risk]
    return jnp.concatenate([found, jnp.where(tight[:, None], jnp.stack(tangents), 0.0)])


@jax.jit
def _gradients(
    given: tuple[Weights, Weights, Order], rules: Rules
) -> tuple[Weights, Weights, Float[Array, ""]]:
    """The gradient by what is wanted, what is held and turnover, from that by the order.

    On its face, the order w solves w − wanted + Σ λᵢ·rowᵢ + Σ μⱼ·C(w − cⱼ) = 0, with all
    conditions that bind as equations, where C is the covariance. The derivative is that of these
    equations (implicit function theorem). given: the gradient, the weights held and the order.
    """
    (gradient, held, (weights, on, pulls)), rules = given, rules.estimated
    turnover, tight, bend = len(on.binding) - 1, jnp.zeros(0, bool), None
    if isinstance(rules.risk, Risk):
        tight = jnp.stack([pulls[which] for *_, which in rules.limits_of_risk]) > 0
        bend = pulls.sum() * rules.risk.covariance
    binding = _conditions(weights, held, on, rules, tight)
    free, marks = jnp.where(on.free, binding, 0.0), jnp.concatenate([on.binding, tight])
    solved = jnp.concatenate([jnp.where(on.free, gradient, 0.0)[None], free])
    if bend is not None:
        inside = on.free[:, None] & on.free
        whole = jnp.eye(len(weights), dtype=weights.dtype) + jnp.where(inside, bend, 0.0)
        solved = symmetric.solve(whole, solved.T).T
    system = free @ solved[1:].T
    system += jnp.diag(ridge(jnp.diagonal(system), marks))
    multipliers = symmetric.solve(system, (free @ solved[0])[:, None])[:, 0]
    of_wanted = solved[0] - multipliers @ solved[1:]
    with_held = gradient - multipliers @ binding
    if bend is not None:
        with_held -= bend @ of_wanted
    of_turnover = multipliers[turnover]
    of_held = jnp.where(on.stays, with_held, of_turnover * binding[turnover])
    return of_wanted, of_held, of_turnover


def _fewer(rules: Rules, wanted: Weights, held: Weights) -> Limits:
    """Limits that keep at 0 all but the largest weights of an order of any number of holdings.

    If these need more turnover than there may be, the largest with what is held.
    """

    def only(size: Array) -> tuple[Array, Limits]:
        _, kept = lax.top_k(abs(size) + _needed(rules.limits, size), rules.holdings)
        others = jnp.ones(len(wanted), bool).at[kept].set(False)
        limits = _fixed(rules.limits, others, jnp.zeros_like(wanted))
        return excess(nearest(wanted, held, limits), held, limits).max(), limits

    aim = nearest(wanted, held, rules.limits)
    if rules.risk is not None:  # or the largest of a risky order would be kept, not of a safe one
        too_risky = rules.share_of_risk(aim) > 1 + BARELY
        given = wanted, held, aim, rules.limits, rules.limits
        aim = jnp.where(too_risky, where_needed(_safer, too_risky, given, rules)[0], aim)
    sizes = jnp.stack([aim, held])
    (over, over_as_held), limits = jax.vmap(only)(sizes)
    as_held = (over > BARELY) & (over > over_as_held)
    return jax.tree.map(lambda x: jnp.where(as_held, x[1], x[0]), limits)


def _needed(limits: Limits, weights: Weights) -> Weights:
    """Which assets are kept first, and which last.

    First are those with a floor, then the largest weights of each group with a floor, as many as
    its caps require; last are those that must be 0.
    """
    low, high, rows, most, *_ = limits
    members = (rows < 0) & ~(rows < 0).all(1)[:, None]  # of a floor, but not that of all assets
    larger = weights[None] > weights[:, None]
    room = jnp.where(members, high, 0.0) @ larger.T  # of larger weights, (row, asset)
    of_groups = (members & (room < -most[:, None] - BARELY)).any(0)
    never = (low == 0) & (high == 0)
    return 20.0 * ((low > 0) | (high < 0)) + 10.0 * of_groups - 1.0 * never


def _without_small(
    rules: Rules, wanted: Weights, held: Weights, limits: Limits
) -> tuple[Multipliers, Bool[Array, " asset"]]:
    """What stays as it is held because it changes little, and the multipliers of the order.

    The others take what that leaves over; if it makes their changes too small as well, nothing is
    traded.
    """
    can_stay = (held >= limits.low) & (held <= limits.high)

    def small(found: Multipliers, limits: Limits) -> Array:
        change = approximate(found, wanted, held, limits) - held
        return can_stay & (abs(change) < rules.smallest_trade - BARELY)

    def leave(now: _Round) -> _Round:
        fewer = _fixed(limits, now.leaves, held)
        # The first round is the order if no later one fits: it must be as exact as without them.
        steps = jnp.where(now.step == 0, ITERATIONS, FEW)
        found = search(wanted, held, fewer, now.found, steps)
        first = jnp.where(now.step == 0, found, now.first)
        return _Round(now.step + 1, now.leaves, now.leaves | small(found, fewer), found, first)

    def going(now: _Round) -> Array:
        return (now.leaves != now.left).any() & (now.step < ROUNDS)

    unmoved, nobody = none_binds(limits), jnp.zeros_like(can_stay)
    everybody = ~nobody
    start = _Round(jnp.array(0, jnp.int32), everybody, nobody, unmoved, unmoved)
    last = lax.while_loop(going, leave, start)
    fewer = _fixed(limits, last.left, held)
    fits = excess(approximate(last.found, wanted, held, fewer), held, limits).max() <= BARELY
    fits &= (last.leaves == last.left).all()
    may_stay = _obeys(rules, held)
    otherwise = choose(may_stay, (unmoved, everybody), (last.first, nobody))
    return choose(fits, (last.found, last.left), otherwise)


def _obeys(rules: Rules, held: Weights) -> Bool[Array, ""]:
    """Whether what is held is allowed but for its risk."""
    limits = rules.limits
    over = jnp.stack([(limits.low - held).max(), (held - limits.high).max(),
                      excess(held, held, limits).max()]).max()  # fmt: skip
    few = (abs(held) > BARELY).sum() <= rules.holdings if rules.holdings else True
    return (over <= BARELY) & few


def _fixed(limits: Limits, which: Bool[Array, " asset"], to: Weights) -> Limits:
    """The limits, with some weights at given values."""
    low, high = (jnp.where(which, to, bound) for bound in (limits.low, limits.high))
    return limits._replace(low=low, high=high)
