"""Merton's market on the simplex; ``solvers/merton.py`` solves it."""

import abc
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.fields import static
from qfolio.core.mdp import Policy, Position
from qfolio.portfolio.market import Relatives
from qfolio.portfolio.synthetic.base import SyntheticMarket
from qfolio.solvers.merton import growth_optimal


@cache
def lognormal_table(
    means: tuple[float, ...], volatilities: tuple[float, ...], correlation: float, scenarios: int
) -> np.ndarray:
    """Price relatives, shape (scenario, asset), whose logs have exactly the given moments.

    Args:
        means: Drift μ of each asset over a period; its mean log return is μ − σ²/2.
        volatilities: Standard deviations of the log returns.
        correlation: Correlation of any two assets' log returns.
        scenarios: Number of scenarios, all equally likely.
    """
    n = len(means)
    normal = np.random.default_rng(1969).standard_normal((scenarios, n))
    normal -= normal.mean(0)
    normal = np.linalg.solve(np.linalg.cholesky(np.cov(normal.T)), normal.T)
    sigma = np.array(volatilities)
    correlations = np.full((n, n), correlation) + (1 - correlation) * np.eye(n)
    shocks = np.linalg.cholesky(correlations) @ normal * sigma[:, None]
    return np.exp(np.array(means) - sigma**2 / 2 + shocks.T)


class Scenarios(SyntheticMarket):
    """Three assets whose returns are drawn from a fixed set of scenarios, and cash."""

    cost = 0.0
    correlation = 0.3
    scenarios = 500

    @abc.abstractmethod
    def table(self) -> np.ndarray:
        """Price relatives of each scenario, shape (scenario, asset)."""

    def reset_market(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return jnp.array(0, jnp.int32)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Int[Array, ""]:
        return jax.random.randint(key, (), 0, self.scenarios, jnp.int32)

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return jnp.eye(3)[:, None, :]  # one-hot: nothing else tells the assets apart

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        moved = jnp.asarray(self.table(), jnp.float32)[next_market]
        return Relatives(jnp.ones(3), moved, moved)

    def scenes(self) -> list[tuple[str, Any]]:
        return []


class Merton(Scenarios):
    """Three assets whose returns are drawn from a fixed set of log-normal scenarios, with cash.

    The best weights maximize E log(b·x) over the simplex (Merton 1969; with the constraint, the
    conditions of Cover 1984); one asset is not worth holding.
    """

    menu: str = static("")  # choices of weights, such as grid:10; empty: any
    horizon: int = static(100)  # steps of an episode

    means = (0.010, 0.006, 0.001)
    volatilities = (0.12, 0.08, 0.10)

    @property
    def limits(self) -> Float[Array, " asset"]:
        return jnp.ones(3)

    @staticmethod
    def table() -> np.ndarray:
        """Price relatives of each scenario, shape (scenario, asset)."""
        return lognormal_table(
            Merton.means, Merton.volatilities, Merton.correlation, Merton.scenarios
        )

    def best(self) -> Policy:
        scenarios = np.column_stack([np.ones(self.scenarios), self.table()])
        weights = jnp.asarray(growth_optimal(scenarios).weights, jnp.float32)
        return lambda state: weights

    def rule(self, policy: Policy) -> dict[str, float]:
        state = Position(jnp.array(0), self.hold(jnp.full(4, 0.25)))
        weights = policy(state)
        return {f"weight of asset {i}": float(weights[i]) for i in (1, 2, 3)}
