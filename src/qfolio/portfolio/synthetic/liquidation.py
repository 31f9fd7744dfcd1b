"""Selling a position when trades move the price; ``solvers/almgren_chriss.py`` solves it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.fields import number, require, static
from qfolio.core.market import View
from qfolio.core.mdp import Box, Policy, Position, Step
from qfolio.portfolio.synthetic.base import Synthetic
from qfolio.solvers.almgren_chriss import almgren_chriss, sinh_ratio


class Liquidation(Synthetic):
    """A position that must be sold within ``horizon`` steps, which take ``days`` in total.

    Almgren & Chriss (2000), with the numbers of their table 1 in million shares, days and million
    dollars. The action is the position to be left after the step; the last step sells all of it.
    The reward of a step is minus the sum of its expected shortfall and ``risk_aversion`` times its
    variance, so that returns do not depend on luck in prices.
    """

    volatility: float = number(0.95)  # of a day, in dollars per share
    temporary: float = number(2.5)  # impact of a million shares a day, in dollars per share
    permanent: float = number(0.25)  # impact of a million shares, in dollars per share
    risk_aversion: float = number(1.0)  # per million dollars
    days: float = number(5.0)  # days of an episode
    horizon: int = static(5)  # steps of an episode

    START = (0.5, 1.5)
    """Smallest and largest number of shares to sell, in millions."""

    drawn = (0.0, 1.5)

    def __check_init__(self) -> None:
        positive = "volatility temporary risk_aversion days"
        require(self, positive, lambda x: 1e-6 <= x <= 1e6, "from 1e-6 to 1e6")
        require(self, "permanent", lambda x: 0 <= x <= 1e6, "from 0 to 1e6")
        # Half of a step's permanent impact; the base refuses a horizon of 0.
        half = self.permanent * self.days / max(self.horizon, 1) / 2
        require(self, "temporary", lambda x: x > half, f"above {half}, or fast sales cost nothing")

    @property
    def _tau(self) -> Float[Array, ""] | float:
        """Days in a step."""
        return self.days / self.horizon

    @property
    def actions(self) -> Box:
        return Box(1)

    def reset_market(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return jnp.array(0, jnp.int32)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Int[Array, ""]:
        return market + 1

    def draw_holding(self, key: PRNGKeyArray) -> Float[Array, " asset"]:
        least, most = self.START
        return jax.random.uniform(key, (1,), minval=least, maxval=most)

    def observe(self, state: Position) -> View:
        left = 1 - state.market / self.horizon
        return View(jnp.reshape(2 * left - 1, (1, 1, 1)), state.holding)

    def step(self, state: Position, action: Array, key: PRNGKeyArray) -> Step:
        after = super().step(state, action, key)
        return after._replace(terminated=after.state.market >= self.horizon)

    def settle(
        self, market: Array, next_market: Array, holding: Array, action: Array
    ) -> tuple[Float[Array, ""], Float[Array, " asset"]]:
        left = jnp.where(next_market >= self.horizon, 0.0, action)
        sold = holding[0] - left[0]
        impact = self.temporary * sold**2 / self._tau + self.permanent * sold * left[0]
        risk = self.risk_aversion * self.volatility**2 * self._tau * left[0] ** 2
        return -impact - risk, left

    def best(self) -> Policy:
        sale = almgren_chriss(
            1.0, self.volatility, self.temporary, self.permanent, self.risk_aversion, self.days,
            self.horizon,
        )  # fmt: skip
        left = self.days / self.horizon * np.arange(self.horizon, -1, -1)
        kept = jnp.asarray(sinh_ratio(sale.kappa, left[1:], left[:-1]), jnp.float32)
        return lambda state: kept[jnp.minimum(state.market, self.horizon - 1)] * state.holding

    def rule(self, policy: Policy) -> dict[str, float]:
        """What is left of a million shares after each step."""
        position, rule = jnp.ones(1), {}
        for time in range(self.horizon - 1):
            position = policy(Position(jnp.array(time, jnp.int32), position))
            rule[f"left after step {time + 1}"] = float(position[0])
        return rule

    def scenes(self) -> list[tuple[str, Any]]:
        times = sorted({0, self.horizon // 2, max(self.horizon - 2, 0)})
        return [(f"before step {time + 1}", jnp.array(time, jnp.int32)) for time in times]
