"""The base of the markets with known solutions: an exact policy, and scenes to plot it in.

``rule`` extracts the few numbers that describe a policy (a fraction, the edges of a no-trade
region, a trading rate), to compare a learned policy with the exact one.
"""

import abc
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from qfolio.core.fields import require
from qfolio.core.mdp import ExogenousTask, Policy, Position
from qfolio.portfolio.market import Market
from qfolio.solvers.followed import FollowedOptimum


class Synthetic(ExogenousTask):
    """A market with a known best policy: from a state to target weights, or to a position."""

    def __check_init__(self) -> None:
        require(self, "horizon", lambda x: 1 <= x <= 100_000, "from 1 to 100,000")

    @abc.abstractmethod
    def best(self) -> Policy:
        """The exact policy."""

    drawn = (-2.0, 2.0)
    """Range of the first asset's holding over which a policy is plotted."""

    @abc.abstractmethod
    def scenes(self) -> list[tuple[str, Any]]:
        """Names and states of the market in which to plot a policy."""

    def optimum(self) -> FollowedOptimum:
        return FollowedOptimum(self, self.best())


def require_cost(task: Any) -> None:
    """Raises QfolioError unless a task's trading cost is from 0 to 0.2."""
    require(task, "cost", lambda x: 0 <= x <= 0.2, "from 0 to 0.2")


class SyntheticMarket(Market, Synthetic):
    """Cash and assets with a known best policy."""

    def optimum(self) -> FollowedOptimum:
        # The best policy returns weights, even if agents choose from a menu.
        task: Any = self  # to the type checker, the abstract menu is not a field
        weights = dataclasses.replace(task, menu="") if self.menu else task
        return FollowedOptimum(weights, self.best())


class OneAsset(SyntheticMarket):
    """Cash and one asset."""

    drawn = (0.0, 1.0)

    @property
    def limits(self) -> Float[Array, " asset"]:
        return jnp.ones(1)

    def weight(self, policy: Policy, market: Any, weight: float) -> float:
        """The asset's target weight for an account that holds ``weight`` of it."""
        return float(policy(self._state(market, weight))[1])

    def weights(
        self, policy: Policy, market: Any, weights: Float[np.ndarray, " holder"]
    ) -> Float[np.ndarray, " holder"]:
        """The asset's target weight for each of several holdings, shape (holder,)."""
        states = jax.vmap(lambda weight: self._state(market, weight))(weights)
        return np.asarray(jax.vmap(policy)(states)[:, 1])

    def _state(self, market: Any, weight: Float[Array, ""] | float) -> Position:
        weight = jnp.asarray(weight, jnp.float32)
        return Position(market, self.hold(jnp.stack([1 - weight, weight])))
