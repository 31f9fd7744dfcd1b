"""What all markets share: cash and assets, weights that drift, exact costs, and what is rewarded.

Weights have an entry for cash, then one for each asset. A decision names target weights at today's
prices: an order in shares, scaled to what the wealth affords when it is executed, and free of cost
where it equals what is held. The arithmetic of trading is in ``costs.py``, the same for
training and backtest.
"""

import abc
from math import comb
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.market import MenuActions, View
from qfolio.core.mdp import Actions, Discrete, ExogenousTask, Position, Simplex
from qfolio.portfolio.costs import drift, remainder_factor, with_cash

REWARDS = ("log", "crra", "mean-variance", "differential-sharpe")

MENU_LIMIT = 2000


class Holding(NamedTuple):
    """The portfolio as last decided, drifted to now, and running moments of past returns."""

    weights: Float[Array, " entry"]
    moments: Float[Array, "2"]  # of the differential Sharpe ratio


class Relatives(NamedTuple):
    """New price over old price of each asset, after a decision."""

    waiting: Float[Array, " asset"]  # from the decision to its execution
    earning: Float[Array, " asset"]  # from the execution to the next one
    coming: Float[Array, " asset"]  # from the decision to the next one


class Menu(eqx.Module):
    """Allocations to choose from: each keeps a share of the holding and fills up with a target.

    limits: the largest weights; assets with 0 have no part in equal weights.
    text: "grid:10" for all weights in tenths; "tilts:0.1" for: no order, all cash, equal weights,
    all in one asset, and a tenth of the holding moved into one asset (each for every asset);
    "overweight:0.1" for: no order, all cash, equal weights, and equal weights with a tenth of the
    wealth moved into one asset.
    """

    keep: Float[Array, " choice"]
    target: Float[Array, "choice entry"]
    actions: Discrete

    def __init__(self, text: str, limits: Float[Array, " asset"]) -> None:
        kind, _, size = text.partition(":")
        assets = limits.shape[0]
        each = jnp.eye(assets + 1)[1:]
        open_to = jnp.append(0.0, limits > 0)
        cash, equal = jnp.eye(assets + 1)[:1], (open_to / open_to.sum())[None]
        try:
            value = float(size)
        except ValueError:
            value = -1.0
        if kind == "grid" and value >= 1 and value == int(value):
            if comb(int(value) + assets, assets) > MENU_LIMIT:
                raise QfolioError(
                    f"menu={text} has more than {MENU_LIMIT:,} allocations of {assets} assets; "
                    "take a coarser grid, or menu=tilts:0.1."
                )
            target = jnp.asarray(simplex.grid(assets + 1, int(value)), jnp.float32)
            keep, self.actions = jnp.zeros(len(target)), Discrete(len(target))
        elif kind == "tilts" and 0 < value < 1:
            target = jnp.concatenate([cash, cash, equal, each, each])
            keep = jnp.zeros(len(target)).at[0].set(1.0).at[-assets:].set(1 - value)
            self.actions = MenuActions(len(target), pooled=3, each=2)
        elif kind == "overweight" and 0 < value < 1:
            target = jnp.concatenate([cash, cash, equal, (1 - value) * equal + value * each])
            keep = jnp.zeros(len(target)).at[0].set(1.0)
            self.actions = MenuActions(len(target), pooled=3, each=1)
        else:
            raise QfolioError(
                f"menu is {text!r}; it must be like grid:10, tilts:0.1 or overweight:0.1."
            )
        self.keep, self.target = keep, target

    def weights(
        self, held: Float[Array, " entry"], choice: Int[Array, ""]
    ) -> Float[Array, " entry"]:
        """The allocation that a choice means to a holder of ``held``."""
        return self.keep[choice] * held + (1 - self.keep[choice]) * self.target[choice]


class Market(ExogenousTask):
    """Cash and assets; a market says how prices move, and the rest is here.

    cost: of trading one way, as a share of what is traded. menu: text of a ``Menu`` for agents that
    choose among allocations; without, an action is the target weights. reward: log growth, CRRA
    utility or mean–variance utility of each step's growth (by ``risk_aversion``), or differential
    Sharpe ratio (Moody & Saffell 1998, with a memory of 1/``sharpe_rate`` steps).
    """

    if TYPE_CHECKING:  # as in Task

        @property
        def cost(self) -> float: ...

        @property
        def menu(self) -> str: ...
    else:
        cost: eqx.AbstractVar[float]
        menu: eqx.AbstractVar[str]

    reward = "log"
    risk_aversion = 1.0
    sharpe_rate = 0.01

    @property
    @abc.abstractmethod
    def limits(self) -> Float[Array, " asset"]:
        """The largest weight of each asset; 0 where it cannot be traded."""

    @abc.abstractmethod
    def features(self, market: PyTree) -> Float[Array, "asset time channel"]:
        """What is known of each asset, nothing later than now."""

    @abc.abstractmethod
    def relatives(self, market: PyTree, next_market: PyTree) -> Relatives:
        """How prices moved after a decision."""

    @property
    def actions(self) -> Actions:
        if self.menu:
            return Menu(self.menu, self.limits).actions
        return Simplex(self.limits.shape[0])

    def target(self, held: Float[Array, " entry"], action: Array) -> Float[Array, " entry"]:
        """Target weights of an action; what is above an asset's limit stays in cash."""
        weights = Menu(self.menu, self.limits).weights(held, action) if self.menu else action
        return self._limited(weights)

    def _limited(self, weights: Float[Array, " entry"]) -> Float[Array, " entry"]:
        allowed = jnp.minimum(weights[1:], self.limits)
        cash = weights[:1] + (weights[1:] - allowed).sum(keepdims=True)
        return jnp.concatenate([cash, allowed])

    def intent(self, state: Position, action: Array) -> Float[Array, " entry"]:
        return self.target(state.holding.weights, action)

    def observe(self, state: Position) -> View:
        return View(self.features(state.market), state.holding.weights[1:])

    def draw_holding(self, key: PRNGKeyArray) -> Holding:
        """From nearly equal weights to nearly all in one."""
        spread_key, key = jax.random.split(key)
        spread = jax.random.uniform(spread_key, maxval=4.0)
        weights = jax.nn.softmax(spread * jax.random.gumbel(key, (self.limits.shape[0] + 1,)))
        return self.hold(self._limited(weights))

    def hold(self, weights: Float[Array, " entry"]) -> Holding:
        """A holding without a past."""
        return Holding(weights, jnp.array([0.0, 1e-4]))

    def settle(
        self, market: PyTree, next_market: PyTree, holding: Holding, action: Array
    ) -> tuple[Float[Array, ""], Holding]:
        target = self.target(holding.weights, action)
        moved = self.relatives(market, next_market)
        before, after = drift(holding.weights, moved.waiting), drift(target, moved.waiting)
        remainder = remainder_factor(before, after, self.cost)
        growth = remainder * (after * with_cash(moved.earning)).sum()
        reward, moments = self.utility(growth, holding.moments)
        return reward, Holding(drift(target, moved.coming), moments)

    def utility(
        self, growth: Float[Array, ""], moments: Float[Array, "2"]
    ) -> tuple[Float[Array, ""], Float[Array, "2"]]:
        """Reward of one step's wealth ratio, and the moments after it."""
        gain = growth - 1
        if self.reward == "log":
            return jnp.log(growth), moments
        if self.reward == "crra":
            power = 1 - jnp.asarray(self.risk_aversion)
            log = abs(power) < 1e-6  # the limit
            safe = jnp.where(log, 1.0, power)
            utility = jnp.expm1(safe * jnp.log(growth)) / safe
            return jnp.where(log, jnp.log(growth), utility), moments
        if self.reward == "mean-variance":
            return gain - self.risk_aversion / 2 * gain**2, moments
        mean, square = moments
        change = jnp.stack([gain - mean, gain**2 - square])
        ratio = (square * change[0] - mean * change[1] / 2) / (square - mean**2) ** 1.5
        return ratio, moments + self.sharpe_rate * change
