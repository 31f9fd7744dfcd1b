"""Pathwise policy gradient: net growth, differentiated through the episode.

If prices do not depend on our trades, the reward of a whole episode is a differentiable function of
the policy: each action earns the market's next return, pays the cost of trading from the last
holding, and leaves the next one. The gradient of the sum is exact for the paths seen; no action is
perturbed to estimate it (Moody & Saffell 1998; Jiang et al. 2017, eq. 21–22, whose memory of
previous weights is the holding here). docs/pathwise.md lists formulas and deviations.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require, require_sizes, sizes, static
from qfolio.core.market import View
from qfolio.core.mdp import (
    Agent,
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
from qfolio.learning.networks import SHARED, Reading, Shared
from qfolio.learning.optimizer import CosineSchedule


class Band(eqx.Module):
    """Maps a view of the market to target weights, or to positions if they are unbounded.

    The network outputs two edges for each asset; a holding outside them moves to the nearer one.
    With proportional costs the best policy of one asset has this form (Davis & Norman 1990; as a
    network: Imaki et al. 2021, "No-transaction band network"); two edges that meet are a target
    from anywhere. If the wanted weights sum to more than 1, the projection reduces them, also those
    of assets inside their edges.
    The edges start close together, so that both are traded to and have gradients, around equal
    weights or no position.
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
        # Among many assets weights are small, and the outputs are scaled to match.
        start, unit, scale = 0.0, 1.0, 1.0
        if isinstance(self.actions, Simplex):
            start = unit = 1 / (1 + self.actions.assets)
            scale = 2 * unit
        edges = (
            start
            + unit / 8 * jnp.array([-1.0, 1.0])
            + scale * self.network.answer(reading, holding)[1]
        )
        # By selection, as in targets.smallest.
        one, other = edges[..., 0], edges[..., 1]
        swapped = other < one
        low, high = jnp.where(swapped, other, one), jnp.where(swapped, one, other)
        assets = lax.clamp(low, holding, high)
        if isinstance(self.actions, Box):
            return assets
        return jnp.concatenate([1 - assets.sum(-1, keepdims=True), assets], -1)


class PathwiseState(eqx.Module):
    policy: Band
    optimizer: optimizer.Optimizer
    steps: Int[Array, ""]


class Pathwise(Agent):
    """Gradient ascent on net growth through whole rollouts."""

    network: str = static("mlp")  # mlp, cnn or rnn, shared by all assets
    hidden: tuple[int, ...] = sizes(32, 32)
    num_envs: int = static(64)  # paths in a batch
    rollout_length: int = static(50)  # steps of each path that a gradient goes through
    tail: int = static(0)  # of these, last steps without a gradient of their own
    episode_steps: int = static(0)  # training episodes are cut here; 0: the task's horizon
    gradient_steps: int = static(1)  # gradient steps per rollout
    learning_rate: float = number(1e-3)
    learning_rate_final: float = number(1.0)  # share of it that remains at the end of the cosine
    learning_rate_steps: float = number(1e4)  # gradient steps of the cosine
    max_grad_norm: float = number(math.inf)  # longer gradients are rescaled to it
    reward_scale: float = number(1.0)
    simplex_penalty: float = number(0.01)  # on weights off the simplex, where the gradient is zero

    def __check_init__(self) -> None:
        if self.network not in SHARED:
            raise QfolioError(
                f"network is {self.network!r}; it must be one of {', '.join(SHARED)}."
            )
        require(self, "num_envs rollout_length gradient_steps", lambda x: x >= 1, "at least 1")
        require(self, "episode_steps tail", lambda x: x >= 0, "at least 0")
        require(self, "max_grad_norm", lambda x: x > 0, "greater than 0")
        require(self, "reward_scale", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        self._schedule.check()
        require_sizes(self)
        if self.tail >= self.rollout_length:
            raise QfolioError(
                f"tail is {self.tail}; it must be less than rollout_length, {self.rollout_length}."
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

    def init(self, task: Task, key: PRNGKeyArray) -> PathwiseState:
        if not isinstance(task, ExogenousTask) or isinstance(task.actions, Discrete):
            raise QfolioError(
                "pathwise needs a market whose actions are weights or positions; "
                f"{task.name} is not one (in a market, leave menu empty)."
            )
        episode = min(self.episode_steps or task.horizon, task.horizon)
        if episode % self.rollout_length:
            raise QfolioError(
                f"rollout_length is {self.rollout_length}; it must divide the {episode} steps of "
                "an episode (episode_steps, or the task's horizon)."
            )
        view = task.observe(task.reset(key))
        network = Shared(self.network, view, self.hidden, pooled=0, each=2, key=key)
        # With an output layer of zeros, the first policy is the initial band.
        last = lambda n: (n.head.weights[-1], n.head.biases[-1])  # noqa: E731
        network = eqx.tree_at(last, network, replace_fn=jnp.zeros_like)
        policy = Band(network, task.actions)
        return PathwiseState(
            policy=policy,
            optimizer=optimizer.begin(policy),
            steps=jnp.array(0, jnp.int32),
        )

    def warm_up(self) -> int:
        return 0

    def weights(self, state: PathwiseState) -> Band:
        return state.policy

    def policy(self, weights: Band, observation: View) -> Float[Array, "batch entry"]:
        return weights(observation)

    def act(
        self, state: PathwiseState, observation: View, key: PRNGKeyArray
    ) -> Float[Array, "batch entry"]:
        return state.policy(observation)

    def observe(self, state: PathwiseState, rollout: Transition) -> PathwiseState:
        return state

    def learn(
        self, task: Task, state: PathwiseState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[PathwiseState, Metrics]:
        assert isinstance(task, ExogenousTask)

        def update(carry: Any, _: None) -> Any:
            policy, adam = carry
            loss, gradient = jax.value_and_grad(self._loss)(policy, task, rollout)
            gradient = optimizer.clip(gradient, self.max_grad_norm)
            rate = self._schedule(adam.count + 1)
            return optimizer.descend(policy, gradient, adam, rate), loss

        carry = (state.policy, state.optimizer)
        (policy, adam), losses = lax.scan(update, carry, None, length=self.gradient_steps)
        return PathwiseState(policy, adam, state.steps + 1), {"loss": losses.mean()}

    def _loss(self, policy: Band, task: ExogenousTask, rollout: Transition) -> Float[Array, ""]:
        """Minus the mean reward per step of ``policy`` along the rollout's market."""

        def follow(policy: Band, holding: PyTree, steps: slice) -> Any:
            def step(holding: PyTree, moves: tuple) -> tuple[PyTree, tuple]:
                market, next_market, reading = moves
                view = jax.vmap(task.observe)(Position(market, holding))
                wanted = policy.wanted(reading, view.holding)
                action = policy.allowed(wanted)
                off = ((wanted - action) ** 2).sum(-1)
                reward, holding = jax.vmap(task.settle)(market, next_market, holding, action)
                return holding, (reward, off)

            moves = (rollout.state.market, rollout.next_state.market, rollout.observation)
            market, next_market, seen = jax.tree.map(lambda x: x[steps], moves)
            # All windows are read at once, before the scan over holdings.
            return lax.scan(
                step, holding, (market, next_market, policy.network.read(seen.features))
            )

        start = jax.tree.map(lambda x: x[0], rollout.state.holding)
        cut = self.rollout_length - self.tail
        holding, (rewards, off) = follow(policy, start, slice(None, cut))
        total = rewards.sum()
        if self.tail:
            # Without a tail, a trade near the end would pay its cost without earning its return.
            _, (later, _) = follow(lax.stop_gradient(policy), holding, slice(cut, None))
            total += later.sum()
        return self.simplex_penalty * off.mean() - self.reward_scale * total / rewards.size
