"""Following paths: where they begin, and in blocks of a few at a time."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.paths import in_blocks
from qfolio.agents.tilts import Tilts
from qfolio.core.mdp import Position, Transition
from qfolio.learning.trading import Trading
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"calendar": "100"},
        {"mandate": {"trading": {"turnover": 0.01}}},
        {"mandate": {"trading": {"fill": 3}}},
    ],
)
def test_paths_begin_at_their_targets(settings: dict[str, Any]):
    """Also on a row without a decision, and where an order leads only part of the way."""
    table = price_table(random_walk(300, 3, 0))
    task = Portfolio.of(table, window=2, horizon=8, lag=0, anchor="equal-weight", **settings)
    rows = jnp.array([120, 230]) + jnp.arange(8)[:, None]  # none of them is a hundredth
    keys = jax.random.split(jax.random.key(0), (8, 2))
    states = Position(rows, jax.vmap(jax.vmap(task.draw_holding))(keys))
    view, none = jax.vmap(jax.vmap(task.observe))(states), jnp.zeros((8, 2))
    after = states._replace(market=rows + 1)
    rollout = Transition(states, view, none, none, after, view, none, none)
    first = jnp.array([0.0, 0.6, 0.3, 0.1])
    never = Trading(jnp.array(-20.0), jnp.array(3.0))
    targets = lambda view, _: (jnp.broadcast_to(first, (*view.holding.shape[:-1], 4)),)  # noqa: E731
    agent = Tilts(rollout_length=8, head=1, num_envs=2)
    (found,), _ = agent._followed(task, rollout, (never,), targets)
    for path, start in enumerate((120, 230)):
        worth = (table.values[start : start + 9] / table.values[start]) @ np.asarray(first[1:])
        np.testing.assert_allclose(found[:, path], np.diff(np.log(worth)), atol=1e-6)


@pytest.mark.parametrize("most", [1, 5, 6, 100])
def test_blocks_of_paths_give_the_same_values_and_derivatives(most):
    wealth, moves = jax.random.uniform(jax.random.key(0), (2, 4, 6, 3))

    def grown(paths):
        start, factors = paths
        return (start[0] * jnp.cumprod(factors, 0)).sum(-1)

    def total(function, moves):
        found = function((wealth, moves))
        return (found * jnp.arange(24).reshape(4, 6)).sum(), found

    blocked = lambda paths: in_blocks(grown, paths, most)  # noqa: E731
    gradient = jax.grad(total, argnums=1, has_aux=True)
    for found, exact in zip(gradient(blocked, moves), gradient(grown, moves), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-6)
