"""Learned minimum variance and learned mean-variance: portfolios that are trained end to end.

The policy estimates a covariance from its window of returns (``learning/covariance.py``), takes the
best weights for it (``core/quadratic.py``), and trades a share of the way there, outside a band.
All that it learns is trained together, by the gradient of realized variance and costs through whole
paths, as in ``pathwise.py``.

With ``returns``, several members learn which returns to expect, each without some blocks of the
data. As in ``tilts.py``, the evidence is what a member earns over the minimum-variance policy in
blocks that it has not seen; without evidence, the policy is that of minimum variance.
docs/algorithms/mean_variance.md lists formulas and their sources.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.agents.paths import Onlooker
from qfolio.core import quadratic
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, static
from qfolio.core.market import View
from qfolio.core.mdp import ExogenousTask, Metrics, Simplex, Task, Transition
from qfolio.learning import optimizer
from qfolio.learning.covariance import Covariance, Means
from qfolio.learning.evidence import Evidence, blocks_of, left_out
from qfolio.learning.trading import Trading, ratio


class Member(eqx.Module):
    """What a member learns: returns to expect, and how to trade on them."""

    means: Means
    trading: Trading


class Learned(eqx.Module):
    """All that is trained."""

    covariance: Covariance
    trading: Trading  # towards the minimum variance
    members: Member | None  # with a leading member axis; None if no returns are expected

    def sigma(self, view: View) -> Float[Array, "*batch asset asset"]:
        """The covariance estimated from a view, in units of the mean variance."""
        assert view.anchor is not None
        return self.covariance(view.features[..., 0], view.anchor > 0)


class Efficient(eqx.Module):
    """Maps a view of the market to an order towards the mean-variance optimal weights."""

    learned: Learned
    share: Float[Array, ""]  # share of the expected returns that the evidence leaves
    actions: Simplex

    def __call__(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        return self.trading(view.holding, self.target(view), view.anchor)

    def target(self, view: View) -> Float[Array, "*batch entry"]:
        """The best weights for the estimates, cash first."""
        members, gain = self.learned.members, None
        if members is not None:
            gain = self.share * jax.vmap(lambda one: expected(view, one.means))(members).mean(0)
        return best(view, self.learned.sigma(view), gain, self.actions)

    @property
    def trading(self) -> Trading:
        """How to trade: as for minimum variance, moved by the share towards the members' mean."""
        least, members = self.learned.trading, self.learned.members
        return least if members is None else least.towards(members.trading.mean, self.share)


def expected(view: View, means: Means) -> Float[Array, "*batch asset"]:
    """Expected returns in the units of ``quadratic.best``."""
    assert view.anchor is not None
    open_to = view.anchor > 0
    return means(view.features[..., 0], open_to) / open_to.sum(-1, keepdims=True)


def best(
    view: View,
    sigma: Float[Array, "*batch asset asset"],
    gain: Float[Array, "*batch asset"] | None,
    actions: Simplex,
    near: Float[Array, "*batch entry"] | None = None,
) -> Float[Array, "*batch entry"]:
    """The best weights, cash first; as much is invested as the anchor invests.

    near: the best weights for the same covariance and another gain, which save time.
    """
    assert view.anchor is not None
    total = view.anchor.sum(-1, keepdims=True)
    gain = jnp.zeros_like(view.anchor) if gain is None else gain
    start = None if near is None else near[..., 1:] / total
    # Caps are of weights, and what is found here are shares of what is invested.
    cap = 1.0 if actions.cap == 1 else jnp.minimum(ratio(actions.cap, total), 1.0)
    wanted = quadratic.best(sigma, gain, view.anchor > 0, cap, start)
    return jnp.concatenate([1 - total, total * wanted], -1)


class MeanVarianceState(eqx.Module):
    """The state of a MeanVariance agent."""

    policy: Efficient
    start: Learned  # where training began, to which a penalty pulls
    optimizer: optimizer.Optimizer
    evidence: Evidence


class MeanVariance(Onlooker):
    """Gradient ascent on mean return less costs and half the risk aversion times variance."""

    returns: bool = static(True)  # learn expected returns, too; false: minimum variance
    members: int = static(4)  # members; each leaves out some blocks of the data
    units: int = static(8)  # units of the network that cleans eigenvalues
    blocks: int = static(32)  # equal blocks that the data are cut into
    num_envs: int = static(8)  # paths in a batch
    rollout_length: int = static(63)  # steps of a path
    head: int = static(21)  # first steps of these, which build a holding and do not count
    every: int = static(7)  # steps between covariance estimates in training
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    learning_rate: float = number(0.05)  # step size at the start
    learning_rate_final: float = number(0.0)  # share of learning_rate at the end of its cosine
    learning_rate_steps: float = number(80.0)  # gradient steps of that cosine
    risk_aversion: float = number(10.0)  # weight of half the variance against returns and costs
    ridge: float = number(3.0)  # penalty on squared changes of parameters, per move of the data
    threshold: float = number(2.0)  # t-statistic up to which no returns are expected
    memory: float = number(0.9)  # share of the evidence that a gradient step keeps

    def __check_init__(self) -> None:
        require(self, "every", lambda x: x >= 1 and self.rollout_length % x == 0, "a divisor of "
                f"rollout_length, {self.rollout_length}")  # fmt: skip
        require(self, "risk_aversion", lambda x: 0 < x <= 1e9, "above 0 and at most 10⁹")

    def init(self, task: Task, key: PRNGKeyArray) -> MeanVarianceState:
        view = task.observe(task.reset(key))
        if not isinstance(task, ExogenousTask) or getattr(view, "anchor", None) is None:
            raise QfolioError(
                "A learned minimum variance, or mean and variance, is for a portfolio with an "
                f"anchor, and {task.name} has none; train it on a portfolio, with the task setting "
                "anchor=equal-weight."
            )
        if not isinstance(task.actions, Simplex):
            raise QfolioError(
                "A learned minimum variance, or mean and variance, gives weights that are not "
                "negative; leave menu empty, and use another agent where a mandate allows debts."
            )
        self._require_whole(task)
        each = Member(Means(), Trading.start(0.1))
        members = jax.tree.map(lambda x: jnp.stack([x] * self.members), each)
        learned = Learned(
            Covariance(self.units, key), Trading.start(0.1), members if self.returns else None
        )
        policy = Efficient(learned, jnp.array(0.0), task.actions)
        return MeanVarianceState(
            policy, learned, optimizer.begin(learned), Evidence.none(self.blocks)
        )

    def monitor(self, state: MeanVarianceState) -> Metrics:
        policy, learned = state.policy, state.policy.learned
        found = learned.covariance.described | policy.trading.described
        if learned.members is None:
            return found
        means = jax.tree.map(lambda x: x.mean(0), learned.members.means)
        return {
            "evidence": state.evidence.t,
            "share": policy.share,
            **means.described,
            **found,
        }

    def relearned(self, state: MeanVarianceState) -> int:
        return int(state.optimizer.count.max()) if self.returns else 0

    def learn(
        self, task: Task, state: MeanVarianceState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[MeanVarianceState, Metrics]:
        assert isinstance(task, ExogenousTask)
        view: View = rollout.observation
        actions = state.policy.actions
        some = jax.tree.map(lambda x: x[:: self.every], view)
        block = blocks_of(task, rollout, self.blocks)
        counted = jnp.arange(self.rollout_length)[:, None] >= self.head
        left = left_out(block, self.members)

        def loss(learned: Learned) -> tuple[Array, tuple[Array, Array | None]]:
            # Covariances change slowly, so each estimate serves several steps.
            sigma = learned.sigma(some)
            held = lambda x: jnp.repeat(x, self.every, 0)  # noqa: E731
            least = held(best(some, sigma, None, actions))
            net, gross = self._path(task, rollout, learned.trading, least)
            mean, variance = _moments(counted, gross)
            cost = mean - _moments(counted, net)[0]
            # Relative to the variance, so that tables of any volatility are learned alike.
            unit = lax.stop_gradient(variance)
            worse = variance / 2 + cost / self.risk_aversion
            off = jax.tree.map(lambda x, y: ((x - y) ** 2).sum(), learned, state.start)
            penalty = self.ridge / task.moves * sum(jax.tree.leaves(off), jnp.array(0.0))
            if learned.members is None:
                return worse / unit + penalty, (variance, None)
            fixed = lax.stop_gradient(held(sigma))
            # An asset that has opened since the estimate has almost no variance in it.
            known = view._replace(anchor=held(some.anchor))

            def on_returns(member: Member) -> Array:
                gain = expected(known, member.means)
                target = best(known, fixed, gain, actions, lax.stop_gradient(least))
                return self._path(task, rollout, member.trading, target)[0]

            rewards = jax.vmap(on_returns)(learned.members)
            means, variances = jax.vmap(_moments)(counted & ~left, rewards)
            falling = (variances / 2 - means / self.risk_aversion).sum()
            return (worse + falling) / unit + penalty, (variance, rewards - net)

        gradient, (variance, active) = jax.grad(loss, has_aux=True)(state.policy.learned)
        rate = self._schedule(state.optimizer.count + 1)
        learned, adam = optimizer.descend(state.policy.learned, gradient, state.optimizer, rate)
        evidence = state.evidence
        if active is not None:
            evidence = evidence.add(block, active, counted & left, self.memory)
        policy = Efficient(learned, evidence.share(self.threshold), actions)
        loss_now = {"loss": jnp.sqrt(variance)}
        return MeanVarianceState(policy, state.start, adam, evidence), loss_now

    def _path(
        self, task: ExogenousTask, rollout: Transition, trading: Trading, target: Array
    ) -> tuple[Float[Array, "time path"], Float[Array, "time path"]]:
        """Rewards net of costs and before costs, beginning at the first target."""
        given = lambda view, target: (target,)  # noqa: E731
        (net,), (gross,) = self._followed(task, rollout, (trading,), given, target)
        return net, gross


def _moments(counted: Array, values: Array) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and variance over the steps that count."""
    steps = jnp.maximum(jnp.broadcast_to(counted, values.shape).sum(), 1)
    mean = (counted * values).sum() / steps
    return mean, (counted * (values - mean) ** 2).sum() / steps


class MinimumVariance(MeanVariance):
    """Learned minimum variance: expects no returns and weighs risk more heavily against costs."""

    returns: bool = static(False)
    num_envs: int = static(16)
    learning_rate_steps: float = number(120.0)
    risk_aversion: float = number(30.0)
