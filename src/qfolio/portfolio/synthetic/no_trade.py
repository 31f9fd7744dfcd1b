"""One asset with costs and no signal; ``solvers/no_trade.py`` solves it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.core.errors import QfolioError
from qfolio.core.fields import constant, number, require, static
from qfolio.core.mdp import Policy, Position
from qfolio.portfolio.costs import Context, grown
from qfolio.portfolio.market import Contexts, Holding, Relatives
from qfolio.portfolio.synthetic.base import OneAsset, require_cost
from qfolio.solvers.no_trade import NoTradeRegion, no_trade_region_discrete
from qfolio.solvers.shared import gauss

PROBES = 1001
"""Number of holdings, from all cash to all in the asset, at which a policy is probed."""

NO_TRADE = 1e-4
"""Smaller changes of a weight do not count as trades."""


class NoTrade(OneAsset):
    """One asset with constant drift over cash; proportional costs make it best not to trade within
    a region. The reward is the *expected* log growth of each step, net of costs.

    Rates are per year, and a step lasts ``dt`` years. The asset's drift is ``rate`` above that of
    cash, ``cash_rate``.
    """

    rate: float = number(0.02)  # the asset's drift above that of cash, per year
    cash_rate: float = constant(0.0)  # growth of cash, per year
    volatility: float = number(0.2)  # of the asset, per year
    cost: float = constant(0.01)  # one way, as a share of the value traded
    dt: float = number(1 / 12)  # years of a step
    menu: str = static("")  # choices of weights, such as grid:10; empty: any
    horizon: int = static(480)  # steps of an episode

    NODES = 5

    def __check_init__(self) -> None:
        require(self, "volatility", lambda x: 0.01 <= x <= 2, "from 0.01 to 2")
        require(self, "cash_rate", lambda x: -1 <= x <= 1, "from -1 to 1 per year")
        require(self, "dt", lambda x: 0.001 <= x <= 1, "from 0.001 to 1 years")
        require_cost(self)
        if not 0.01 <= self.rate / self.volatility**2 <= 0.99:
            raise QfolioError(
                f"The best weight without costs is {self.rate / self.volatility**2:.3g}; rate and "
                "volatility must leave it between 0.01 and 0.99."
            )

    @property
    def cost_model(self) -> str:  # type: ignore[override]
        return f"itemized(cash_rate={self.cash_rate})" if self.cash_rate else "proportional"

    def contexts(self, market: Array, next_market: Array) -> Contexts:
        period = Context(years=self.dt)
        return Contexts(earning=period, coming=period)

    def reset_market(self, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.array(0.0)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Float[Array, ""]:
        return self._log_relative(jax.random.normal(key))

    def mirror(self, market: Array) -> Float[Array, ""]:
        """The log relative with the opposite shock."""
        return 2 * self._log_relative(jnp.array(0.0)) - market

    def _log_relative(self, shock: Array) -> Array:
        mean = (self.cash_rate + self.rate - self.volatility**2 / 2) * self.dt
        return mean + self.volatility * self.dt**0.5 * shock

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return jnp.ones((1, 1, 1))

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        moved = jnp.exp(next_market)[None]
        return Relatives(jnp.ones(1), moved, moved)

    def settle(
        self, market: Array, next_market: Array, holding: Holding, action: Array
    ) -> tuple[Float[Array, ""], Holding]:
        target = self.target(market, holding, action)
        at = self.contexts(market, next_market)
        remainder, _ = self.costs.trade(holding.weights, target, at.trade)
        nodes, chances = gauss(self.NODES)
        weights = jnp.asarray(chances, jnp.float32)
        # In excess of cash, so that no digits are lost where steps are short.
        interest = self.cash_rate * self.dt
        gains = jnp.expm1(self._log_relative(jnp.asarray(nodes, jnp.float32)) - interest)
        growth = interest + (weights * jnp.log1p(target[1] * gains)).sum()
        moved = self.costs.growth(target, jnp.exp(next_market)[None], at.coming)
        return jnp.log(remainder) + growth, self.hold(grown(target, moved))

    def region(self) -> NoTradeRegion:
        """The exact no-trade region, for steps of ``dt`` years."""
        return no_trade_region_discrete(
            self.rate, self.volatility, self.cost, self.dt, self.cash_rate
        )

    def best(self) -> Policy:
        low, high, _ = self.region()

        def policy(state: Position) -> Array:
            weight = jnp.clip(state.holding.weights[1], low, high)
            return jnp.stack([1 - weight, weight])

        return policy

    def rule(self, policy: Policy) -> dict[str, float | None]:
        """The edges of the no-trade region.

        Holdings are probed from all cash up, and from all in the asset down, until one is not
        traded; the edge is the target of the one before it. None if even the extreme is not traded.
        """
        held = np.linspace(0, 1, PROBES, dtype=np.float32)
        wanted = self.weights(policy, jnp.array(0.0), held)
        buys, sells = wanted > held + NO_TRADE, wanted < held - NO_TRADE
        too_little, too_much = buys.argmin() - 1, PROBES - sells[::-1].argmin()
        return {
            "low": float(wanted[too_little]) if buys[0] else None,
            "high": float(wanted[too_much]) if sells[-1] else None,
        }

    def scenes(self) -> list[tuple[str, Any]]:
        return [("at any time", jnp.array(0.0))]
