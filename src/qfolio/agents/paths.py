"""What agents share that differentiate rewards through whole paths of a market.

They learn from rollouts that begin with an episode or within one, and never span two; they store
nothing, and estimate no values. ``pathwise.py``, ``tilts.py`` and ``mean_variance.py`` differ in
the policy and the loss.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import Group, require, require_counts
from qfolio.core.market import SEARCHED, View
from qfolio.core.mdp import Agent, ExogenousTask, Metrics, Position, Task, Transition
from qfolio.core.training import episode_steps
from qfolio.learning.evidence import EvidenceConfig
from qfolio.learning.optimizer import CosineSchedule
from qfolio.learning.trading import Trading

State = TypeVar("State")

Rewards = tuple[Float[Array, "time path"], ...]

Targets = Callable[[View, PyTree], tuple[Float[Array, "path entry"], ...]]

AT_ONCE = 2**21
"""Most numbers in the features of a rollout whose targets are computed all at once. A larger
rollout would not fit the processor's cache; its targets are computed step by step."""


BLOCK = 2**10
"""Most paths times assets that are followed side by side: the arrays of a step and of its
derivative then fit the cache of a core, for some members, too."""


class OnPaths(Agent):
    """The schedule, the rollouts and how a policy acts; subclasses define it and ``learn``."""

    if TYPE_CHECKING:  # as in Agent

        @property
        def rollout_length(self) -> int: ...
    else:
        rollout_length: eqx.AbstractVar[int]

    _schedule = Group(CosineSchedule)

    @property
    def discount(self) -> None:
        return None

    @property
    def rollout_steps(self) -> int:
        return self.rollout_length

    def weights(self, state: Any) -> Any:
        return state.policy

    def policy(
        self, weights: Callable[[View], Array], observation: View
    ) -> Float[Array, "batch entry"]:
        return weights(observation)

    def _require_whole(self, task: Task) -> None:
        """Raises QfolioError if a rollout would span two episodes."""
        episode, length = episode_steps(task, self), self.rollout_length
        if episode % length:
            whole = episode // length * length
            fits = f"horizon={whole + length}"
            if episode < task.horizon:  # an episode_steps of 0 is the horizon
                fits = f"episode_steps={whole}" if whole else f"{fits} and episode_steps=0"
            raise QfolioError(
                f"rollout_length is {length}; it must divide the {episode} steps of an episode; "
                f"set {fits}, or another rollout_length."
            )

    def _followed(
        self,
        task: ExogenousTask,
        rollout: Transition,
        trades: tuple[Trading, ...],
        targets: Targets,
        given: PyTree = None,
    ) -> tuple[Rewards, Rewards]:
        """Rewards of following targets along the rollout's market, and those without costs.

        Each of ``trades`` follows one of the targets and begins there. targets: maps a step's view
        and its part of ``given``, which has a leading time axis, to them.
        """
        if rollout.observation.features.size <= AT_ONCE:
            given = targets(rollout.observation, given)
            targets = lambda _, given: given  # noqa: E731

        def step(holdings: PyTree, moves: tuple) -> tuple[PyTree, tuple]:
            first, market, next_market, anchor, given = moves
            settle, shift = jax.vmap(task.settle), jax.vmap(task.shift)
            views = [jax.vmap(task.observe)(Position(market, holding)) for holding in holdings]

            def settled(trade: Trading, holding: PyTree, held: Array, target: Array) -> tuple:
                action = jnp.where(first, target, trade(held, target, anchor))
                reward, after = settle(market, next_market, holding, action)
                there = shift(holding, action[..., 1:] - held)
                without, _ = settle(market, next_market, there, action)
                return reward, without, after

            held = [view.holding for view in views]
            wanted = targets(views[0]._replace(anchor=anchor), given)
            each = zip(trades, holdings, held, wanted, strict=True)
            rewards, without, after = zip(*(settled(*one) for one in each), strict=True)
            return after, (rewards, without)

        first = jnp.arange(self.rollout_length) == 0
        # The backward pass computes each step again, except for what a projection searched for.
        kept = jax.checkpoint_policies.save_only_these_names(SEARCHED)
        again = jax.checkpoint(step, policy=kept)

        def follow(moves: tuple) -> tuple[Rewards, Rewards]:
            holding, market, _, anchor, given = jax.tree.map(lambda x: x[0], moves)
            view = jax.vmap(task.observe)(Position(market, holding))
            # Held at once: a calendar or a limit might not let the first order lead there.
            starts = tuple(
                jax.vmap(task.shift)(holding, target[..., 1:] - view.holding)
                for target in targets(view._replace(anchor=anchor), given)
            )
            return lax.scan(again, starts, (first, *moves[1:]))[1]

        market, next_market = rollout.state.market, rollout.next_state.market
        moves = (rollout.state.holding, market, next_market, rollout.observation.anchor, given)
        assets = rollout.observation.holding.shape[-1]
        return in_blocks(follow, moves, max(BLOCK // assets, 1))


class Onlooker(OnPaths):
    """Learns from the market's moves alone: its rollouts trade nothing, and nothing of them is
    logged."""

    _evidence = Group(EvidenceConfig)

    def __check_init__(self) -> None:
        require_counts(self, "units")
        self._evidence.check()
        require_counts(self, "rollout_length", 2)
        require(self, "head", lambda x: 1 <= x < self.rollout_length, "at least 1 and below "
                f"rollout_length, {self.rollout_length}")  # fmt: skip
        require(self, "ridge", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        self._schedule.check()

    def act(
        self, state: State, observation: View, key: PRNGKeyArray
    ) -> Float[Array, "batch entry"]:
        """The order that keeps the holding as it is."""
        return simplex.with_rest(observation.holding)

    def measure(self, task: Task, step: Transition) -> Metrics:
        return {}


def in_blocks(function: Callable[[PyTree], PyTree], paths: PyTree, most: int) -> PyTree:
    """A function of paths, computed for equal blocks of at most some paths, one after another.

    Args:
        function: Maps leaves of shape (time, path, ...) to leaves of shape (time, path).
        paths: What it maps.
        most: Paths in a block.
    """
    count = jax.tree.leaves(paths)[0].shape[1]
    size = max(size for size in range(1, count + 1) if count % size == 0 and size <= most)
    if size == count:
        return function(paths)
    blocks = jax.tree.map(
        lambda x: jnp.moveaxis(x.reshape(len(x), count // size, size, *x.shape[2:]), 1, 0), paths
    )
    found = lax.map(function, blocks)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(x.shape[1], count), found)
