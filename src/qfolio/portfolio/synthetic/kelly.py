"""Kelly's bet as a market; ``solvers/kelly.py`` solves it."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.core.fields import number, require, static
from qfolio.core.mdp import Policy
from qfolio.portfolio.market import Relatives
from qfolio.portfolio.synthetic.base import OneAsset
from qfolio.solvers.kelly import kelly


class Kelly(OneAsset):
    """A repeated bet: a stake is multiplied by ``up`` with ``probability``, or else by ``down``."""

    up: float = number(1.1)  # price relative after a win
    down: float = number(0.9)  # price relative after a loss
    probability: float = number(0.53)  # probability of a win
    menu: str = static("")  # choices of weights, such as grid:10; empty: any
    horizon: int = static(100)  # steps of an episode

    cost = 0.0

    def __check_init__(self) -> None:
        require(self, "up", lambda x: 1 < x <= 100, "above 1 and at most 100")
        require(self, "down", lambda x: 0.01 <= x < 1, "at least 0.01 and below 1")
        require(self, "probability", lambda x: 0 < x < 1, "above 0 and below 1")

    def reset_market(self, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.array(1.0)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.where(jax.random.uniform(key) < self.probability, self.up, self.down)

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return jnp.ones((1, 1, 1))

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        return Relatives(jnp.ones(1), next_market[None], next_market[None])

    def best(self) -> Policy:
        fraction, _ = kelly(self.up, self.down, self.probability)
        return lambda state: jnp.array([1 - fraction, fraction], jnp.float32)

    def rule(self, policy: Policy) -> dict[str, float]:
        return {"fraction": self.weight(policy, jnp.array(1.0), 0.5)}

    def scenes(self) -> list[tuple[str, Any]]:
        return [("at any time", jnp.array(1.0))]
