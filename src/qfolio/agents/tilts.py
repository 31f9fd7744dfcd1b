"""Anchored tilts: a policy that departs from an anchor as far as the evidence carries.

Each asset has a score, linear in its signals and in their products with the state of the market
(Brandt, Santa-Clara & Valkanov 2009). The target is the anchor, tilted by the scores; a learned
share of the way to it is traded, outside a learned band. Everything is trained by the gradient of
net utility through whole paths, as in ``pathwise.py``.

Several members learn side by side, each without some blocks of the data. What a member earns over
the anchor in the blocks that it has not seen is the evidence: the policy, the mean of the members,
is shrunk to the anchor by it, after James & Stein (1961), and stays there without it.
docs/tilts.md lists formulas and their sources.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, static
from qfolio.core.market import View
from qfolio.core.mdp import Agent, ExogenousTask, Metrics, Position, Simplex, Task, Transition
from qfolio.learning import optimizer
from qfolio.learning.optimizer import CosineSchedule
from qfolio.learning.scores import NETWORKS, Attention, Hidden

LARGEST = 3.0
"""Inputs are clipped to ± this many standard deviations of the training data."""


class Trading(eqx.Module):
    """How to trade towards a target."""

    rate: Float[Array, ""]  # logit of the share of the way that is traded at a step
    band: Float[Array, ""]  # log of the deviation that is not traded, in equal weights

    @staticmethod
    def start() -> "Trading":
        """30 % of the way at each step, outside a band of 5 % of an equal weight."""
        return Trading(jnp.array(math.log(0.3 / 0.7)), jnp.array(math.log(0.05)))

    def __call__(
        self,
        held: Float[Array, "*batch asset"],
        target: Float[Array, "*batch entry"],
        anchor: Float[Array, "*batch asset"],
    ) -> Float[Array, "*batch entry"]:
        """The order: part of the way from the weights held to the target.

        What an asset is off its target beyond the band is traded at the rate, as far as purchases
        and sales pay for each other. Cash beyond the target's is invested at once.
        """
        gap = target[..., 1:] - held
        band = jnp.exp(self.band) * _equal(anchor)
        bought, sold = jnp.maximum(gap - band, 0.0), jnp.maximum(-gap - band, 0.0)
        buying, selling = bought.sum(-1, keepdims=True), sold.sum(-1, keepdims=True)
        matched = jnp.where(buying < selling, buying, selling)
        trade = bought * _ratio(matched, buying) - sold * _ratio(matched, selling)
        idle = 1 - held.sum(-1, keepdims=True) - target[..., :1]
        source = jnp.where(idle > 0, target[..., 1:], held)
        invested = idle * source * _ratio(1.0, source.sum(-1, keepdims=True))
        assets = held + jax.nn.sigmoid(self.rate) * trade + invested
        return jnp.concatenate([1 - assets.sum(-1, keepdims=True), assets], -1)


class Tilt(eqx.Module):
    """What a member learns: scores of assets, and how to trade.

    The scores are s = x·(θ + Θc) with an asset's inputs x, the latest of its features but the first
    (its return), and their mean over the assets c, the state of the market: features that rank
    assets have mean 0 and do not enter it.
    """

    linear: Float[Array, " channel"]  # θ
    interaction: Float[Array, "channel channel"]  # Θ
    network: Hidden | Attention | None  # added to the linear scores
    trading: Trading

    def scores(
        self, features: Float[Array, "*batch asset time channel"]
    ) -> Float[Array, "*batch asset"]:
        inputs = jnp.clip(features[..., -1, 1:], -LARGEST, LARGEST)
        weights = self.linear + inputs.mean(-2) @ self.interaction.T
        found = jnp.einsum("...ac,...c->...a", inputs, weights)
        return found if self.network is None else found + self.network(inputs)

    @property
    def squares(self) -> Float[Array, ""]:
        """The sum of squared coefficients."""
        leaves = jax.tree.leaves((self.linear, self.interaction, self.network))
        return sum((jnp.sum(leaf**2) for leaf in leaves), jnp.array(0.0))


class TiltPolicy(eqx.Module):
    """Maps a view of the market to an order, by the mean scores of the members."""

    members: Tilt  # with a leading member axis
    share: Float[Array, ""]  # of the scores that the evidence leaves
    actions: Simplex

    def __call__(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        target = self.target(view)
        return self.trading(view.holding, target, view.anchor)

    def target(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        scores = jax.vmap(lambda member: member.scores(view.features))(self.members).mean(0)
        return tilted(view.anchor, self.share * scores, self.actions)

    @property
    def trading(self) -> Trading:
        return jax.tree.map(lambda x: x.mean(0), self.members.trading)


def tilted(
    anchor: Float[Array, "*batch asset"], scores: Float[Array, "*batch asset"], actions: Simplex
) -> Float[Array, "*batch entry"]:
    """The anchor plus softmax(scores) less equal weights, cash first.

    A weight of 0 can grow; negative weights are set to 0, and the sum is kept (Brandt, Santa-Clara
    & Valkanov 2009, section 1.3). Weights that are exactly 0 in the anchor cannot be traded.
    """
    total = anchor.sum(-1, keepdims=True)
    wanted = anchor + total * jax.nn.softmax(scores, where=anchor > 0) - _equal(anchor)
    wanted = jnp.maximum(wanted, 0.0)
    wanted = total * wanted / wanted.sum(-1, keepdims=True)
    target = jnp.concatenate([1 - total, wanted], -1)
    return target if actions.cap == 1 else simplex.project(target, jnp.asarray(actions.caps))


class Evidence(NamedTuple):
    """What the members earned over the anchor in the blocks that they have not seen."""

    steps: Float[Array, " block"]  # earlier ones count less
    total: Float[Array, " block"]  # of rewards over the anchor's
    square: Float[Array, " block"]

    @staticmethod
    def none(blocks: int) -> "Evidence":
        return Evidence(*jnp.zeros((3, blocks)))

    def add(
        self,
        block: Int[Array, "time path"],
        active: Float[Array, "time path"],
        counted: Float[Array, "time path"],
        memory: Array | float,
    ) -> "Evidence":
        """With the steps of a rollout, counted by 1 or 0; all else fades."""
        new = (counted, counted * active, counted * active**2)
        where = block.ravel()
        return Evidence(
            *(memory * old.at[where].add(x.ravel()) for old, x in zip(self, new, strict=True))
        )

    @property
    def t(self) -> Float[Array, ""]:
        """The t-statistic over blocks of mean over deviation: each weighs the same, calm or not."""
        known = self.steps > 1
        mean = _ratio(self.total, self.steps)
        deviation = jnp.sqrt(jnp.maximum(_ratio(self.square, self.steps) - mean**2, 0.0))
        ratio, blocks = _ratio(mean, deviation), known.sum()
        center = _ratio((known * ratio).sum(), blocks)
        spread = _ratio((known * (ratio - center) ** 2).sum(), jnp.maximum(blocks - 1.0, 0.0))
        return _ratio(center * jnp.sqrt(1.0 * blocks), jnp.sqrt(spread))


class TiltsState(eqx.Module):
    """The state of a Tilts agent."""

    policy: TiltPolicy
    optimizer: optimizer.Optimizer
    evidence: Evidence


class Tilts(Agent):
    """Gradient ascent on net utility, with a penalty on tracking error and on tilts."""

    network: str = static("linear")  # or hidden or attention, which are added to linear scores
    units: int = static(8)  # of such a network
    members: int = static(4)  # each learns without every so-many-th block of the data
    blocks: int = static(32)  # of the data, of equal length
    num_envs: int = static(32)  # paths in a batch
    rollout_length: int = static(84)  # steps of a path
    head: int = static(21)  # of these, first steps that only lead to a holding
    episode_steps: int = static(0)  # training episodes are cut here; 0: the task's horizon
    learning_rate: float = number(0.1)
    learning_rate_final: float = number(0.0)  # share of it that remains at the end of the cosine
    learning_rate_steps: float = number(80.0)  # gradient steps of the cosine
    tracking_aversion: float = number(10.0)  # of the variance of rewards over the anchor's
    ridge: float = number(0.3)  # on squared coefficients, divided by the moves of the data
    threshold: float = number(2.0)  # t-statistic up to which the policy stays at the anchor
    memory: float = number(0.9)  # share of the evidence that a gradient step keeps

    def __check_init__(self) -> None:
        kinds = ", ".join(("linear", *NETWORKS))
        require(self, "network", lambda x: x in ("linear", *NETWORKS), f"one of {kinds}")
        require(self, "members blocks num_envs units", lambda x: 1 <= x < 2**31, "at least 1")
        require(self, "rollout_length", lambda x: x >= 2, "at least 2")
        require(self, "head", lambda x: 1 <= x < self.rollout_length, "at least 1 and below "
                f"rollout_length, {self.rollout_length}")  # fmt: skip
        require(self, "episode_steps", lambda x: 0 <= x < 2**31, "at least 0")
        require(self, "tracking_aversion ridge", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "threshold", lambda x: 0 <= x <= 1e3, "from 0 to 1,000")
        require(self, "memory", lambda x: 0 <= x < 1, "at least 0 and below 1")
        self._schedule.check()
        if self.members > self.blocks:
            raise QfolioError(
                f"members is {self.members}; with {self.blocks} blocks it can be at most "
                f"{self.blocks}."
            )

    @property
    def _schedule(self) -> CosineSchedule:
        return CosineSchedule(
            self.learning_rate, self.learning_rate_final, self.learning_rate_steps
        )

    @property
    def discount(self) -> None:
        return None

    @property
    def rollout_steps(self) -> int:
        return self.rollout_length

    def init(self, task: Task, key: PRNGKeyArray) -> TiltsState:
        view = task.observe(task.reset(key))
        if not isinstance(task, ExogenousTask) or getattr(view, "anchor", None) is None:
            raise QfolioError(
                f"tilts departs from an anchor, and {task.name} has none; train it on a portfolio, "
                "with a task setting such as anchor=equal-weight."
            )
        if not isinstance(task.actions, Simplex):
            raise QfolioError("tilts gives weights; leave menu empty.")
        channels, actions = view.features.shape[-1] - 1, task.actions

        def member(key: PRNGKeyArray) -> Tilt:
            kind = NETWORKS.get(self.network)
            network = None if kind is None else kind(channels, self.units, key)
            square = jnp.zeros((channels, channels))
            return Tilt(jnp.zeros(channels), square, network, Trading.start())

        members = jax.vmap(member)(jax.random.split(key, self.members))
        policy = TiltPolicy(members, jnp.array(0.0), actions)
        return TiltsState(policy, optimizer.begin(members), Evidence.none(self.blocks))

    def warm_up(self) -> int:
        return 0

    def monitor(self, state: TiltsState) -> Metrics:
        trading = state.policy.trading
        return {
            "evidence": state.evidence.t,
            "share": state.policy.share,
            "rate": jax.nn.sigmoid(trading.rate),
            "band": jnp.exp(trading.band),
        }

    def weights(self, state: TiltsState) -> TiltPolicy:
        return state.policy

    def _share(self, evidence: Evidence) -> Float[Array, ""]:
        """1 − (threshold/t)², and 0 for t up to the threshold."""
        t = jnp.maximum(evidence.t, 1e-9)
        return jnp.maximum(1 - (self.threshold / t) ** 2, 0.0)

    def policy(self, weights: TiltPolicy, observation: View) -> Float[Array, "batch entry"]:
        return weights(observation)

    def act(
        self, state: TiltsState, observation: View, key: PRNGKeyArray
    ) -> Float[Array, "batch entry"]:
        return state.policy(observation)

    def observe(self, state: TiltsState, rollout: Transition) -> TiltsState:
        return state

    def learn(
        self, task: Task, state: TiltsState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[TiltsState, Metrics]:
        assert isinstance(task, ExogenousTask)
        block = self._blocks(task, rollout)
        counted = jnp.arange(self.rollout_length)[:, None] >= self.head
        left_out = block % self.members == jnp.arange(self.members)[:, None, None]

        def loss(members: Tilt) -> tuple[Array, tuple[Array, Array]]:
            rewards, anchored = jax.vmap(lambda one: self._paths(one, task, rollout))(members)
            active = rewards - anchored
            seen = counted & ~left_out
            steps = jnp.maximum(seen.sum((1, 2)), 1)
            mean = lambda x: (seen * x).sum((1, 2)) / steps  # noqa: E731
            variance = mean(active**2) - mean(active) ** 2
            squares = jax.vmap(lambda one: one.squares)(members)
            utility = mean(rewards) - self.tracking_aversion / 2 * variance
            return (self.ridge / task.moves * squares - utility).sum(), (utility.mean(), active)

        gradient, (utility, active) = jax.grad(loss, has_aux=True)(state.policy.members)
        rate = self._schedule(state.optimizer.count + 1)
        members, adam = optimizer.descend(state.policy.members, gradient, state.optimizer, rate)
        unseen = counted & left_out
        evidence = state.evidence.add(
            block, (unseen * active).sum(0), 1.0 * unseen.any(0), self.memory
        )
        policy = TiltPolicy(members, self._share(evidence), state.policy.actions)
        return TiltsState(policy, adam, evidence), {"loss": -utility}

    def _blocks(self, task: ExogenousTask, rollout: Transition) -> Int[Array, "time path"]:
        """The block of each step; where moves are drawn anew, each path is of one block."""
        place = jax.vmap(jax.vmap(task.place))(rollout.state.market)
        own = jnp.arange(self.num_envs) % self.blocks
        share = jnp.clip(place / task.moves, 0.0, 1.0)
        found = jnp.minimum((self.blocks * share).astype(jnp.int32), self.blocks - 1)
        return jnp.where(jnp.isfinite(task.moves), found, own)

    def _paths(
        self, member: Tilt, task: ExogenousTask, rollout: Transition
    ) -> tuple[Float[Array, "time path"], Float[Array, "time path"]]:
        """Rewards of a member along the rollout's market, and of the anchor.

        Both begin at their own targets. The anchor is followed at the member's rate and band.
        """
        view: View = rollout.observation
        assert view.anchor is not None
        assert isinstance(task.actions, Simplex)
        target = tilted(view.anchor, member.scores(view.features), task.actions)
        anchor = jnp.concatenate([1 - view.anchor.sum(-1, keepdims=True), view.anchor], -1)
        fixed = lax.stop_gradient(member.trading)

        def step(holdings: PyTree, moves: tuple) -> tuple[PyTree, tuple]:
            market, next_market, first, weights, targets = moves

            def settled(trade: Trading, holding: PyTree, target: Array) -> tuple[Array, PyTree]:
                held = jax.vmap(task.observe)(Position(market, holding)).holding
                action = jnp.where(first, target, trade(held, target, weights))
                return jax.vmap(task.settle)(market, next_market, holding, action)

            followers = zip((member.trading, fixed), holdings, targets, strict=True)
            rewards, after = zip(*(settled(*each) for each in followers), strict=True)
            return after, rewards

        start = jax.tree.map(lambda x: x[0], rollout.state.holding)
        first = jnp.arange(self.rollout_length) == 0
        market, next_market = rollout.state.market, rollout.next_state.market
        moves = (market, next_market, first, view.anchor, (target, anchor))
        _, (rewards, anchored) = lax.scan(jax.checkpoint(step), (start, start), moves)
        return rewards, anchored


def _equal(anchor: Float[Array, "*batch asset"]) -> Float[Array, "*batch asset"]:
    """The anchor's sum, in equal parts over the assets that can be traded."""
    open_to = anchor > 0
    share = anchor.sum(-1, keepdims=True) / open_to.sum(-1, keepdims=True)
    return jnp.where(open_to, share, 0.0)


def _ratio(part: Array | float, whole: Array) -> Array:
    """The ratio, 0 for a whole of 0."""
    return jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), 0.0)
