"""The weights that a mandate allows."""

import abc
import dataclasses
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from qfolio.core import simplex
from qfolio.core.arrays import Bools, Floats
from qfolio.portfolio.mandate.order import BARELY, Rules, ordered
from qfolio.portfolio.mandate.projection import Limits
from qfolio.portfolio.mandate.risk import Past, Risk

GROSS = "gross exposure is too high by"
TURNOVER = "turnover is too high by"
TURNOVER_OF_YEAR = "turnover of the year is too high by"
"""Names of violations of a mandate."""


class Bound(NamedTuple):
    """One side of what a mandate limits."""

    what: str  # cash, or a group
    side: Literal["minimum", "maximum", "floor", "cap"]

    @property
    def violation(self) -> str:
        """The name of its violation."""
        where = "above" if self.side in ("maximum", "cap") else "below"
        return f"{self.what} is {where} its {self.side} by"


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

    def spending(self, turnover: Any) -> "Feasible":
        """The set of orders with at most some turnover, if a mandate limits it; None: no limit."""
        return self

    @abc.abstractmethod
    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """Weights of the set for the wanted weights, of sum 1, and the weights held.

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
    """Weights that obey a mandate, made by ``limits.feasible``.

    An order is the point of the set that is nearest to the weights wanted, in the weights of the
    assets; cash is the rest. With a number of holdings, the largest weights of that point are kept,
    and the others are 0. Changes below the smallest trade are not made, unless a limit needs them.
    If turnover clashes with other limits, as after a fall in prices, it gives way to them.
    """

    limits: Limits
    bounds: tuple[Bound, ...] = eqx.field(static=True)  # the rows of the limits
    holdings: int = eqx.field(static=True, default=0)  # at most so many; 0: any number
    smallest_trade: float = eqx.field(static=True, default=0.0)
    exposure: float = eqx.field(static=True, default=1.0)  # largest sum of absolute weights
    long: bool = eqx.field(static=True, default=True)
    volatility: float = eqx.field(static=True, default=float("inf"))  # a year, at most
    tracking_error: float = eqx.field(static=True, default=float("inf"))  # a year, at most
    risk: Risk | Past | None = None  # as known at a row, if there is such a limit

    @property
    def buyable(self) -> Bools:
        """The assets of which a weight above 0 is allowed, of shape (asset,)."""
        return np.asarray(self.limits.high) > 0

    @property
    def limits_risk(self) -> bool:
        """Whether volatility or tracking error has a limit."""
        return min(self.volatility, self.tracking_error) < float("inf")

    def knowing(self, risk: Risk | Past) -> "Mandated":
        """The set at one row, with that row's estimate of risk."""
        return dataclasses.replace(self, risk=risk)

    @property
    def rules(self) -> Rules:
        """What an order obeys."""
        risk = self.risk if self.limits_risk else None
        return Rules(
            self.limits,
            risk,
            self.holdings,
            self.smallest_trade,
            self.volatility,
            self.tracking_error,
        )

    def spending(self, turnover: Any) -> "Mandated":
        if turnover is None:
            return self
        least = turnover.__array_namespace__().minimum(self.limits.turnover, turnover)
        return dataclasses.replace(self, limits=self.limits._replace(turnover=least))

    @property
    def at_once(self) -> "Mandated":
        """The set without a limit on turnover."""
        turnover, xp = self.limits.turnover, self.limits.high.__array_namespace__()
        free = self.limits._replace(turnover=xp.full_like(turnover, xp.inf))
        return dataclasses.replace(self, limits=free)

    @property
    def long_only(self) -> bool:
        return self.long

    @property
    def gross(self) -> float:
        return self.exposure

    def project(
        self,
        wanted: Float[Array, " entry"],
        held: Float[Array, " entry"],
        asked: Bool[Array, ""] | bool = True,
    ) -> Float[Array, " entry"]:
        """As in ``Feasible``; what is held if no order is asked for."""
        rules = jax.tree.map(lambda x: _like(jnp.asarray(x), wanted.dtype), self.rules)
        asked = jnp.asarray(asked)
        weights = ordered(rules, rules.limits.turnover, asked, wanted[1:], held[1:])
        if self.long:  # rounding may leave no cash, and less
            weights /= jnp.maximum(weights.sum(), 1.0)
        return jnp.where(asked, simplex.with_rest(weights), held)

    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        """As in ``Feasible``, but for turnover, the smallest trade and limits of risk."""
        drawn = CappedSimplex(jnp.ones_like(self.limits.high)).draw(key)
        never = float("inf")
        free = dataclasses.replace(
            self.at_once,
            smallest_trade=0.0,
            volatility=never,
            tracking_error=never,
            risk=None,
        )
        return free.project(drawn, drawn)

    def violations(self, weights: Any, held: Any = None) -> dict[str, Any]:
        """As in ``Feasible``, but for limits of risk, which depend on the row.

        Given the weights held, also for turnover and the smallest trade.
        """
        xp = weights.__array_namespace__()
        low, high, rows, most, gross, turnover = (xp.asarray(x) for x in self.limits[:6])
        assets = weights[..., 1:]
        found = {
            "the sum is off 1 by": abs(weights.sum(-1) - 1),
            "a weight is below its floor by": (low - assets).max(-1),
            "a weight is above its cap by": (assets - high).max(-1),
            GROSS: abs(assets).sum(-1) - gross,
        }
        over = assets @ rows.T - most
        found |= {bound.violation: over[..., i] for i, bound in enumerate(self.bounds)}
        if self.holdings:
            count = (abs(assets) > BARELY).sum(-1)
            found["the number of holdings is too high by"] = count - 1.0 * self.holdings
        if held is not None:
            change = abs(assets - held[..., 1:])
            found[TURNOVER] = change.sum(-1) - turnover
            made = xp.where(change > BARELY, self.smallest_trade - change, -1.0)
            found["a trade is too small by"] = made.max(-1)
        return found


def exactly(feasible: Feasible, wanted: Floats, held: Floats) -> Floats:
    """The nearest weights, in float64; all weights have shape (entry,)."""
    with jax.enable_x64(True):
        found = np.array(_projected(jax.tree.map(jnp.asarray, feasible), wanted, held))
    if feasible.long_only:
        found[0] = max(found[0], 0.0)  # rounding may leave it below 0
    return found


@eqx.filter_jit
def _projected(feasible: Feasible, wanted: Any, held: Any) -> Array:
    return feasible.project(jnp.asarray(wanted), jnp.asarray(held))


def _like(x: Array, dtype: Any) -> Array:
    """Numbers in a given precision; integers as they are."""
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x
