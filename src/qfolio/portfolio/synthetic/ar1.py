"""A market with an AR(1) signal and costs; ``solvers/ar1.py`` solves it."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.core.errors import QfolioError
from qfolio.core.fields import constant, number, require, static
from qfolio.core.mdp import Policy, Position
from qfolio.portfolio.costs import Context
from qfolio.portfolio.market import Relatives
from qfolio.portfolio.synthetic.base import OneAsset, require_cost
from qfolio.solvers.ar1 import Ar1Optimum, ar1


class Ar1Market(NamedTuple):
    """The signal, and the asset's latest price relative."""

    signal: Float[Array, ""]
    relative: Float[Array, ""]  # of the step that led here


class Ar1(OneAsset):
    """One asset whose mean return follows a signal: x' = ρx + noise ε, r = drift + slope·x + ση."""

    rho: float = number(0.95)  # persistence of the signal
    noise: float = number(0.3122)  # standard deviation of the signal's shocks, per step
    drift: float = number(0.0002)  # mean return without a signal, per step
    slope: float = number(0.004)  # additional mean return for a signal of 1
    volatility: float = number(0.01)  # standard deviation of the return, per step
    cost: float = constant(0.002)  # one way, as a share of the value traded
    menu: str = static("")  # choices of weights, such as grid:10; empty: any
    horizon: int = static(252)  # steps of an episode

    levels = 11

    def __check_init__(self) -> None:
        require(self, "rho", lambda x: 0 <= x <= 0.999, "from 0 to 0.999")
        require(self, "noise volatility", lambda x: 0 < x <= 10, "above 0 and at most 10")
        # Beyond these, its solver would look ahead for too long.
        require(self, "horizon", lambda x: x <= 10_000, "from 1 to 10,000")
        require_cost(self)
        # Five standard deviations of the signal and the return must leave the price positive.
        worst = abs(self.drift) + 5 * abs(self.slope) * self.spread + 5 * self.volatility
        if worst >= 1:
            raise QfolioError(
                "Returns below −100% are too likely; lower slope, noise, rho or volatility."
            )

    @property
    def spread(self) -> Float[Array, ""] | float:
        """Standard deviation of the signal."""
        return self.noise / (1 - self.rho**2) ** 0.5

    def reset_market(self, key: PRNGKeyArray) -> Ar1Market:
        return Ar1Market(self.spread * jax.random.normal(key), jnp.array(1.0))

    def next_market(self, market: Ar1Market, key: PRNGKeyArray) -> Ar1Market:
        shocks = jax.random.normal(key, (2,))
        gain = self.drift + self.slope * market.signal + self.volatility * shocks[1]
        return Ar1Market(self.rho * market.signal + self.noise * shocks[0], 1 + gain)

    def features(self, market: Ar1Market) -> Float[Array, "asset time channel"]:
        return (market.signal / self.spread).reshape(1, 1, 1)

    def relatives(self, market: Ar1Market, next_market: Ar1Market) -> Relatives:
        moved = next_market.relative[None]
        return Relatives(jnp.ones(1), moved, moved)

    def best(self) -> Policy:
        numbers = self.rho, self.noise, self.drift, self.slope, self.volatility, self.cost
        solution = _solved(*map(float, numbers), self.levels, self.horizon)
        weights = jnp.asarray(np.linspace(0, 1, self.levels), jnp.float32)
        signals = jnp.asarray(solution.signals, jnp.float32)
        after = jnp.asarray(solution.after, jnp.float32)
        choices = jnp.stack([1 - weights, weights], -1)

        def policy(state: Position) -> Array:
            at = lambda column: jnp.interp(state.market.signal, signals, column)  # noqa: E731
            later = jax.vmap(at, 1)(after)
            held = jnp.broadcast_to(state.holding.weights, choices.shape)
            remainder, _ = self.costs.trade(held, choices, Context())
            return choices[(jnp.log(remainder) + later).argmax()]

        return policy

    def rule(self, policy: Policy) -> dict[str, float]:
        return {
            f"from {held:.0%} at signal {name}": self.weight(policy, market, held)
            for name, market in self.scenes()
            for held in (0.0, 0.5, 1.0)
        }

    def scenes(self) -> list[tuple[str, Any]]:
        states = [(f"{x:+.1f}", x) for x in (-0.6, -0.2, 0.2, 0.6)]
        return [(name, Ar1Market(jnp.array(x * self.spread), jnp.array(1.0))) for name, x in states]


@functools.lru_cache(maxsize=8)
def _solved(
    rho: float, noise: float, drift: float, slope: float, volatility: float, cost: float,
    levels: int, horizon: int,
) -> Ar1Optimum:  # fmt: skip
    """Solved once for the curve, the grade and the report: at high costs it takes a minute."""
    discount = 1 - 1 / horizon  # looks as far ahead as an episode is long
    return ar1(rho, noise, drift, slope, volatility, cost, np.linspace(0, 1, levels), discount)
