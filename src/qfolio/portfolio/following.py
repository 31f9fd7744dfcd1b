"""Following a learned policy along a price table: decisions from greedy agents, row by row."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

TOLERANCE = 1e-4
"""How far targets may be outside the feasible set; they are computed in float32."""


def on_table(task: Portfolio, prices: Prices) -> Portfolio:
    """The same task over all rows of another table, with the scale of its training data."""
    rows = jnp.array(task.window, jnp.int32), jnp.array(len(prices) - 1, jnp.int32)
    where = lambda t: (t.first_decision, t.last_decision)  # noqa: E731
    return eqx.tree_at(where, task.on(prices), rows)


def follow(
    task: Portfolio,
    agent: Agent,
    members: PyTree,
    first: int,
    held: np.ndarray,
    count: int,
    *,
    together: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Greedy decisions from row ``first`` on: of each member by itself, or of all together.

    Together, they hold one portfolio and follow the mean of their targets. After the table's last
    row prices do not move.

    Args:
        members: The agents' weights, with a leading seed axis.
        held: Weights at row ``first``, shape (seed, entry), or (1, entry) if together.
        count: Number of decisions.

    Returns:
        Target weights, and the weights held one row after each decision, both of shape
        (seed or 1, count, entry).

    Raises:
        QfolioError: Targets are not numbers, or not feasible.
    """
    portfolios = jax.tree.map(lambda x: x[None] if together else x[:, None], members)
    start = jnp.array(first, jnp.int32), jnp.asarray(held, jnp.float32)
    results = paths(task, agent, portfolios, *start, count)
    targets, after = (np.asarray(result) for result in results)
    _require_feasible(task, agent, targets, first, ordered(task, targets, held, after))
    return targets, after


def ordered(
    task: Portfolio, targets: np.ndarray, held: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Where targets are orders, of shape (seed, count); between, they are what is held.

    held, after: as ``follow`` takes and returns them.
    """
    if not task.calendar:
        return np.ones(targets.shape[:2], bool)
    before = np.concatenate([held[:, None].astype(after.dtype), after[:, :-1]], axis=1)
    return np.asarray((targets != before).any(-1))


@eqx.filter_jit(donate="none")
def paths(
    task: Portfolio, agent: Agent, members: PyTree, first: Array, held: Array, count: int
) -> tuple[Float[Array, "portfolio time entry"], Float[Array, "portfolio time entry"]]:
    """Targets, and weights held one row later, without the checks of ``follow``.

    members: with leading axes (portfolio, member); a portfolio follows the mean of its own.
    """

    def step(members: PyTree, held: Array, row: Array) -> tuple[Array, tuple[Array, Array]]:
        view = jax.tree.map(lambda x: x[None], task.view(row, held))

        def one(weights: PyTree) -> Array:
            return task.wanted(row, held, agent.policy(weights, view)[0])

        target = task.obeying(row, held, jax.vmap(one)(members).mean(0))
        after = task.drifted(row, target)
        return after, (target, after)

    def path(members: PyTree, held: Array) -> tuple[Array, Array]:
        return lax.scan(partial(step, members), held, first + jnp.arange(count))[1]

    return jax.vmap(path)(members, held)


def _require_feasible(
    task: Portfolio, agent: Agent, targets: np.ndarray, first: int, given: np.ndarray
) -> None:
    """Raises QfolioError for infeasible orders; a replay would read NaN as no order.

    given: where targets are orders; elsewhere, what is held may have drifted outside.
    """
    for said, amount in task.feasible.violations(targets).items():
        wrong = ~(amount <= TOLERANCE) & (given | np.isnan(amount))
        if wrong.any():
            seed, day = np.argwhere(wrong)[0]
            raise QfolioError(
                f"{type(agent).__name__} gives target weights at row {first + day} of the prices "
                f"that are not allowed: {said} {amount[seed, day]:.3g}; train it again, with a "
                "lower learning_rate if they are not numbers."
            )
