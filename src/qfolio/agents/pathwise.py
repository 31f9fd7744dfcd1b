"""Pathwise policy gradient: net growth, differentiated through the episode.

If prices do not depend on our trades, the reward of a whole episode is a differentiable function of
the policy: each action earns the market's next return, pays the cost of trading from the last
holding, and leads to the next one. The gradient of the sum is exact for the paths seen; no action
is perturbed to estimate it (Moody & Saffell 1998; Jiang et al. 2017, eq. 21–22, whose memory of
previous weights is the holding here). docs/algorithms/pathwise.md lists formulas and deviations.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.agents.paths import OnPaths
from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, require_counts, require_sizes, sizes, static
from qfolio.core.keys import apart
from qfolio.core.market import View
from qfolio.core.mdp import (
    Box,
    Discrete,
    ExogenousTask,
    Metrics,
    Position,
    Simplex,
    Task,
    Transition,
)
from qfolio.learning import optimizer
from qfolio.learning.networks import SHARED, Reading, Shared, start_at_zero
from qfolio.learning.optimizer import Optimizer


class Band(eqx.Module):
    """Maps a view of the market to target weights, or to positions if they are unbounded.

    The network outputs two edges for each asset; a holding outside them moves to the nearer one.
    With proportional costs the best policy of one asset has this form (Davis & Norman 1990; as a
    network: Imaki et al. 2021, "No-transaction band network"); two edges that meet are a target
    from anywhere. If the wanted weights sum to more than 1, the projection reduces them all, even
    those of assets inside their edges. At first the edges lie close together around equal weights,
    or no position, so that both are traded to and have gradients.
    """

    network: Shared
    actions: Simplex | Box

    def __call__(self, view: View) -> Float[Array, "batch entry"]:
        return self.allowed(self.wanted(self.network.read(view.features), view.holding))

    def allowed(self, wanted: Float[Array, "batch entry"]) -> Float[Array, "batch entry"]:
        """The point of the simplex nearest to ``wanted``."""
        if isinstance(self.actions, Box):
            return wanted
        return simplex.project(wanted, jnp.asarray(self.actions.caps))

    def wanted(
        self, reading: Reading, holding: Float[Array, "batch asset"]
    ) -> Float[Array, "batch entry"]:
        """The holding, clipped to the edges; cash is the rest."""
        low, high = self.edges(reading, holding)
        assets = lax.clamp(low, holding, high)
        if isinstance(self.actions, Box):
            return assets
        return simplex.with_rest(assets)

    def edges(
        self, reading: Reading, holding: Float[Array, "*batch asset"]
    ) -> tuple[Float[Array, "*batch asset"], Float[Array, "*batch asset"]]:
        """The lower and the upper edge of each asset."""
        answer = self.network.answer(reading, holding)[1]
        if isinstance(self.actions, Box):
            edges = jnp.array([-1.0, 1.0]) / 8 + answer
        else:
            # Among many assets weights are small, and the outputs are scaled to match.
            unit = 1 / (1 + self.actions.assets)
            distance = unit / 8 * jnp.array([-1.0, 1.0]) + 2 * unit * answer
            # In log odds, so that no edge leaves the weights that are held: beyond them nothing
            # trades to it, and its gradient would be zero for good.
            start, slope = -math.log(self.actions.assets), 1 / (unit * (1 - unit))
            edges = jax.nn.sigmoid(start + slope * distance)
        # By selection, as in targets.smallest.
        one, other = edges[..., 0], edges[..., 1]
        swapped = other < one
        return jnp.where(swapped, other, one), jnp.where(swapped, one, other)


class Slopes(eqx.Module):
    """The marginal value of each asset held after a rollout, in scaled rewards.

    At the low edge it is the cost of buying that is about to be saved, and at the high edge minus
    the cost of selling, however close the two edges are. So the network sees the place of a holding
    between its edges instead of the holding.
    """

    network: Shared

    def __call__(self, policy: Band, view: View) -> Float[Array, "*batch asset"]:
        low, high = policy.edges(policy.network.read(view.features), view.holding)
        inside = (lax.clamp(low, view.holding, high) - low) / jnp.maximum(high - low, 1e-6)
        # From −2 to 2, so that the kinks of the random first layer lie in between.
        place = lax.stop_gradient(4 * inside - 2)
        return self.network.answer(self.network.read(view.features), place)[1][..., 0]


class PathwiseState(eqx.Module):
    """The state of a Pathwise agent."""

    policy: Band
    optimizer: Optimizer
    steps: Int[Array, ""]  # rollouts so far; never read, but a part of saved folders
    slopes: Slopes | None  # with bootstrap
    slope_optimizer: Optimizer | None


class Paths(NamedTuple):
    """Paths of a market, and the holdings that they begin with."""

    market: PyTree  # before each move: (time, path, …)
    next_market: PyTree  # after it
    features: Float[Array, "time path asset window channel"]
    start: PyTree  # (path, …)

    @staticmethod
    def of(rollout: Transition) -> "Paths":
        """The paths of a rollout, from the holdings of its first step."""
        start = jax.tree.map(lambda x: x[0], rollout.state.holding)
        markets = rollout.state.market, rollout.next_state.market
        return Paths(*markets, rollout.observation.features, start)

    @property
    def shape(self) -> tuple[int, int]:
        """Times and paths."""
        time, paths, *_ = self.features.shape
        return time, paths

    def spread(self, task: ExogenousTask, policy: Band, key: PRNGKeyArray) -> "Paths":
        """The paths, with every second one beginning at a random place in the band.

        From outside the band, the first trade leads to an edge. Few paths would cross a wide band,
        so the slopes inside it would be learned from few data.
        """
        market = jax.tree.map(lambda x: x[0], self.market)
        view = jax.vmap(task.observe)(Position(market, self.start))
        low, high = policy.edges(policy.network.read(view.features), view.holding)
        inside = low + jax.random.uniform(key, low.shape) * (high - low)
        inside = policy(view._replace(holding=inside))[..., -low.shape[-1] :]  # on the simplex
        second = (jnp.arange(len(low)) % 2 == 1)[:, None]
        by = jnp.where(second, inside - view.holding, 0.0)
        return self._replace(start=jax.vmap(task.shift)(self.start, by))

    def with_images(self, task: ExogenousTask) -> "Paths":
        """The paths and, beside them, their mirror images, if the market has any.

        These are antithetic paths (Hammersley & Morton 1956). A band adapts to the mean return of
        the paths that it learns from. In 10,000 years of paths at a volatility of 20%, this mean is
        off by 0.2% a year, and the edges by 0.01; paths and their images have the true mean.
        """
        market, next_market = (jax.vmap(jax.vmap(task.mirror))(x) for x in self[:2])
        if market is None:
            return self
        seen = jax.vmap(lambda now: jax.vmap(task.observe)(Position(now, self.start)))(market)
        images = market, next_market, seen.features
        beside = partial(jax.tree.map, lambda *pair: jnp.concatenate(pair, 1))
        start = jax.tree.map(lambda x: jnp.concatenate([x, x]), self.start)
        market, next_market, features = map(beside, self[:3], images)
        return Paths(market, next_market, features, start)


class Pathwise(OnPaths):
    """Gradient ascent on net growth through whole rollouts."""

    network: str = static("mlp")  # mlp, cnn, rnn or lstm, shared by all assets
    hidden: tuple[int, ...] = sizes(32, 32)  # units of each hidden layer
    num_envs: int = static(64)  # paths in a batch, without mirror images
    rollout_length: int = static(50)  # steps of each path that a gradient goes through
    tail: int = static(0)  # last of these steps, whose decisions have no gradient
    bootstrap: bool = static(False)  # learn the value of the holdings after the rollout
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    gradient_steps: int = static(1)  # gradient steps per rollout
    learning_rate: float = number(1e-3)  # step size at the start
    learning_rate_final: float = number(1.0)  # share of learning_rate at the end of its cosine
    learning_rate_steps: float = number(1e4)  # gradient steps of that cosine
    slope_learning_rate_ratio: float = number(20.0)  # learning rate of bootstrap over the band's
    max_grad_norm: float = number(math.inf)  # longer gradients are rescaled to it
    reward_scale: float = number(1.0)  # rewards are multiplied by it
    simplex_penalty: float = number(0.01)  # penalty on weights off the simplex

    def __check_init__(self) -> None:
        require(self, "network", lambda x: x in SHARED, f"one of {', '.join(SHARED)}")
        require_counts(self, "rollout_length gradient_steps")
        require_counts(self, "tail", 0)
        require(self, "max_grad_norm", lambda x: x > 0, "greater than 0")
        ratio = "slope_learning_rate_ratio"
        require(self, ratio, lambda x: 0 < x <= 1e9, "above 0 and at most 10⁹")
        require(self, "simplex_penalty", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "reward_scale", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        self._schedule.check()
        require_sizes(self)
        if self.tail >= self.rollout_length:
            raise QfolioError(
                f"tail is {self.tail}; it must be less than rollout_length, {self.rollout_length}."
            )
        if self.bootstrap and self.rollout_length - self.tail < 2:
            raise QfolioError(
                "bootstrap learns from all decisions but the first; rollout_length less tail must "
                "be 2 or more."
            )

    def init(self, task: Task, key: PRNGKeyArray) -> PathwiseState:
        if not isinstance(task, ExogenousTask) or isinstance(task.actions, Discrete):
            raise QfolioError(
                "pathwise needs a market whose actions are weights or positions; "
                f"{task.name} is not one (in a market, leave menu empty)."
            )
        self._require_whole(task)
        view = task.observe(task.reset(key))
        network = Shared(self.network, view, self.hidden, pooled=0, each=2, key=key)
        # With outputs of zero, the first policy is the initial band.
        policy = Band(start_at_zero(network), task.actions)
        slopes = None
        if self.bootstrap:
            network = Shared(self.network, view, self.hidden, pooled=0, each=1, key=apart(key))
            slopes = Slopes(start_at_zero(network))
        return PathwiseState(
            policy=policy,
            optimizer=optimizer.begin(policy),
            steps=jnp.array(0, jnp.int32),
            slopes=slopes,
            slope_optimizer=optimizer.begin(slopes) if slopes else None,
        )

    def act(
        self, state: PathwiseState, observation: View, key: PRNGKeyArray
    ) -> Float[Array, "batch entry"]:
        return state.policy(observation)

    def learn(
        self, task: Task, state: PathwiseState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[PathwiseState, Metrics]:
        assert isinstance(task, ExogenousTask)

        paths = Paths.of(rollout)
        if state.slopes is not None:
            paths = paths.spread(task, state.policy, key)
        paths = paths.with_images(task)

        def update(state: PathwiseState, _: None) -> tuple[PathwiseState, Float[Array, ""]]:
            nudges = jnp.zeros((*paths.shape, rollout.observation.holding.shape[-1]))
            differentiate = jax.value_and_grad(self._loss, (0, 1), has_aux=True)
            (loss, held), (gradient, worth) = differentiate(
                state.policy, nudges, state.slopes, task, paths
            )
            rate = self._schedule(state.optimizer.count + 1)
            gradient = optimizer.clip(gradient, self.max_grad_norm)
            policy, adam = optimizer.descend(state.policy, gradient, state.optimizer, rate)
            slopes, slope_adam = state.slopes, state.slope_optimizer
            if slopes is not None and slope_adam is not None:
                cut = len(held)
                # Without the first holdings, which may be far from any that the policy leads to.
                views = View(paths.features[1:cut], held[1:])
                # Of the sum of a path's rewards; the loss is minus a mean.
                worth = -worth[1:cut] * math.prod(held.shape[:2])

                def off(slopes: Slopes) -> Float[Array, ""]:
                    return ((slopes(state.policy, views) - worth) ** 2).mean()

                rate = rate * self.slope_learning_rate_ratio
                slopes, slope_adam = optimizer.descend(
                    slopes, jax.grad(off)(slopes), slope_adam, rate
                )
            return PathwiseState(policy, adam, state.steps, slopes, slope_adam), loss

        state, losses = lax.scan(update, state, None, length=self.gradient_steps)
        return eqx.tree_at(lambda s: s.steps, state, state.steps + 1), {"loss": losses.mean()}

    def _loss(
        self,
        policy: Band,
        nudges: Float[Array, "time batch asset"],
        slopes: Slopes | None,
        task: ExogenousTask,
        paths: Paths,
    ) -> tuple[Float[Array, ""], Float[Array, "decision batch asset"]]:
        """Minus the mean reward per step of ``policy`` along the paths, plus the penalty; holdings.

        Holdings are those before each decision that has a gradient. nudges: zeros that are added to
        the holdings; their gradient is the marginal value of each asset.
        """

        def follow(policy: Band, holding: PyTree, steps: slice) -> Any:
            def step(holding: PyTree, moves: tuple) -> tuple[PyTree, tuple]:
                market, next_market, reading, nudge = moves
                holding = jax.vmap(task.shift)(holding, nudge)
                view = jax.vmap(task.observe)(Position(market, holding))
                wanted = policy.wanted(reading, view.holding)
                action = policy.allowed(wanted)
                off = ((wanted - action) ** 2).sum(-1)
                reward, holding = jax.vmap(task.settle)(market, next_market, holding, action)
                return holding, (reward, off, view.holding)

            moves = (paths.market, paths.next_market, paths.features, nudges)
            market, next_market, features, nudge = jax.tree.map(lambda x: x[steps], moves)
            # All windows are read at once, before the scan over holdings.
            reading = policy.network.read(features)
            return lax.scan(step, holding, (market, next_market, reading, nudge))

        cut = self.rollout_length - self.tail
        holding, (rewards, off, held) = follow(policy, paths.start, slice(None, cut))
        total = rewards.sum()
        if self.tail:
            # Without a tail, a trade near the end would pay its cost without earning its return.
            holding, (later, _, _) = follow(lax.stop_gradient(policy), holding, slice(cut, None))
            total += later.sum()
        total *= self.reward_scale
        if slopes is not None:
            market = jax.tree.map(lambda x: x[-1], paths.next_market)
            view = jax.vmap(task.observe)(Position(market, holding))
            total += (lax.stop_gradient(slopes(policy, view)) * view.holding).sum()
        return self.simplex_penalty * off.mean() - total / rewards.size, held
