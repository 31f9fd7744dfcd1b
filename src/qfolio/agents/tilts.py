"""Anchored tilts: a policy that departs from an anchor as far as the evidence carries.

Each asset has a score, linear in its signals and in their products with the state of the market
(Brandt, Santa-Clara & Valkanov 2009). The target is the anchor, tilted by the scores; a learned
share of the way to it is traded, outside a learned band. Everything is trained by the gradient of
net utility through whole paths, as in ``pathwise.py``.

Several members learn side by side, each without some blocks of the data. What a member earns over
the anchor in the blocks that it has not seen is the evidence: the policy, the mean of the members,
is shrunk to the anchor by it, after James & Stein (1961), and stays there without it.
docs/algorithms/tilts.md lists formulas and their sources.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from qfolio.agents.paths import AT_ONCE, Onlooker
from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, require_counts, static
from qfolio.core.market import View
from qfolio.core.mdp import Box, Discrete, ExogenousTask, Metrics, Simplex, Task, Transition
from qfolio.learning import optimizer
from qfolio.learning.evidence import Evidence, blocks_of, left_out, require_members
from qfolio.learning.scores import NETWORKS, Attention, Hidden
from qfolio.learning.trading import Trading, ratio

LARGEST = 3.0
"""Inputs are clipped to ± this many standard deviations of the training data."""


class Tilt(eqx.Module):
    """What the members learn: scores of assets, and how to trade.

    Every array has a leading member axis.

    The scores are s = x·(θ + Θc) with an asset's inputs x, the latest of its features but the first
    (its return), and their mean over the assets c, the state of the market: features that rank
    assets have mean 0 and do not enter it.
    """

    linear: Float[Array, "member channel"]  # θ
    interaction: Float[Array, "member channel channel"]  # Θ
    network: Hidden | Attention | None  # added to the linear scores
    trading: Trading

    def scores(
        self, features: Float[Array, "*batch asset time channel"]
    ) -> Float[Array, "member *batch asset"]:
        inputs = jnp.clip(features[..., -1, 1:], -LARGEST, LARGEST)
        # Products for all members at once take half the time of a vmap, which transposes weights.
        context = jnp.einsum("...d,mcd->...mc", inputs.mean(-2), self.interaction)
        found = jnp.einsum("...ac,...mc->m...a", inputs, self.linear + context)
        if self.network is None:
            return found
        return found + jax.vmap(lambda network: network(inputs))(self.network)

    @property
    def squares(self) -> Float[Array, ""]:
        """The sum of squared coefficients."""
        leaves = jax.tree.leaves((self.linear, self.interaction, self.network))
        return sum((jnp.sum(leaf**2) for leaf in leaves), jnp.array(0.0))


class TiltPolicy(eqx.Module):
    """Maps a view of the market to an order, by the mean scores of the members."""

    members: Tilt
    share: Float[Array, ""]  # of the scores that the evidence leaves
    actions: Simplex | Box

    def __call__(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        target = self.target(view)
        return self.trading(view.holding, target, view.anchor)

    def target(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        scores = self.members.scores(view.features).mean(0)
        return tilted(view.anchor, self.share * scores, self.actions)

    @property
    def trading(self) -> Trading:
        return jax.tree.map(lambda x: x.mean(0), self.members.trading)


def tilted(
    anchor: Float[Array, "*batch asset"],
    scores: Float[Array, "*batch asset"],
    actions: Simplex | Box,
) -> Float[Array, "*batch entry"]:
    """The weights nearest to the anchor plus scores over the number of assets, cash first.

    Their sum is the anchor's. None is negative, unless actions are a box: the task then projects
    them onto what its mandate allows. Weights that are exactly 0 in the anchor cannot be traded.
    """
    total = anchor.sum(-1, keepdims=True)
    open_to, count = anchor > 0, (anchor > 0).sum(-1, keepdims=True)
    share = ratio(total, count)
    if isinstance(actions, Box):
        mean = ratio(jnp.where(open_to, scores, 0.0).sum(-1, keepdims=True), count)
        wanted = jnp.where(open_to, anchor + share * (scores - mean), 0.0)
        return jnp.concatenate([1 - total, wanted], -1)
    wanted = _nearest(anchor + share * scores, open_to, total)
    target = jnp.concatenate([1 - total, wanted], -1)
    return target if actions.cap == 1 else simplex.project(target, jnp.asarray(actions.caps))


def _nearest(
    wanted: Float[Array, "*batch asset"],
    open_to: Bool[Array, "*batch asset"],
    total: Float[Array, "*batch 1"],
) -> Float[Array, "*batch asset"]:
    """The weights nearest to those wanted that are not negative and have a given sum.

    They are what exceeds a level, which rises as assets below it drop out (Michelot 1986).
    """

    def level(above: Array, wanted: Array, total: Array) -> Array:
        excess = jnp.where(above, wanted, 0.0).sum(-1, keepdims=True) - total
        return ratio(excess, above.sum(-1, keepdims=True))

    fixed, of = lax.stop_gradient((wanted, total))

    def fewer(found: tuple[Array, Array]) -> tuple[Array, Array]:
        above, _ = found
        left = above & (fixed > level(above, fixed, of))
        return left, (left != above).any()

    # Which assets are above has no gradient; the level that follows from them has one.
    above, _ = lax.while_loop(lambda found: found[1], fewer, (open_to, jnp.array(True)))
    return jnp.where(above, wanted - level(above, wanted, total), 0.0)


class TiltsState(eqx.Module):
    """The state of a Tilts agent."""

    policy: TiltPolicy
    optimizer: optimizer.Optimizer
    evidence: Evidence


class Tilts(Onlooker):
    """Gradient ascent on net utility, with a penalty on tracking error and on tilts."""

    network: str = static("linear")  # linear scores, or hidden or attention beside them
    units: int = static(8)  # units of such a network
    members: int = static(4)  # members; each leaves out some blocks of the data
    blocks: int = static(32)  # equal blocks that the data are cut into
    num_envs: int = static(24)  # paths in a batch
    rollout_length: int = static(84)  # steps of a path
    head: int = static(21)  # first steps of these, which only lead to a holding
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    learning_rate: float = number(0.1)  # step size at the start
    learning_rate_final: float = number(0.0)  # share of learning_rate at the end of its cosine
    learning_rate_steps: float = number(80.0)  # gradient steps of that cosine
    tracking_aversion: float = number(10.0)  # aversion to the variance of rewards over the anchor's
    ridge: float = number(0.3)  # penalty on squared coefficients, per move of the data
    threshold: float = number(2.0)  # t-statistic up to which the policy stays at the anchor
    memory: float = number(0.9)  # share of the evidence that a gradient step keeps

    def __check_init__(self) -> None:
        kinds = ", ".join(("linear", *NETWORKS))
        require(self, "network", lambda x: x in ("linear", *NETWORKS), f"one of {kinds}")
        require_counts(self, "blocks num_envs units")
        require_members(self.members, self.blocks)
        require_counts(self, "rollout_length", 2)
        require(self, "head", lambda x: 1 <= x < self.rollout_length, "at least 1 and below "
                f"rollout_length, {self.rollout_length}")  # fmt: skip
        require_counts(self, "episode_steps", 0)
        require(self, "tracking_aversion ridge", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "threshold", lambda x: 0 <= x <= 1e3, "from 0 to 1,000")
        require(self, "memory", lambda x: 0 <= x < 1, "at least 0 and below 1")
        self._schedule.check()

    def init(self, task: Task, key: PRNGKeyArray) -> TiltsState:
        view = task.observe(task.reset(key))
        if not isinstance(task, ExogenousTask) or getattr(view, "anchor", None) is None:
            raise QfolioError(
                f"tilts departs from an anchor, and {task.name} has none; train it on a portfolio, "
                "with a task setting such as anchor=equal-weight."
            )
        actions = task.actions
        if isinstance(actions, Discrete):
            raise QfolioError("tilts gives weights; leave menu empty.")
        self._require_whole(task)
        channels = view.features.shape[-1] - 1

        kind, network = NETWORKS.get(self.network), None
        if kind is not None:
            make = lambda key: kind(channels, self.units, key)  # noqa: E731
            network = jax.vmap(make)(jax.random.split(key, self.members))
        linear = jnp.zeros((self.members, channels))
        square = jnp.zeros((self.members, channels, channels))
        trading = jax.tree.map(lambda x: jnp.full(self.members, x), Trading.start(0.3))
        members = Tilt(linear, square, network, trading)
        policy = TiltPolicy(members, jnp.array(0.0), actions)
        return TiltsState(policy, optimizer.begin(members), Evidence.none(self.blocks))

    def monitor(self, state: TiltsState) -> Metrics:
        found = {"evidence": state.evidence.t, "share": state.policy.share}
        return found | state.policy.trading.described

    def weights(self, state: TiltsState) -> TiltPolicy:
        return state.policy

    def policy(self, weights: TiltPolicy, observation: View) -> Float[Array, "batch entry"]:
        return weights(observation)

    def learn(
        self, task: Task, state: TiltsState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[TiltsState, Metrics]:
        assert isinstance(task, ExogenousTask)
        block = blocks_of(task, rollout, self.blocks)
        counted = jnp.arange(self.rollout_length)[:, None] >= self.head
        left = left_out(block, self.members)

        def loss(members: Tilt) -> tuple[Array, tuple[Array, Array]]:
            follow = jax.vmap(partial(self._paths, task, rollout))
            rewards, anchored = follow(members.trading, self._scores(members, task, rollout))
            active = rewards - anchored
            seen = counted & ~left
            steps = jnp.maximum(seen.sum((1, 2)), 1)
            mean = lambda x: (seen * x).sum((1, 2)) / steps  # noqa: E731
            variance = mean(active**2) - mean(active) ** 2
            utility = mean(rewards) - self.tracking_aversion / 2 * variance
            penalty = self.ridge / task.moves * members.squares
            return penalty - utility.sum(), (utility.mean(), active)

        gradient, (utility, active) = jax.grad(loss, has_aux=True)(state.policy.members)
        rate = self._schedule(state.optimizer.count + 1)
        members, adam = optimizer.descend(state.policy.members, gradient, state.optimizer, rate)
        evidence = state.evidence.add(block, active, counted & left, self.memory)
        policy = TiltPolicy(members, evidence.share(self.threshold), state.policy.actions)
        return TiltsState(policy, adam, evidence), {"loss": -utility}

    def _scores(
        self, members: Tilt, task: ExogenousTask, rollout: Transition
    ) -> Float[Array, "member time path asset"]:
        """Scores at each step of a rollout."""
        features = rollout.observation.features
        if features.size <= AT_ONCE:
            return members.scores(features)

        def step(state: PyTree) -> Float[Array, "member path asset"]:
            return members.scores(jax.vmap(task.observe)(state).features)

        return jnp.moveaxis(lax.map(jax.checkpoint(step), rollout.state), 0, 1)

    def _paths(
        self,
        task: ExogenousTask,
        rollout: Transition,
        trading: Trading,
        scores: Float[Array, "time path asset"],
    ) -> tuple[Float[Array, "time path"], Float[Array, "time path"]]:
        """Rewards of a member along the rollout's market, and of the anchor.

        Both begin at their own targets. The anchor is followed at the member's rate and band.
        """
        actions = task.actions
        assert not isinstance(actions, Discrete)

        def targets(view: View, scores: Array) -> tuple[Array, Array]:
            assert view.anchor is not None
            return tilted(view.anchor, scores, actions), simplex.with_rest(view.anchor)

        trades = trading, lax.stop_gradient(trading)
        (rewards, anchored), _ = self._followed(task, rollout, trades, targets, scores)
        return rewards, anchored
