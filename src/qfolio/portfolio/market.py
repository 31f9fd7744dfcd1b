"""The base of all markets: cash and assets, drifting weights, exact costs, and rewards.

Weights have an entry for cash, then one for each asset. A decision sets target weights at today's
prices: an order in shares, scaled to the wealth when it is executed, and free of cost if it equals
the holding. Costs are in ``costs.py``, the same for training and backtest; feasible weights in
``mandate/feasible.py``; rewards in ``rewards.py``.
"""

import abc
import dataclasses
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core import settings, simplex
from qfolio.core.contract import require_reward
from qfolio.core.market import View
from qfolio.core.mdp import (
    Actions,
    ExogenousTask,
    Metrics,
    Position,
    Simplex,
    Transition,
)
from qfolio.core.registry import Kind, build, own_modules
from qfolio.portfolio.costs import Context, CostModel, grown, traded
from qfolio.portfolio.execution import Plan
from qfolio.portfolio.mandate.feasible import CappedSimplex, Feasible
from qfolio.portfolio.menu import Menu, Signalled
from qfolio.portfolio.rewards import Outcome, Reward

RUIN = 1e-3
"""Growth factor of the step that wipes an account out; the account then stays in cash."""


class Holding(NamedTuple):
    """An account: its last target weights, drifted to now; the reward's state; planned orders."""

    weights: Float[Array, " entry"]
    reward: PyTree
    plan: Plan | None = None


class Relatives(NamedTuple):
    """New price over old price of each asset, after a decision."""

    waiting: Float[Array, " asset"]  # from the decision to its execution
    earning: Float[Array, " asset"]  # from the execution to the next execution
    coming: Float[Array, " asset"]  # from the decision to the next decision


class Contexts(NamedTuple):
    """The circumstances of a decision's trade and of the periods of ``Relatives``."""

    waiting: Context = Context(rows=0)
    trade: Context = Context(rows=0)
    earning: Context = Context()
    coming: Context = Context()


class Trade(NamedTuple):
    """The execution of a decision, and the growth of wealth to the next one, costs included."""

    before: Float[Array, " entry"]  # weights just before the trade
    after: Float[Array, " entry"]  # weights just after it
    remainder: Float[Array, ""]  # share of wealth that remains
    cost: Float[Array, ""]  # share of wealth paid
    growth: Float[Array, ""]  # ``RUIN`` if the account is wiped out


class Market(ExogenousTask):
    """Cash and assets; subclasses define how prices move.

    cost: one-way trading cost, as a share of the value traded. menu: text of a ``Menu`` for agents
    that choose among allocations; without it, an action is the target weights. reward, cost_model:
    names of a ``Reward`` and of a ``CostModel``.
    """

    if TYPE_CHECKING:  # as in Task

        @property
        def cost(self) -> float: ...

        @property
        def menu(self) -> str: ...

        @property
        def limits(self) -> Float[Array, " asset"]: ...
    else:
        cost: eqx.AbstractVar[float]
        menu: eqx.AbstractVar[str]
        limits: eqx.AbstractVar[Float[Array, " asset"]]  # largest weights; 0: cannot be traded

    reward = "log"
    cost_model = "proportional"
    lag = 0  # rows from a decision to its execution

    def __check_init__(self) -> None:
        if own_modules(self.reward_function):
            account = jnp.zeros(1 + self.limits.shape[0])
            require_reward(self.reward_function, Outcome(jnp.ones(()), jnp.zeros(()), account))

    @abc.abstractmethod
    def features(self, market: PyTree) -> Float[Array, "asset time channel"]:
        """The features of each asset, without knowledge of the future."""

    @abc.abstractmethod
    def relatives(self, market: PyTree, next_market: PyTree) -> Relatives:
        """How prices moved after a decision."""

    def contexts(self, market: PyTree, next_market: PyTree) -> Contexts:
        """What a cost model may know of a decision's trade and of the time around it."""
        return Contexts()

    @property
    def actions(self) -> Actions:
        """The allocations of the menu; without one, all weights of the assets and cash."""
        return self._menu.actions if self.menu else Simplex(self.limits.shape[0])

    @property
    def _menu(self) -> Menu:
        return Menu(self.menu, self.limits, self.tilting)

    @property
    def _signal_menu(self) -> Menu | None:
        menu = self._menu if self.menu else None
        return None if menu is None or menu.tilts is None else menu

    @property
    def tilting(self) -> int:
        """Number of signals that a menu may tilt by."""
        return 0

    def signalled(self, market: PyTree) -> Signalled | None:
        """The anchor that a menu of signals tilts, and the signals; None without signals."""
        return None

    @property
    def feasible(self) -> Feasible:
        """The set of weights that may be ordered."""
        return CappedSimplex(self.limits)

    def feasible_at(self, market: PyTree) -> Feasible:
        """The set of weights that may be ordered in a state of the market."""
        return self.feasible

    @property
    def gross(self) -> float:
        """The largest sum of absolute weights of the assets."""
        return self.feasible.gross

    @property
    def costs(self) -> CostModel:
        return _part(self, "cost", self.cost_model)

    @property
    def reward_function(self) -> Reward:
        return _part(self, "reward", self.reward)

    @property
    def referents(self) -> Hashable:
        return type(self.costs), type(self.reward_function)

    @property
    def path_dependent(self) -> bool:
        return self.reward_function.path_dependent

    def wanted(self, market: PyTree, holding: Holding, action: Array) -> Float[Array, " entry"]:
        """The weights that an action orders, projected onto the feasible set."""
        weights = action
        if self.menu:
            weights = self._menu.weights(holding.weights, action, self.signalled(market))
        return self.allow(market, holding, weights)

    def allow(
        self, market: PyTree, holding: Holding, weights: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """The weights that may be ordered and are nearest to the weights given."""
        return self.feasible_at(market).project(weights, holding.weights)

    def trade(
        self, market: PyTree, holding: Holding, wanted: Float[Array, " entry"]
    ) -> tuple[Float[Array, " entry"], Plan | None]:
        """The weights to trade to now for an order, and the plan for later rows.

        Here, an order is traded at once, and the plan is unchanged.
        """
        return wanted, holding.plan

    def target(self, market: PyTree, holding: Holding, action: Array) -> Float[Array, " entry"]:
        """The target weights of an action."""
        return self.trade(market, holding, self.wanted(market, holding, action))[0]

    def intent(self, state: Position, action: Array) -> Float[Array, " entry"]:
        return self.target(state.market, state.holding, action)

    def anchor_weights(self, market: PyTree) -> Float[Array, " asset"] | None:
        """The anchor's weights, from which a policy may depart; None without an anchor."""
        return None

    def view(self, market: PyTree, holding: Holding) -> View:
        """The observation of a market from a holding."""
        choices, anchor = None, self.anchor_weights(market)
        if (menu := self._signal_menu) is not None:
            order = jax.vmap(self.target, (None, None, 0))
            choices = order(market, holding, jnp.arange(menu.actions.n))[:, 1:]
            signalled = self.signalled(market)
            anchor = None if signalled is None else signalled.anchor
        return View(self.features(market), holding.weights[1:], anchor, choices)

    def observe(self, state: Position) -> View:
        return self.view(state.market, state.holding)

    def draw_holding(self, key: PRNGKeyArray) -> Holding:
        return self.hold(self.feasible.draw(key))

    def draw_reachable(self, market: PyTree, key: PRNGKeyArray) -> Holding:
        """A random holding; with a menu of signals, the anchor tilted at random by all signals.

        Such a holding is as near to the anchor as those that a policy reaches, and its returns are
        no noisier.
        """
        menu, signalled = self._signal_menu, self.signalled(market)
        if menu is None or menu.tilts is None or signalled is None:
            return self.draw_holding(key)
        spread_key, key = jax.random.split(key)
        normal = jax.random.normal(key, (signalled.signals.shape[1],))
        tilt = menu.tilts.max() * jax.random.uniform(spread_key) * normal
        weights = menu.tilted(signalled, tilt)
        return self.hold(self.feasible_at(market).project(weights, weights))

    def reference(self, market: PyTree, next_market: PyTree) -> Float[Array, ""] | None:
        """The reward of holding the anchor, if there is one."""
        anchor = self.anchor_weights(market)
        if anchor is None:
            return None
        weights = simplex.with_rest(anchor)
        return self._earn(market, next_market, self.hold(weights), weights)[0]

    def hold(self, weights: Float[Array, " entry"]) -> Holding:
        """A holding of some weights, without a history."""
        return Holding(weights, self.reward_function.init())

    def shift(self, holding: Holding, by: Float[Array, " asset"]) -> Holding:
        """The holding with ``by`` more in each asset, and less in cash."""
        change = jnp.concatenate([-by.sum(keepdims=True), by])
        return holding._replace(weights=holding.weights + change)

    def settle(
        self, market: PyTree, next_market: PyTree, holding: Holding, action: Array
    ) -> tuple[Float[Array, ""], Holding]:
        wanted = self.wanted(market, holding, action)
        target, plan = self.trade(market, holding, wanted)
        return self._earn(market, next_market, holding._replace(plan=plan), target)

    def measure(self, step: Transition) -> Metrics:
        """Log growth of a step, turnover, cost, weight of cash and effective number of assets.

        With an anchor also the distance from it: half the sum of absolute differences in weight.
        """
        market, next_market, holding = step.state.market, step.next_state.market, step.state.holding
        moved, at = self.relatives(market, next_market), self.contexts(market, next_market)
        if at.coming.listed is None and not self._wealth_may_end:
            # What is held next is the target, drifted; a projection takes longer.
            after = step.next_state.holding.weights
            target = grown(after, 1 / self.costs.growth(after, moved.coming, at.coming))
        else:
            target = self.target(market, holding, step.action)
        trade = self._executed(moved, at, holding.weights, target)
        assets = target[1:]
        measured = {
            "growth": jnp.log(trade.growth),
            "turnover": traded(trade.before, trade.after, trade.remainder),
            "cost": trade.cost,
            "cash": target[0],
            "assets": assets.sum() ** 2 / jnp.maximum((assets**2).sum(), 1e-12),
        }
        if (anchor := self.anchor_weights(market)) is not None:
            measured["distance"] = abs(assets - anchor).sum() / 2
        return measured

    def _earn(
        self, market: PyTree, next_market: PyTree, holding: Holding, target: Float[Array, " entry"]
    ) -> tuple[Float[Array, ""], Holding]:
        moved, at = self.relatives(market, next_market), self.contexts(market, next_market)
        trade = self._executed(moved, at, holding.weights, target)
        drifted = self.costs.held(target, moved.coming, at.coming)
        if self._wealth_may_end:
            drifted = jnp.where(trade.growth > RUIN, drifted, jnp.eye(drifted.shape[0])[0])
        outcome = Outcome(trade.growth, trade.cost, trade.after)
        reward, state = self.reward_function(holding.reward, outcome)
        return reward, Holding(drifted, state, self.planned(market, holding.plan))

    @property
    def _wealth_may_end(self) -> bool:
        return self.costs.depends_on_wealth or not self.feasible.long_only

    def _executed(
        self, moved: Relatives, at: Contexts, held: Float[Array, " entry"], target: Array
    ) -> Trade:
        """The trade from the weights held at a decision to its target."""
        costs = self.costs
        before, after = (costs.held(w, moved.waiting, at.waiting) for w in (held, target))
        remainder, paid = costs.trade(before, after, at.trade)
        growth = remainder * (after * costs.growth(after, moved.earning, at.earning)).sum()
        if self._wealth_may_end:
            # An order that is worth nothing is ruin, too: when it is executed, and at the next
            # decision, where weights could not describe it.
            before_trade = [costs.worth(w, moved.waiting, at.waiting) for w in (held, target)]
            worths = jnp.stack([*before_trade, costs.worth(target, moved.coming, at.coming)])
            growth = jnp.where((growth > RUIN) & (worths > 0).all(), growth, RUIN)
        return Trade(before, after, remainder, sum(paid.values()), growth)

    def planned(self, market: PyTree, plan: Plan | None) -> Plan | None:
        """The plan one row after a decision, drifted with prices."""
        return plan


def _part(market: Market, kind: Kind, text: str) -> Any:
    """The part of a market that a setting names, as ``name`` or ``name(setting=value, …)``.

    Settings that it shares with the market have the market's values, unless they are written out.
    """
    name, chosen = settings.called(text)
    part = build(kind, name, chosen)
    fields = {field.name for field in dataclasses.fields(part)} - chosen.keys()
    shared = {name: getattr(market, name) for name in fields if hasattr(market, name)}
    return dataclasses.replace(part, **shared)
