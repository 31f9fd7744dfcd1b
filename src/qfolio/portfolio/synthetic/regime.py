"""A market of two regimes; ``solvers/regime.py`` solves it."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.fields import constant, numbers, require, static
from qfolio.core.mdp import Policy, Position
from qfolio.portfolio.market import Relatives
from qfolio.portfolio.synthetic.base import OneAsset, require_cost
from qfolio.solvers.regime import regime_bands


class Regime(OneAsset):
    """One asset, whose log return per step is ``mean`` in good times and minus that in bad times.

    Each regime lasts another step with probability ``stay``, and is observed before its return.
    Two numbers stand for bad and good times: stay=0.9,0.98 mean=-0.004,0.001.
    """

    stay: tuple[float, ...] = numbers(0.95)  # probability that a regime lasts another step
    mean: tuple[float, ...] = numbers(0.002)  # log return of a step in good times
    cost: float = constant(0.005)  # one way, as a share of the value traded
    menu: str = static("")  # choices of weights, such as grid:10; empty: any
    horizon: int = static(250)  # steps of an episode

    def __check_init__(self) -> None:
        one_or_two = "one number, or one for bad and one for good times"
        require(self, "stay mean", lambda x: len(x) in (1, 2), one_or_two)
        # In longer regimes the search for the bands would take hours.
        require(self, "stay", lambda x: 0 <= min(x) <= max(x) <= 0.9999, "from 0 to 0.9999")
        bad, good = self.means
        require(self, "mean", lambda _: -0.5 <= bad < good <= 0.5, "above 0 and at most 0.5, or "
                "two numbers from -0.5 to 0.5, the smaller one first")  # fmt: skip
        require_cost(self)

    @property
    def stays(self) -> tuple[float, float]:
        """Probabilities that bad and good times last another step."""
        return self.stay[0], self.stay[-1]

    @property
    def means(self) -> tuple[float, float]:
        """Log returns of a step in bad and in good times."""
        return (
            (-self.mean[0], self.mean[0]) if len(self.mean) == 1 else (self.mean[0], self.mean[1])
        )

    def reset_market(self, key: PRNGKeyArray) -> Int[Array, ""]:
        bad, good = self.stays
        return jax.random.bernoulli(key, (1 - bad) / (2 - bad - good)).astype(jnp.int32)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Int[Array, ""]:
        return jnp.where(
            jax.random.uniform(key) < jnp.array(self.stays)[market], market, 1 - market
        )

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return (2.0 * market - 1.0).reshape(1, 1, 1)

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        moved = jnp.exp(jnp.array(self.means))[market][None]
        return Relatives(jnp.ones(1), moved, moved)

    def best(self) -> Policy:
        ahead = 1 - 1 / self.horizon  # looks as far ahead as an episode is long
        edges = jnp.asarray(regime_bands(self.stays, self.means, self.cost, ahead), jnp.float32)

        def policy(state: Position) -> Array:
            weight = jnp.clip(state.holding.weights[1], *edges[state.market])
            return jnp.stack([1 - weight, weight])

        return policy

    def rule(self, policy: Policy) -> dict[str, float]:
        return {
            f"from {held} in {name} times": self.weight(policy, market, held)
            for name, market in self.scenes()
            for held in (0.0, 1.0)
        }

    def scenes(self) -> list[tuple[str, Any]]:
        return [("bad", jnp.array(0, jnp.int32)), ("good", jnp.array(1, jnp.int32))]
