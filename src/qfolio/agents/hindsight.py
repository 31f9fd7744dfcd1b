"""Values of all actions at once, in markets whose prices do not depend on the agent's trades.

One move of the market gives the outcome of every action from any holding (hindsight learning for
exogenous inputs, Sinclair et al. 2023): the buffer stores moves instead of transitions, holdings
are drawn at each update, and all actions regress together.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent, ExogenousTask, Position, Task, Transition
from qfolio.learning.targets import Scalar, bootstrap, td_target

Q = Callable[[PyTree], Float[Array, "batch action"]]
"""From observations to action values."""


class Move(NamedTuple):
    """A move of the market, as the buffer stores it."""

    market: PyTree
    next_market: PyTree

    @staticmethod
    def of(rollout: Transition) -> "Move":
        """A rollout's moves as rows, ordered by time and then environment."""
        moves = Move(rollout.state.market, rollout.next_state.market)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), moves)


PLAIN: dict[str, str | bool | int | float] = {
    "values": "expected", "n_steps": 1, "prioritized": False, "noisy": False, "persistence": 0.0,
    "value_rescaling": False, "time_limit_terminal": False,
}  # fmt: skip
"""The values of an agent's settings that ``all_actions`` requires."""


def require_plain(agent: Agent) -> None:
    """Raises QfolioError if one of the agent's settings differs from ``PLAIN``."""
    for name, value in PLAIN.items():
        if getattr(agent, name) != value:
            raise QfolioError(
                "all_actions learns expected values from single moves, drawn uniformly, without "
                f"exploration; set {name}={str(value).lower()}, or all_actions=false."
            )


def require_exogenous(task: Task) -> None:
    """Raises QfolioError unless a move gives the outcome of every action."""
    if not isinstance(task, ExogenousTask):
        raise QfolioError(
            "all_actions needs a market, whose prices do not depend on actions; "
            f"{task.name} is not a market."
        )
    if task.path_dependent:
        raise QfolioError(
            "all_actions draws holdings without a history, on which this reward (such as "
            "differential-sharpe) depends; set reward=crra, or all_actions=false."
        )


class Rule(NamedTuple):
    """How to compute targets; the names are those of the agent's settings."""

    discount: Scalar
    reward_scale: Scalar
    double: bool
    market_baseline: bool  # subtract the anchor's reward, or another holding's mean reward
    outcomes: int = 0  # actions learned for each move, drawn at random; 0: all


def errors(
    rule: Rule, task: ExogenousTask, moves: Move, key: PRNGKeyArray, online: Q, target: Q
) -> tuple[Float[Array, "batch learned"], Float[Array, "batch action"]]:
    """Target minus value of each learned action, from a random holding per move; and all values."""
    count = len(jax.tree.leaves(moves)[0])
    holdings = jax.vmap(task.draw_reachable)(moves.market, jax.random.split(key, count))
    values = q = online(jax.vmap(task.observe)(Position(moves.market, holdings)))
    actions = jnp.arange(q.shape[-1])
    if rule.outcomes:
        shape = (rule.outcomes, count)
        # The first holding of a batch is drawn from the same key; the others are independent.
        actions = jax.random.randint(jax.random.fold_in(key, 0), shape, 0, len(actions))
        q = jnp.take_along_axis(values, actions.T, 1)
    settle = jax.vmap(task.settle, (0, 0, 0, 0 if rule.outcomes else None))
    after = partial(settle, moves.market, moves.next_market)
    reward, next_holdings = jax.vmap(partial(after, holdings))(actions)  # (action, batch)
    if rule.market_baseline:
        # The baseline does not depend on the action: subtracting it does not change the best
        # policy, and removes the market noise that all actions share (input-dependent baselines,
        # Mao et al. 2019).
        shared = jax.vmap(task.reference)(moves.market, moves.next_market)
        if shared is None:
            others = jax.tree.map(lambda x: jnp.roll(x, 1, 0), holdings)
            shared = jax.vmap(partial(after, others))(actions)[0].mean(0)
        reward = reward - shared
    never = jnp.zeros(reward.shape[1:], bool)

    def towards(reward: Array, holding: PyTree) -> Array:
        view = jax.vmap(task.observe)(Position(moves.next_market, holding))
        q_next = target(view)
        following = bootstrap(q_next, online(view) if rule.double else q_next)
        return td_target(rule.reward_scale * reward, never, following, rule.discount)

    targets = lax.stop_gradient(jax.vmap(towards)(reward, next_holdings)).T
    return targets - q, values
