"""Every action's value at once, where prices do not answer to our trades.

One move of the market tells what each action would have led to from any holding (hindsight learning
for exogenous inputs, Sinclair et al. 2023): the buffer keeps moves instead of transitions, holdings
are drawn anew at each update, and all actions regress together.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import ExogenousTask, Position, Task, Transition
from qfolio.learning.targets import bootstrap, td_target

Q = Callable[[PyTree], Float[Array, "batch action"]]
"""From observations to action values."""


class Move(NamedTuple):
    """What the buffer keeps: how the market moved."""

    market: PyTree
    next_market: PyTree

    @staticmethod
    def of(rollout: Transition) -> "Move":
        """A rollout's moves in one row, by time and then environment."""
        moves = Move(rollout.state.market, rollout.next_state.market)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), moves)


def require_plain(agent: Any) -> None:
    """Raises QfolioError where an agent wants what moves and holdings drawn anew do not give."""
    plain: dict[str, Any] = {
        "values": "expected", "n_steps": 1, "prioritized": False, "noisy": False,
        "persistence": 0.0, "value_rescaling": False,
    }  # fmt: skip
    for name, value in plain.items():
        if getattr(agent, name) != value:
            raise QfolioError(
                "all_actions learns expected values from single moves, all drawn alike, and needs "
                f"no exploration; take {name}={str(value).lower()}, or all_actions=false."
            )


def require_exogenous(task: Task) -> None:
    """Raises QfolioError where a move does not tell what every action leads to."""
    if not isinstance(task, ExogenousTask):
        raise QfolioError(
            "all_actions needs a market, whose prices do not answer to actions; "
            f"{type(task).__name__} is none."
        )
    if getattr(task, "reward", "") == "differential-sharpe":
        raise QfolioError(
            "all_actions draws holdings without a past, and differential-sharpe rewards "
            "what comes after one; take reward=crra, or all_actions=false."
        )


def errors(
    agent: Any,
    task: ExogenousTask,
    moves: Move,
    key: PRNGKeyArray,
    online: Q,
    target: Q,
) -> tuple[Float[Array, "batch action"], Float[Array, "batch action"]]:
    """Goal less value for every action from a holding drawn for each move, and the values.

    With the agent's ``market_baseline`` rewards count from what the same move pays another holder,
    on average over actions.
    """
    count = len(jax.tree.leaves(moves)[0])
    holdings = jax.vmap(task.draw_holding)(jax.random.split(key, count))
    q = online(jax.vmap(task.observe)(Position(moves.market, holdings)))

    def after(holdings: PyTree, action: Array) -> tuple[Array, PyTree]:
        settle = jax.vmap(task.settle, (0, 0, 0, None))
        return settle(moves.market, moves.next_market, holdings, action)

    actions = jnp.arange(q.shape[-1])
    reward, next_holdings = jax.vmap(partial(after, holdings))(actions)  # (action, batch)
    if agent.market_baseline:
        # It depends on the market alone: taking it off leaves the best policy as it is, and takes
        # off what all actions have in common of the market's noise (input-dependent baselines, Mao
        # et al. 2019).
        others = jax.tree.map(lambda x: jnp.roll(x, 1, 0), holdings)
        reward = reward - jax.vmap(partial(after, others))(actions)[0].mean(0)
    never = jnp.zeros(reward.shape[1:], bool)

    def goal(reward: Array, holding: PyTree) -> Array:
        view = jax.vmap(task.observe)(Position(moves.next_market, holding))
        q_next = target(view)
        following = bootstrap(q_next, online(view) if agent.double else q_next)
        return td_target(agent.reward_scale * reward, never, following, agent.discount)

    goals = lax.stop_gradient(jax.vmap(goal)(reward, next_holdings)).T
    return goals - q, q
