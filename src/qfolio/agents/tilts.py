"""Anchored tilts: a policy that departs from an anchor as far as the evidence carries.

Each asset has a score, linear in its signals and in their products with the state of the market
(Brandt, Santa-Clara & Valkanov 2009). The target is the anchor, tilted by the scores; a learned
share of the way to it is traded, outside a learned band. Everything is trained by the gradient of
net utility through whole paths, as in ``pathwise.py``.

Several members learn side by side, each without some blocks of the data. What a member earns over
the anchor in the blocks that it has not seen is the evidence: the policy, the mean of the members,
is shrunk to the anchor by it, after James & Stein (1961), and stays there without it. The anchor is
kept in a band, or rebalanced at a learned speed as far as there is evidence that it earns more. A
network learns on top of this policy and is followed likewise. docs/algorithms/tilts.md lists
formulas and their sources.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from qfolio.agents.paths import AT_ONCE, Onlooker, Rewards
from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, static
from qfolio.core.market import View
from qfolio.core.mdp import Box, Discrete, ExogenousTask, Metrics, Simplex, Task, Transition
from qfolio.learning import optimizer
from qfolio.learning.evidence import Evidence, blocks_of, left_out
from qfolio.learning.scores import NETWORKS, Attention, Hidden
from qfolio.learning.trading import Trading, ratio

LARGEST = 3.0
"""Inputs are clipped to ± this many standard deviations of the training data."""

EVERY = 4
"""A network learns from every so many of the paths, to save time."""


def inputs_of(
    features: Float[Array, "*batch asset time channel"],
) -> Float[Array, "*batch asset input"]:
    """An asset's inputs: the latest of its features but the first, its return."""
    return jnp.clip(features[..., -1, 1:], -LARGEST, LARGEST)


class Deep(eqx.Module):
    """What the members learn on top of their linear scores; arrays have a leading member axis."""

    network: Hidden | Attention
    trading: Trading

    def scores(
        self, features: Float[Array, "*batch asset time channel"]
    ) -> Float[Array, "member *batch asset"]:
        return jax.vmap(lambda network: network(inputs_of(features)))(self.network)


class Tilt(eqx.Module):
    """What the members learn: scores of assets, and how to trade.

    Every array has a leading member axis, except in ``resting``, which they share.

    The linear scores are s = x·(θ + Θc) with an asset's inputs x and their mean over the assets c,
    the state of the market: features that rank assets have mean 0 and do not enter it.
    """

    linear: Float[Array, "member channel"]  # θ
    interaction: Float[Array, "member channel channel"]  # Θ
    deep: Deep | None
    trading: Trading
    resting: Trading  # of the anchor itself

    def scores(
        self, features: Float[Array, "*batch asset time channel"]
    ) -> Float[Array, "member *batch asset"]:
        """The linear scores."""
        inputs = inputs_of(features)
        # Products for all members at once take half the time of a vmap, which transposes weights.
        context = jnp.einsum("...d,mcd->...mc", inputs.mean(-2), self.interaction)
        return jnp.einsum("...ac,...mc->m...a", inputs, self.linear + context)

    @property
    def squares(self) -> Float[Array, ""]:
        """The sum of squared coefficients."""
        output = None if self.deep is None else self.deep.network.output
        leaves = jax.tree.leaves((self.linear, self.interaction, output))
        return sum((jnp.sum(leaf**2) for leaf in leaves), jnp.array(0.0))


class TiltPolicy(eqx.Module):
    """Maps a view of the market to an order, by the mean scores of the members."""

    members: Tilt
    share: Float[Array, ""]  # of the linear scores that the evidence leaves
    depth: Float[Array, ""]  # share of what a network adds that its evidence leaves
    speed: Float[Array, ""]  # share of the anchor's learned speed that its evidence leaves
    actions: Simplex | Box

    def __call__(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        target = self.target(view)
        return self.trading(view.holding, target, view.anchor)

    def target(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        scores = self.share * self.members.scores(view.features).mean(0)
        if self.members.deep is not None:
            scores += self.depth * self.members.deep.scores(view.features).mean(0)
        return tilted(view.anchor, scores, self.actions)

    @property
    def trading(self) -> Trading:
        """The anchor's, moved by the share towards the linear policy's, then by the depth towards
        the network's."""
        found = self.resting.towards(self.members.trading.mean, self.share)
        deep = self.members.deep
        return found if deep is None else found.towards(deep.trading.mean, self.depth)

    @property
    def resting(self) -> Trading:
        """The anchor's: a band, moved by the speed towards what was learned for it."""
        return Trading.resting().towards(self.members.resting, self.speed)


def tilted(
    anchor: Float[Array, "*batch asset"],
    scores: Float[Array, "*batch asset"],
    actions: Simplex | Box,
) -> Float[Array, "*batch entry"]:
    """The weights nearest to the anchor plus scores over the number of assets, cash first.

    Their sum is the anchor's, or as much of it as caps allow. None is negative, unless actions are
    a box: the task then projects them onto what its mandate allows. Weights that are exactly 0 in
    the anchor cannot be traded.
    """
    total = anchor.sum(-1, keepdims=True)
    open_to, count = anchor > 0, (anchor > 0).sum(-1, keepdims=True)
    share = ratio(total, count)
    if isinstance(actions, Box):
        mean = ratio(jnp.where(open_to, scores, 0.0).sum(-1, keepdims=True), count)
        wanted = jnp.where(open_to, anchor + share * (scores - mean), 0.0)
        return jnp.concatenate([1 - total, wanted], -1)
    wanted = anchor + share * scores
    if actions.cap == 1:
        return jnp.concatenate([1 - total, _nearest(wanted, open_to, total)], -1)
    cash = 1 - jnp.minimum(total, actions.cap * count)
    caps = jnp.concatenate([cash, jnp.where(open_to, actions.cap, 0.0)], -1)
    more = wanted.max(-1, keepdims=True) + 1  # so much that cash is at its cap
    return simplex.project(jnp.concatenate([more, wanted], -1), caps)


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
    evidence_of_depth: Evidence  # that a network earns more than the linear policy
    evidence_of_speed: Evidence  # that the anchor earns more at its learned speed than in a band


class Tilts(Onlooker):
    """Gradient ascent on net utility, with a penalty on tracking error and on tilts."""

    network: str = static("hidden")  # on top of linear scores: hidden or attention; linear: none
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
        require(self, "tracking_aversion", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")

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
        if not channels:
            raise QfolioError(
                f"tilts weighs signals, and {task.name} has none; set some, such as "
                "signals=momentum:1y-1m,volatility:1m."
            )

        linear = jnp.zeros((self.members, channels))
        square = jnp.zeros((self.members, channels, channels))
        resting = Trading.start()
        trading = jax.tree.map(lambda x: jnp.full(self.members, x), resting)
        nothing, deep, evidence = jnp.array(0.0), None, Evidence.none(self.blocks)
        if self.network in NETWORKS:
            make = lambda key: NETWORKS[self.network](channels, self.units, key)  # noqa: E731
            networks = jax.vmap(make)(jax.random.split(key, self.members))
            deep = Deep(networks, trading)
        members = Tilt(linear, square, deep, trading, resting)
        policy = TiltPolicy(members, nothing, nothing, nothing, actions)
        return TiltsState(policy, optimizer.begin(members), evidence, evidence, evidence)

    def monitor(self, state: TiltsState) -> Metrics:
        found = {"evidence": state.evidence.t, "share": state.policy.share}
        if state.policy.members.deep is not None:
            found |= {"evidence_of_depth": state.evidence_of_depth.t, "depth": state.policy.depth}
        found |= {"evidence_of_speed": state.evidence_of_speed.t, "speed": state.policy.speed}
        return found | state.policy.trading.described

    def relearned(self, state: TiltsState) -> int:
        return int(state.optimizer.count.max())

    def learn(
        self, task: Task, state: TiltsState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[TiltsState, Metrics]:
        assert isinstance(task, ExogenousTask)
        block = blocks_of(task, rollout, self.blocks, EVERY)
        later = jnp.arange(self.rollout_length)[:, None] >= self.head
        counted = jnp.broadcast_to(later, block.shape)
        left = left_out(block, self.members)
        seen, unseen = counted & ~left, counted & left
        some = lambda x: x[:, ::EVERY]  # noqa: E731 (of the paths)

        def utility(rewards: Array, active: Array, seen: Array) -> Float[Array, " member"]:
            steps = jnp.maximum(seen.sum((1, 2)), 1)
            mean = lambda x: (seen * x).sum((1, 2)) / steps  # noqa: E731
            variance = mean(active**2) - mean(active) ** 2
            return mean(rewards) - self.tracking_aversion / 2 * variance

        one = lambda trading: (jax.tree.map(lambda x: x[None], trading),)  # noqa: E731
        (kept,) = self._paths(task, rollout, one(Trading.resting()), (None,))

        def loss(members: Tilt) -> tuple[Array, tuple[Array, list[Array]]]:
            scores, share = self._scores(members, task, rollout), state.policy.share
            (rested,) = self._paths(task, rollout, one(members.resting), (None,))
            (rewards,) = self._paths(task, rollout, (members.trading,), (scores,))
            of_speed = lax.stop_gradient(rested) - kept
            anchored = kept + state.policy.speed * of_speed
            active = [rewards - anchored, of_speed]
            total = utility(rewards, active[0], seen)
            if members.deep is not None:
                # On top of the policy as far as it is followed, and from some of the paths.
                fewer, anchored = jax.tree.map(some, rollout), jax.vmap(some)(anchored)
                base = lax.stop_gradient(share * jax.vmap(some)(scores))
                higher = base + self._scores(members.deep, task, fewer)
                followed = lax.stop_gradient(state.policy.resting.towards(members.trading, share))
                trades = members.deep.trading, followed
                rewards, without = self._paths(task, fewer, trades, (higher, base))
                active.append(rewards - without)
                total += utility(rewards, rewards - anchored, jax.vmap(some)(seen))
            penalty = self.ridge / task.moves * members.squares
            # No other weight depends on what the resting anchor earns: its scale does not matter.
            gained = total.sum() + (counted * rested).sum() / counted.sum()
            return penalty - gained, (total.mean(), active)

        gradient, (gained, active) = jax.grad(loss, has_aux=True)(state.policy.members)
        rate = self._schedule(state.optimizer.count + 1)
        members, adam = optimizer.descend(state.policy.members, gradient, state.optimizer, rate)
        evidence = state.evidence.add(block, active[0], unseen, self.memory)
        of_depth = state.evidence_of_depth
        if members.deep is not None:
            of_depth = of_depth.add(some(block), active[2], jax.vmap(some)(unseen), self.memory)
        # In sample: two numbers hardly overfit.
        of_speed = state.evidence_of_speed.add(block, active[1], counted[None], self.memory)
        found = evidence, of_depth, of_speed
        share, depth, speed = (each.share(self.threshold) for each in found)
        policy = TiltPolicy(members, share, depth, speed, state.policy.actions)
        return TiltsState(policy, adam, *found), {"loss": -gained}

    def _scores(
        self, members: Tilt | Deep, task: ExogenousTask, rollout: Transition
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
        trades: tuple[Trading, ...],
        scores: tuple[Float[Array, "member time path asset"] | None, ...],
    ) -> tuple[Float[Array, "member time path"], ...]:
        """Rewards of the members along the rollout's market, by scores; None follows the anchor.

        Each begins at its own targets.
        """
        actions = task.actions
        assert not isinstance(actions, Discrete)

        def targets(view: View, scores: tuple[Array | None, ...]) -> tuple[Array, ...]:
            anchor = view.anchor
            assert anchor is not None
            whole = simplex.with_rest(anchor)
            return tuple(whole if x is None else tilted(anchor, x, actions) for x in scores)

        def follow(trades: tuple[Trading, ...], scores: tuple[Array | None, ...]) -> Rewards:
            return self._followed(task, rollout, trades, targets, scores)[0]

        return jax.vmap(follow)(trades, scores)
