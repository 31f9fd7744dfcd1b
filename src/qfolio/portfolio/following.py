"""Following a learned policy along a price table: decisions from greedy agents, row by row."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree
from numpy.typing import ArrayLike

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent, task_jit
from qfolio.portfolio.mandate.feasible import Mandated
from qfolio.portfolio.market import Holding
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

TOLERANCE = 1e-4
"""How far targets may be outside the feasible set; they are computed in float32."""


def on_table(task: Portfolio, prices: Prices) -> Portfolio:
    """The same task over all rows of another table, with the scale of its training data."""
    first, last = jnp.array(task.window, jnp.int32), jnp.array(len(prices) - 1, jnp.int32)
    return task.on(prices).having(first_decision=first, last_decision=last)


def follow(
    task: Portfolio,
    agent: Agent,
    members: PyTree,
    first: int,
    held: Holding,
    count: int,
    *,
    together: bool = False,
) -> tuple[np.ndarray, Holding]:
    """Greedy decisions from row ``first`` on, of each member by itself or of all together.

    Together, they hold one portfolio and follow the mean of their targets. After the table's last
    row, prices do not move.

    Args:
        members: The agents' weights, with a leading seed axis.
        held: Holdings at row ``first``, made by ``begin``: one for each seed, or one if together.
        count: Number of decisions.

    Returns:
        Target weights of shape (seed or 1, count, entry), and the holdings one row after each
        decision, with the same leading axes.

    Raises:
        QfolioError: Targets are not numbers, or not feasible.
    """
    portfolios = jax.tree.map(lambda x: x[None] if together else x[:, None], members)
    found = paths(task, agent, portfolios, jnp.array(first, jnp.int32), held, count)
    wanted, targets, after = jax.tree.map(np.asarray, found)
    changed = wanted != _before(held.weights, after.weights)
    _require_feasible(task, agent, wanted, changed.any(-1), first)
    return targets, after


def begin(task: Portfolio, weights: ArrayLike, spent: float = 0.0) -> Holding:
    """Holdings of weights of shape (portfolio, entry), without earlier orders.

    spent: turnover since the calendar year began.
    """
    hold = partial(task.hold, spent=spent)
    held: Holding = jax.vmap(hold)(jnp.asarray(weights, jnp.float32))
    return held


def ordered(task: Portfolio, targets: np.ndarray, held: ArrayLike, after: np.ndarray) -> np.ndarray:
    """Whether each target is an order, of shape (seed, count); otherwise it is what is held.

    held, after: weights before the first decision, and one row after each.
    """
    if not task.calendar:
        return np.ones(targets.shape[:2], bool)
    return np.asarray((targets != _before(held, after)).any(-1))


def _before(held: ArrayLike, after: np.ndarray) -> np.ndarray:
    """Weights before each decision; ``after`` are those one row after each."""
    return np.concatenate([np.asarray(held, after.dtype)[:, None], after[:, :-1]], axis=1)


@task_jit
def paths(
    task: Portfolio, agent: Agent, members: PyTree, first: Array, held: Holding, count: int
) -> tuple[
    Float[Array, "portfolio time entry"], Float[Array, "portfolio time entry"], Holding
]:  # fmt: skip
    """The weights wanted at each row, the targets, and the holdings one row later.

    Like ``follow``, but without its checks.

    members: with leading axes (portfolio, member); a portfolio follows the mean of its members.
    """

    def step(
        members: PyTree, held: Holding, row: Array
    ) -> tuple[Holding, tuple[Array, Array, Holding]]:
        view = jax.tree.map(lambda x: x[None], task.view(row, held))

        def one(weights: PyTree) -> Array:
            return task.wanted(row, held, agent.policy(weights, view)[0])

        wanted = jax.vmap(one)(members).mean(0)
        if task.mandate:  # the mean itself may break rules on holdings or trades
            wanted = task.allow(row, held, wanted)
        target, plan = task.trade(row, held, wanted)
        after = Holding(task.drifted(row, target), held.reward, task.planned(row, plan))
        return after, (wanted, target, after)

    def path(members: PyTree, held: Holding) -> tuple[Array, Array, Holding]:
        found: tuple[Array, Array, Holding] = lax.scan(
            partial(step, members), held, first + jnp.arange(count)
        )[1]
        return found

    return jax.vmap(path)(members, held)


def _require_feasible(
    task: Portfolio, agent: Agent, wanted: np.ndarray, changed: np.ndarray, first: int
) -> None:
    """Raises QfolioError for infeasible weights; a replay would read NaN as no order.

    changed: which of the weights wanted are not those held; these may have drifted out of the set.
    """
    allowed = task.feasible
    if isinstance(allowed, Mandated) and task.patterns is not None:
        allowed = task.patterns.at(first + np.arange(wanted.shape[1]), allowed)
    for said, amount in allowed.violations(wanted).items():
        wrong = changed & ~(amount <= TOLERANCE)
        if wrong.any():
            seed, day = np.argwhere(wrong)[0]
            raise QfolioError(
                f"{type(agent).__name__} gives target weights at row {first + day} of the prices "
                f"that are not allowed: {said} {amount[seed, day]:.3g}; train it again, with a "
                "lower learning_rate if they are not numbers."
            )
