"""Merton's market with borrowing and short sales; ``solvers/merton.py`` solves it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.core import simplex
from qfolio.core.fields import constant, number, require, static
from qfolio.core.mdp import Box, Policy, Position
from qfolio.portfolio.costs import Context
from qfolio.portfolio.mandate.feasible import Feasible
from qfolio.portfolio.market import Contexts, Holding
from qfolio.portfolio.synthetic.merton import Scenarios, lognormal_table
from qfolio.solvers.merton import LeveragedOptimum, leveraged_optimal


class Anything(Feasible):
    """All weights, including negative ones; random draws are near zero."""

    assets: int

    @property
    def long_only(self) -> bool:
        return False

    def project(self, wanted: Array, held: Array) -> Float[Array, " entry"]:
        return wanted

    def draw(self, key: PRNGKeyArray) -> Float[Array, " entry"]:
        return simplex.with_rest(jax.random.normal(key, (self.assets,)) / self.assets)

    def violations(self, weights: Any) -> dict[str, Any]:
        return {"the sum is off 1 by": abs(weights.sum(-1) - 1)}


class Leverage(Scenarios):
    """Three assets and cash, which may be borrowed at a higher rate than it earns when lent.

    Returns over a quarter are drawn from a fixed set of log-normal scenarios; the third asset is
    best sold short. An action is the weights of the assets, of any size and sign; cash is the rest.
    The best weights maximize the expected utility of the next step, with constant relative risk
    aversion (1: log growth). At the default rates, investors with a risk aversion below 1.6 borrow,
    those above 3.2 lend, and those between hold no cash.
    """

    cash_rate: float = constant(0.02)  # rate that cash earns, per year
    borrow_spread: float = constant(0.03)  # rate of a loan above it, per year
    risk_aversion: float = number(2.0)  # relative risk aversion; 1: log growth
    horizon: int = static(100)  # quarters of an episode

    menu = ""
    reward = "crra"
    dt = 0.25
    drift = (0.10, 0.08, 0.02)  # per year, like the volatilities
    volatilities = (0.2, 0.15, 0.25)

    def __check_init__(self) -> None:
        require(self, "cash_rate", lambda x: -0.1 <= x <= 0.5, "from -0.1 to 0.5 per year")
        require(self, "borrow_spread", lambda x: 0 <= x <= 0.5, "from 0 to 0.5 per year")
        require(self, "risk_aversion", lambda x: 0.5 <= x <= 100, "from 0.5 to 100")

    @property
    def cost_model(self) -> str:  # type: ignore[override]
        return f"itemized(cash_rate={self.cash_rate})"

    @property
    def limits(self) -> Float[Array, " asset"]:
        return jnp.full(len(self.drift), jnp.inf)

    @property
    def feasible(self) -> Feasible:
        return Anything(len(self.drift))

    @property
    def actions(self) -> Box:
        return Box(len(self.drift))

    def wanted(self, market: Array, holding: Holding, action: Array) -> Float[Array, " entry"]:
        return simplex.with_rest(action)

    def intent(self, state: Position, action: Array) -> Array:
        return action

    def table(self) -> np.ndarray:
        return lognormal_table(
            tuple(mean * self.dt for mean in self.drift),
            tuple(sigma * self.dt**0.5 for sigma in self.volatilities),
            self.correlation,
            self.scenarios,
        )

    def contexts(self, market: Array, next_market: Array) -> Contexts:
        period = Context(years=self.dt)
        return Contexts(earning=period, coming=period)

    def solution(self) -> LeveragedOptimum:
        """The exact weights of the assets."""
        debt = self.cash_rate + self.borrow_spread
        relatives = (float(np.exp(rate * self.dt)) for rate in (self.cash_rate, debt))
        return leveraged_optimal(self.table(), None, float(self.risk_aversion), *relatives)

    def best(self) -> Policy:
        weights = jnp.asarray(self.solution().weights, jnp.float32)
        return lambda state: weights

    def rule(self, policy: Policy) -> dict[str, float]:
        weights = policy(Position(jnp.array(0), self.hold(simplex.with_rest(jnp.zeros(3)))))
        named = {f"weight of asset {i + 1}": float(weight) for i, weight in enumerate(weights)}
        return named | {"weight of cash": 1 - sum(named.values())}
