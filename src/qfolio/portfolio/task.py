"""A portfolio of assets with given prices.

State: the row of the price table, the portfolio. Observation: for each asset a window of log
returns (and of any other features), and the current weights. Action: target weights, or a choice
from a menu. A decision sees prices up to row t, is executed at the close of row t + lag, and earns
the move to the row after. Nothing that is observed at t changes when a later price does.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.errors import QfolioError
from qfolio.core.fields import constant, number, require, static
from qfolio.core.mdp import Actions, Simplex
from qfolio.portfolio.market import REWARDS, Market, Relatives
from qfolio.portfolio.prices.table import Prices

Row = Int[Array, ""]


class Portfolio(Market):
    """Trade the assets of a price table; each episode is a stretch of ``horizon`` rows.

    ``Portfolio.of(prices)`` makes one that may use all rows, ``part`` one that may use some.
    """

    log_relatives: Float[Array, "row asset"]  # log of price over the row before; 0 where unknown
    extra: Float[Array, "row asset channel"]  # other features
    largest: Float[Array, " asset"]  # possible weight of each asset; 0 where it cannot be traded
    center: Float[Array, " channel"]  # of the observed channels, from the rows of the part
    scale: Float[Array, " channel"]
    first: Row  # decisions are made from here
    last: Row  # to here
    window: int = static(60)  # rows that are observed
    lag: int = static(1)  # rows from a decision to its execution
    cost: float = constant(0.001)  # of trading one way, as a share of what is traded
    cap: float = constant(1.0)  # largest weight of one asset
    menu: str = static("")
    reward: str = static("log")
    risk_aversion: float = number(3.0)
    sharpe_rate: float = number(0.01)
    horizon: int = static(50)

    @staticmethod
    def of(prices: Prices, **settings: Any) -> "Portfolio":
        """A task on all rows of a table."""
        values = prices.values
        log_relatives, extra = Portfolio.arrays(prices)
        channels = 1 + extra.shape[2]
        task = Portfolio(
            log_relatives=log_relatives,
            extra=extra,
            largest=jnp.ones(values.shape[1]),
            center=jnp.zeros(channels),
            scale=jnp.ones(channels),
            first=jnp.array(0, jnp.int32),
            last=jnp.array(0, jnp.int32),
            **settings,
        )
        return task.part(0, len(values) - 1, ~np.isnan(values[0]))

    @staticmethod
    def arrays(prices: Prices) -> tuple[Array, Array]:
        """``log_relatives`` and ``extra`` of a table."""
        logs = np.zeros(prices.values.shape)
        logs[1:] = np.nan_to_num(np.diff(np.log(prices.values), axis=0))
        extra = np.nan_to_num(prices.features)
        return jnp.asarray(logs, jnp.float32), jnp.asarray(extra, jnp.float32)

    def __check_init__(self) -> None:
        require(self, "window horizon", lambda x: 1 <= x <= 100_000, "from 1 to 100,000")
        require(self, "lag", lambda x: 0 <= x <= 1000, "from 0 to 1000 rows")
        require(self, "cap", lambda x: 0 < x <= 1, "above 0 and at most 1")
        require(self, "reward", lambda x: x in REWARDS, f"one of {', '.join(REWARDS)}")
        for name, low, high in (
            ("cost", 0, 0.2),
            ("risk_aversion", 0, 100),
            ("sharpe_rate", 0, 0.5),
        ):
            value = getattr(self, name)
            if isinstance(value, float) and not low <= value <= high:
                raise QfolioError(f"{name} is {value}; it must be from {low} to {high}.")

    def part(self, first: int, last: int, tradable: np.ndarray | None = None) -> "Portfolio":
        """The same task on the prices of rows ``first`` to ``last`` alone.

        Windows, rewards and the scale of what is observed come from these rows only. tradable:
        which assets may be held, shape (asset,).
        """
        decisions = last - self.lag - 1 - (first + self.window) + 1
        if decisions < self.horizon:
            raise QfolioError(
                f"{last - first + 1} rows are too few: a window of {self.window}, a lag of "
                f"{self.lag} and an episode of {self.horizon} need at least "
                f"{self.window + self.lag + self.horizon + 1}; lower window or horizon, or bring "
                "more rows."
            )
        rows = slice(first + 1, last + 1)
        usable = np.ones(self.largest.shape[0], bool) if tradable is None else tradable
        if not usable.any():
            raise QfolioError("No asset can be traded over these rows.")
        channels = np.concatenate(
            [np.asarray(self.log_relatives)[rows, :, None], np.asarray(self.extra)[rows]], axis=2
        )[:, usable]
        center, scale = channels.mean((0, 1)), channels.std((0, 1))
        center[0] = 0.0  # the sign of a return means something
        return eqx.tree_at(
            lambda t: (t.largest, t.center, t.scale, t.first, t.last),
            self,
            (
                jnp.asarray(np.where(usable, self.cap, 0.0), jnp.float32),
                jnp.asarray(center, jnp.float32),
                jnp.asarray(np.where(scale > 0, scale, 1.0), jnp.float32),
                jnp.array(first + self.window, jnp.int32),
                jnp.array(last - self.lag - 1, jnp.int32),
            ),
        )

    @property
    def limits(self) -> Float[Array, " asset"]:
        return self.largest

    @property
    def actions(self) -> Actions:
        return super().actions if self.menu else Simplex(self.largest.shape[0], self.cap)

    def reset_market(self, key: PRNGKeyArray) -> Row:
        starts = self.last - self.first + 1 - self.horizon + 1
        return self.first + jnp.floor(jax.random.uniform(key) * starts).astype(jnp.int32)

    def next_market(self, market: Row, key: PRNGKeyArray) -> Row:
        # One row on, the last decision's outcome is known; episodes end there at the latest.
        return jnp.minimum(market + 1, self.last + 1)

    def features(self, market: Row) -> Float[Array, "asset time channel"]:
        start = market - self.window + 1
        returns = lax.dynamic_slice_in_dim(self.log_relatives, start, self.window)
        others = lax.dynamic_slice_in_dim(self.extra, start, self.window)
        channels = jnp.concatenate([returns[..., None], others], -1)
        return jnp.swapaxes((channels - self.center) / self.scale, 0, 1)

    def relatives(self, market: Row, next_market: Row) -> Relatives:
        after = lax.dynamic_slice_in_dim(self.log_relatives, market + 1, self.lag + 1)
        return Relatives(
            waiting=jnp.exp(after[: self.lag].sum(0)),
            earning=jnp.exp(after[self.lag]),
            coming=jnp.exp(after[0]),
        )
