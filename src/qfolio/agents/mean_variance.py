"""Learned minimum variance, and learned mean and variance: portfolios that are trained end to end.

The policy estimates a covariance from its window of returns, and expected returns if it is to
(``learning/covariance.py``). It takes the best weights for them (``core/quadratic.py``), and trades
a share of the way there, outside a band. All that it learns is trained together, by the gradient of
realised variance, returns and costs through whole paths, as in ``pathwise.py``.
docs/mean_variance.md lists formulas and their sources.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.agents.paths import OnPaths, unchanged
from qfolio.core import quadratic
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, static
from qfolio.core.market import View
from qfolio.core.mdp import ExogenousTask, Metrics, Simplex, Task, Transition
from qfolio.learning import optimizer
from qfolio.learning.covariance import Covariance, Means
from qfolio.learning.evidence import Evidence, blocks_of
from qfolio.learning.trading import Trading


class Efficient(eqx.Module):
    """Maps a view of the market to an order towards the weights of the best mean and variance."""

    covariance: Covariance
    means: Means | None
    trading: Trading
    share: Float[Array, ""]  # of the expected returns that the evidence leaves
    actions: Simplex

    def __call__(self, view: View) -> Float[Array, "*batch entry"]:
        assert view.anchor is not None
        return self.trading(view.holding, self.target(view), view.anchor)

    def target(self, view: View) -> Float[Array, "*batch entry"]:
        return self.weights(view, self.sigma(view), self.share)

    def sigma(self, view: View) -> Float[Array, "*batch asset asset"]:
        assert view.anchor is not None
        return self.covariance(view.features[..., 0], view.anchor > 0)

    def weights(
        self, view: View, sigma: Float[Array, "*batch asset asset"], share: Array | float
    ) -> Float[Array, "*batch entry"]:
        """The best weights for a covariance and a share of the expected returns.

        They are fully invested, as far as the anchor is.
        """
        assert view.anchor is not None
        open_to = view.anchor > 0
        gain = jnp.zeros_like(view.anchor)
        if self.means is not None:
            expected = self.means(view.features[..., 0], open_to)
            gain = share * expected / open_to.sum(-1, keepdims=True)
        total = view.anchor.sum(-1, keepdims=True)
        wanted = quadratic.best(sigma, gain, open_to, self.actions.cap)
        return jnp.concatenate([1 - total, total * wanted], -1)


class MeanVarianceState(eqx.Module):
    """The state of a MeanVariance agent."""

    policy: Efficient
    start: Efficient  # that a penalty pulls to
    optimizer: optimizer.Optimizer
    evidence: Evidence


class MeanVariance(OnPaths):
    """Gradient ascent on mean return less realised variance and costs."""

    returns: bool = static(True)  # learn expected returns, too
    units: int = static(8)  # of the network that cleans eigenvalues
    blocks: int = static(32)  # of the data, of equal length
    num_envs: int = static(16)  # paths in a batch
    rollout_length: int = static(63)  # steps of a path
    head: int = static(21)  # of these, first steps that only lead to a holding
    every: int = static(7)  # steps from a covariance to the next one, in training
    episode_steps: int = static(0)  # training episodes are cut here; 0: the task's horizon
    learning_rate: float = number(0.05)
    learning_rate_final: float = number(0.0)  # share of it that remains at the end of the cosine
    learning_rate_steps: float = number(120.0)  # gradient steps of the cosine
    risk_aversion: float = number(10.0)  # half of it times variance is worth a return, or a cost
    ridge: float = number(3.0)  # on squared changes of what is learned, divided by the data's moves
    threshold: float = number(3.0)  # t-statistic up to which no returns are expected
    memory: float = number(0.9)  # share of the evidence that a gradient step keeps

    def __check_init__(self) -> None:
        require(self, "num_envs units blocks", lambda x: 1 <= x < 2**31, "at least 1")
        require(self, "rollout_length", lambda x: x >= 2, "at least 2")
        require(self, "head", lambda x: 0 <= x < self.rollout_length, "at least 0 and below "
                f"rollout_length, {self.rollout_length}")  # fmt: skip
        require(self, "every", lambda x: x >= 1 and self.rollout_length % x == 0, "a divisor of "
                f"rollout_length, {self.rollout_length}")  # fmt: skip
        require(self, "episode_steps", lambda x: 0 <= x < 2**31, "at least 0")
        require(self, "risk_aversion", lambda x: 0 < x <= 1e9, "above 0 and at most 10⁹")
        require(self, "ridge", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "threshold", lambda x: 0 <= x <= 1e3, "from 0 to 1,000")
        require(self, "memory", lambda x: 0 <= x < 1, "at least 0 and below 1")
        self._schedule.check()

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
                "A learned minimum variance, or mean and variance, gives weights; leave menu empty."
            )
        self._require_whole(task)
        policy = Efficient(
            Covariance(self.units, key),
            Means() if self.returns else None,
            Trading.start(0.1),
            jnp.array(0.0),
            task.actions,
        )
        return MeanVarianceState(
            policy, policy, optimizer.begin(policy), Evidence.none(self.blocks)
        )

    def monitor(self, state: MeanVarianceState) -> Metrics:
        covariance, means = state.policy.covariance, state.policy.means
        found = {"evidence": state.evidence.t, "share": state.policy.share}
        return {
            **({} if means is None else found | means.described),
            **covariance.described,
            **state.policy.trading.described,
        }

    def weights(self, state: MeanVarianceState) -> Efficient:
        return state.policy

    def policy(self, weights: Efficient, observation: View) -> Float[Array, "batch entry"]:
        return weights(observation)

    def act(
        self, state: MeanVarianceState, observation: View, key: PRNGKeyArray
    ) -> Float[Array, "batch entry"]:
        return unchanged(observation)

    def learn(
        self, task: Task, state: MeanVarianceState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[MeanVarianceState, Metrics]:
        assert isinstance(task, ExogenousTask)
        view: View = rollout.observation
        assert view.anchor is not None
        anchor, some = view.anchor, jax.tree.map(lambda x: x[:: self.every], view)

        def loss(policy: Efficient) -> tuple[Array, tuple[Array, Array]]:
            # Covariances change slowly, so each serves some steps.
            sigma = policy.sigma(some)
            held = lambda x: jnp.repeat(x, self.every, 0)  # noqa: E731
            base = held(policy.weights(some, sigma, 0.0))
            followers: tuple = ((policy.trading, base),)
            if policy.means is not None:
                base = lax.stop_gradient(base)
                target = policy.weights(view, held(sigma), 1.0)
                followers = (policy.trading, target), (lax.stop_gradient(policy.trading), base)
            found = self._followed(task, rollout, followers, anchor)
            nets, grosses = jax.tree.map(lambda x: x[self.head :], found)
            net, gross = nets[0], grosses[0]
            variance, cost = gross.var(), (gross - net).mean()
            mean = gross.mean() if self.returns else 0.0
            off = jax.tree.map(lambda x, y: ((x - y) ** 2).sum(), policy, state.start)
            squares = sum(jax.tree.leaves(off), jnp.array(0.0))
            # Relative to the variance, so that tables of any volatility are learned alike.
            worse = variance / 2 + (cost - mean) / self.risk_aversion
            penalised = worse / lax.stop_gradient(variance) + self.ridge / task.moves * squares
            return penalised, (jnp.sqrt(variance), net - nets[-1])

        gradient, (volatility, active) = jax.grad(loss, has_aux=True)(state.policy)
        rate = self._schedule(state.optimizer.count + 1)
        policy, adam = optimizer.descend(state.policy, gradient, state.optimizer, rate)
        block = blocks_of(task, rollout, self.blocks)[self.head :]
        evidence = state.evidence.add(block, active, jnp.ones_like(active), self.memory)
        policy = eqx.tree_at(lambda p: p.share, policy, evidence.share(self.threshold))
        return MeanVarianceState(policy, state.start, adam, evidence), {"loss": volatility}


class MinimumVariance(MeanVariance):
    """Learned minimum variance: no returns are expected, and risk counts for more than costs."""

    returns: bool = static(False)
    risk_aversion: float = number(30.0)
