"""The weights that a mandate allows."""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree
from numpy.typing import NDArray

from qfolio.core import simplex
from qfolio.core.market import SEARCHED
from qfolio.portfolio.mandate.projection import (
    Limits,
    approximate,
    below,
    excess,
    nearest,
    none_binds,
    search,
    solution,
)
from qfolio.portfolio.mandate.risk import Risk

Multipliers = Float[Array, " condition"]

ROUNDS = 3
"""Projections of which each leaves what changed little in the one before."""

BARELY = 5e-6
"""Excesses of a limit up to this are rounding errors in float32."""

PLANES, KEPT = 32, 4
"""Most projections of an order that is too risky, and the planes of a limit that they keep."""


class _Order(NamedTuple):
    """Where the search for an order that is not too risky is."""

    step: Int[Array, ""]
    weights: Float[Array, " asset"]  # the nearest below the planes
    best: Float[Array, " asset"]  # the nearest so far that is not too risky
    rows: Float[Array, "plane limit asset"]
    most: Float[Array, "plane limit"]  # infinity for a plane that is not there
    found: Multipliers


class Feasible(eqx.Module):
    """A set of weights, cash first."""

    @property
    def long_only(self) -> bool:
        """Whether no weight of the set is negative, cash included."""
        return True

    @property
    def gross(self) -> float:
        """The largest sum of absolute weights of the assets."""
        return 1.0

    @abc.abstractmethod
    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """Weights of the set for the wanted weights (on the simplex) and the weights held.

        Weights of the set are returned unchanged; differentiable almost everywhere.
        """

    @abc.abstractmethod
    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        """Random weights of the set, for a learner to start from."""

    @abc.abstractmethod
    def violations(self, weights: Any) -> dict[str, Any]:
        """How far weights of shape (..., entry) lie outside the set, of shape (...), by condition.

        Takes numpy and jax arrays. 0 or less if a condition holds, NaN if a weight is NaN.
        """


class CappedSimplex(Feasible):
    """Long-only weights of sum 1, each asset's at most its limit; cash has no limit."""

    limits: Float[Array, " asset"]  # 0 where an asset cannot be traded

    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """The excess over an asset's limit stays in cash."""
        allowed = jnp.minimum(wanted[1:], self.limits)
        cash = wanted[:1] + (wanted[1:] - allowed).sum(keepdims=True)
        return jnp.concatenate([cash, allowed])

    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        """Random concentration, from nearly equal weights to nearly all in one."""
        spread_key, key = jax.random.split(key)
        spread = jax.random.uniform(spread_key, maxval=4.0)
        weights = jax.nn.softmax(spread * jax.random.gumbel(key, (self.limits.shape[0] + 1,)))
        return self.project(weights, weights)

    def violations(self, weights: Any) -> dict[str, Any]:
        xp = weights.__array_namespace__()
        return {
            "the sum is off 1 by": abs(weights.sum(-1) - 1),
            "a weight is below 0 by": -weights.min(-1),
            "a weight is above its limit by": (weights[..., 1:] - xp.asarray(self.limits)).max(-1),
        }


class Mandated(Feasible):
    """Weights that obey a mandate, made by ``mandate.feasible``.

    An order is the point of the set that is nearest to the weights wanted, in the weights of the
    assets; cash is the rest. With a number of holdings, the largest weights of that point are kept,
    and the others are 0. Changes below the smallest trade are not made, unless a limit needs them.
    If turnover clashes with other limits, as after a fall in prices, it gives way to them. If that
    point is too risky, the order is the nearest that is not: in training near it, after one
    projection below tangent planes, and in the set ``exact`` after as many as it takes.
    """

    limits: Limits
    names: tuple[str, ...] = eqx.field(static=True)  # of the rows of the limits
    holdings: int = eqx.field(static=True, default=0)  # at most so many; 0: any number
    smallest_trade: float = eqx.field(static=True, default=0.0)
    exposure: float = eqx.field(static=True, default=1.0)  # largest sum of absolute weights
    long: bool = eqx.field(static=True, default=True)
    volatility: float = eqx.field(static=True, default=float("inf"))  # a year, at most
    tracking_error: float = eqx.field(static=True, default=float("inf"))  # a year, at most
    planes: int = eqx.field(static=True, default=1)  # projections of an order that is too risky
    risk: Risk | None = None  # as known at a row, if there is such a limit

    @property
    def limits_risk(self) -> bool:
        """Whether volatility or tracking error has a limit."""
        return min(self.volatility, self.tracking_error) < float("inf")

    def knowing(self, risk: Risk) -> "Mandated":
        """The set at a row where so much is known of risk."""
        return dataclasses.replace(self, risk=risk)

    @property
    def exact(self) -> "Mandated":
        """The set whose orders are the nearest also with limits on risk; without derivatives."""
        return dataclasses.replace(self, planes=PLANES) if self.limits_risk else self

    def spending(self, turnover: Any) -> "Mandated":
        """The set of orders with at most some turnover."""
        least = turnover.__array_namespace__().minimum(self.limits.turnover, turnover)
        return dataclasses.replace(self, limits=self.limits._replace(turnover=least))

    @property
    def long_only(self) -> bool:
        return self.long

    @property
    def gross(self) -> float:
        return self.exposure

    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        aim, now, limits = wanted[1:], held[1:], self.limits
        if self.holdings and self.holdings < len(aim):
            limits = self._fewer(aim, now)
        within = limits
        if self.smallest_trade:
            found, left = checkpoint_name(self._without_small(aim, now, limits), SEARCHED)
            within = _fixed(limits, left, now)
        else:
            found = checkpoint_name(search(aim, now, limits), SEARCHED)
        weights = solution(found, aim, now, within)
        if self.limits_risk and self.risk is not None:
            weights = self._safer(weights, aim, now, limits, within, self.risk)
        if self.long:  # rounding may leave no cash, and less
            weights /= jnp.maximum(weights.sum(), 1.0)
        return simplex.with_rest(weights)

    def _safer(
        self,
        weights: Float[Array, " asset"],
        wanted: Float[Array, " asset"],
        held: Float[Array, " asset"],
        limits: Limits,
        within: Limits,
        risk: Risk,
    ) -> Float[Array, " asset"]:
        """Weights near those wanted that are not too risky, if there are any within the limits.

        The weights move towards a safe portfolio until their risk is allowed. The tangent planes of
        the risk limits at that point become conditions of one more projection, which may be too
        risky again, but less so (cutting planes, Veinott 1967). The safe portfolio is the
        benchmark, with as much cash as gives both limits the same room, or cash if tracking error
        has no limit.

        within: the limits, with assets that are not traded fixed at the weights held.
        """
        risk = jax.tree.map(lambda x: jnp.asarray(x, weights.dtype), risk)
        cash = jnp.zeros_like(weights)
        centers = ((cash, self.volatility), (risk.benchmark, self.tracking_error))
        limited = [(center, most) for center, most in centers if most < float("inf")]
        aim = cash
        if self.tracking_error < float("inf"):
            own = risk.of(risk.benchmark)
            room = self.volatility - self.tracking_error + own
            aim = risk.benchmark * jnp.clip(room / (2 * own), 0.0, 1.0)
        found = checkpoint_name(search(aim, held, limits), SEARCHED)
        safe = solution(found, aim, held, limits)

        def allowed(weights: Array) -> Array:
            change = weights - safe
            shares = [risk.share(safe - center, change, most) for center, most in limited]
            return safe + jnp.stack(shares).min() * change

        def share(weights: Array) -> Array:
            """The largest risk, as a share of its limit."""
            risks = [risk.of(weights - center) / most for center, most in limited]
            return jnp.stack(risks).max()

        first = allowed(weights)
        reach = jnp.maximum(excess(first, held, within).max(), 0.0) + BARELY  # turnover may yield
        bound = len(within.most)

        def closer(order: _Order) -> _Order:
            """One more projection, below one more tangent plane of each limit."""
            worth = order.found[bound:-2].reshape(order.most.shape)
            rows, most = order.rows, order.most
            for i, (center, at_most) in enumerate(limited):
                slot = worth[:, i].argmin()  # a plane that does not bind is replaced
                row, limit = risk.tangent(allowed(order.weights), center, at_most)
                rows, most = rows.at[slot, i].set(row), most.at[slot, i].set(limit)
            cut = below(within, rows.reshape(-1, len(weights)), most.reshape(-1))
            found = checkpoint_name(search(wanted, held, cut, order.found), SEARCHED)
            weights_below = solution(found, wanted, held, cut)
            new = allowed(weights_below)
            nearer = ((new - wanted) ** 2).sum() < ((order.best - wanted) ** 2).sum()
            safer, met = share(new) < share(order.best), 1 + 20 * BARELY
            better = jnp.where(share(order.best) > met, safer, nearer & (share(new) <= met))
            better &= excess(new, held, within).max() <= reach
            best = jnp.where(better, new, order.best)
            return _Order(order.step + 1, weights_below, best, rows, most, found)

        def going(order: _Order) -> Array:
            return (order.step < self.planes) & (share(order.weights) > 1 + BARELY)

        rows = jnp.zeros((min(self.planes, KEPT), len(limited), len(weights)), weights.dtype)
        most = jnp.full(rows.shape[:2], jnp.inf, weights.dtype)
        none = none_binds(below(within, rows.reshape(-1, len(weights)), most.reshape(-1)))
        order = _Order(jnp.array(0, jnp.int32), weights, first, rows, most, none)
        order = closer(order) if self.planes == 1 else lax.while_loop(going, closer, order)
        return order.best

    def _fewer(self, wanted: Float[Array, " asset"], held: Float[Array, " asset"]) -> Limits:
        """Limits that keep all but the largest weights at 0.

        If these need more turnover than there may be, the largest with what is held.
        """

        def only(size: Array) -> tuple[Array, Limits]:
            _, kept = lax.top_k(abs(size) + self._needed(size), self.holdings)
            others = jnp.ones(len(wanted), bool).at[kept].set(False)
            limits = _fixed(self.limits, others, jnp.zeros_like(wanted))
            return excess(nearest(wanted, held, limits), held, limits).max(), limits

        sizes = jnp.stack([nearest(wanted, held, self.limits), held])
        (over, over_as_held), limits = jax.vmap(only)(lax.stop_gradient(sizes))
        as_held = (over > BARELY) & (over > over_as_held)
        return jax.tree.map(lambda x: jnp.where(as_held, x[1], x[0]), limits)

    def _without_small(
        self, wanted: Float[Array, " asset"], held: Float[Array, " asset"], limits: Limits
    ) -> tuple[Multipliers, Bool[Array, " asset"]]:
        """What stays as it is held because it changes little, and the multipliers of the order.

        The others take what that leaves over; if it makes their changes too small as well, nothing
        is traded.
        """
        can_stay = (held >= limits.low) & (held <= limits.high)

        def small(found: Multipliers, limits: Limits) -> Array:
            change = approximate(found, wanted, held, limits) - held
            return can_stay & (abs(change) < self.smallest_trade - BARELY)

        def leave(before: tuple[Array, Multipliers], _: None) -> tuple[tuple, tuple]:
            left, found = before
            fewer = _fixed(limits, left, held)
            found = search(wanted, held, fewer, found)
            return (left | small(found, fewer), found), before

        nothing = none_binds(limits)
        none = jnp.zeros_like(can_stay)
        (left, found), (lefts, founds) = lax.scan(leave, (none, nothing), None, ROUNDS)
        fewer = _fixed(limits, lefts[-1], held)
        fits = excess(approximate(found, wanted, held, fewer), held, limits).max() <= BARELY
        fits &= (left == lefts[-1]).all()
        now = jnp.append(1 - held.sum(), held)
        may_stay = jnp.stack(list(self.violations(now).values())).max() <= BARELY
        otherwise = _choose(may_stay, (nothing, ~none), (founds[1], none))
        return _choose(fits, (found, lefts[-1]), otherwise)

    def _needed(self, weights: Float[Array, " asset"]) -> Float[Array, " asset"]:
        """Which assets are kept first: those with a floor, then the largest weights of each group
        with a floor, as many as its caps require."""
        low, high, rows, most, *_ = self.limits
        members = (rows < 0) & ~(rows < 0).all(1)[:, None]  # of a floor, but not that of all assets
        larger = weights[None] > weights[:, None]
        room = jnp.where(members, high, 0.0) @ larger.T  # of larger weights, (row, asset)
        of_groups = (members & (room < -most[:, None] - BARELY)).any(0)
        return 20.0 * ((low > 0) | (high < 0)) + 10.0 * of_groups

    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        drawn = CappedSimplex(jnp.ones_like(self.limits.high)).draw(key)
        from_anywhere = self.limits._replace(turnover=jnp.array(jnp.inf))
        return Mandated(from_anywhere, self.names, self.holdings).project(drawn, drawn)

    def violations(self, weights: Any, held: Any = None) -> dict[str, Any]:
        """As in ``Feasible``; given the weights held, also for turnover and the smallest trade."""
        xp = weights.__array_namespace__()
        low, high, rows, most, gross, turnover = (xp.asarray(x) for x in self.limits[:6])
        assets = weights[..., 1:]
        found = {
            "the sum is off 1 by": abs(weights.sum(-1) - 1),
            "a weight is below its floor by": (low - assets).max(-1),
            "a weight is above its cap by": (assets - high).max(-1),
            "gross exposure is too high by": abs(assets).sum(-1) - gross,
        }
        over = assets @ rows.T - most
        found |= {name: over[..., i] for i, name in enumerate(self.names)}
        if self.holdings:
            count = (abs(assets) > BARELY).sum(-1)
            found["the number of holdings is too high by"] = count - 1.0 * self.holdings
        if held is not None:
            change = abs(assets - held[..., 1:])
            found["turnover is too high by"] = change.sum(-1) - turnover
            made = xp.where(change > BARELY, self.smallest_trade - change, -1.0)
            found["a trade is too small by"] = made.max(-1)
        return found


def exactly(
    feasible: Feasible, wanted: NDArray[np.float64], held: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The nearest weights, in float64; all weights have shape (entry,)."""
    feasible = feasible.exact if isinstance(feasible, Mandated) else feasible
    with jax.enable_x64(True):
        found = np.array(_projected(jax.tree.map(jnp.asarray, feasible), wanted, held))
    if feasible.long_only:
        found[0] = max(found[0], 0.0)  # rounding may leave it below 0
    return found


@eqx.filter_jit
def _projected(feasible: Feasible, wanted: Any, held: Any) -> Array:
    return feasible.project(jnp.asarray(wanted), jnp.asarray(held))


def _choose(first: Bool[Array, ""], one: PyTree, other: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), one, other)


def _fixed(limits: Limits, which: Bool[Array, " asset"], to: Float[Array, " asset"]) -> Limits:
    """The limits, with some weights at given values."""
    low, high = (jnp.where(which, to, bound) for bound in (limits.low, limits.high))
    return limits._replace(low=low, high=high)
