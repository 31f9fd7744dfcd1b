"""Mandates that allow short sales and loans: actions, tilts, and what agents learn."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.tilts import tilted
from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Box, Simplex
from qfolio.core.registry import find
from qfolio.core.training import begin
from qfolio.experiments.presets import preset
from qfolio.learning.networks import last_layer
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.market import RUIN
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.task import Portfolio

from planted import planted
from tables import price_table

MANDATE = {
    "assets": {"cap": 0.5, "floor": -0.3},
    "cash": {"min": 0.0, "max": 0.3},
    "exposure": {"gross": 1.6},
}


def test_an_action_is_the_weights_of_the_assets() -> None:
    task = Portfolio.of(planted(200), window=5, horizon=10, mandate=MANDATE)
    assert task.actions == Box(6, 0.5)
    row, held = jnp.array(50), jnp.eye(7)[0]
    assets = jnp.array([0.5, 0.4, 0.3, -0.1, -0.1, -0.1])
    weights = jnp.append(1 - assets.sum(), assets)
    for action in (assets, weights):
        np.testing.assert_allclose(task.target(row, task.hold(held), action), weights, atol=1e-6)
    # Half as much again is more than the mandate allows.
    order = task.target(row, task.hold(held), 1.5 * assets)
    assert abs(order[1:]).sum() <= 1.6 + 1e-5
    assert order[0] >= -1e-6
    assert order[1:].max() <= 0.5 + 1e-6


def test_without_debts_actions_are_weights() -> None:
    mandate = {"assets": {"cap": 0.5}}
    task = Portfolio.of(planted(200), window=5, horizon=10, mandate=mandate)
    assert task.actions == Simplex(6, 0.5)


def test_tilts_may_go_below_zero() -> None:
    anchor, scores = jnp.array([0.4, 0.4, 0.0]), jnp.array([3.0, -1.0, 9.0])
    # Of each score its mean over the two open assets is taken, times an equal share of 0.4.
    long_short = tilted(anchor, scores, Box(3, 1.0))
    np.testing.assert_allclose(long_short, [0.2, 1.2, -0.4, 0.0], atol=1e-6)
    np.testing.assert_allclose(tilted(anchor, scores, Simplex(3)), [0.2, 0.8, 0, 0], atol=1e-6)


def test_holdings_may_be_short_where_the_mandate_allows_it() -> None:
    found, agent = {}, preset("fast", "portfolio", "tilts").build()
    for mandate in (MANDATE, {"assets": {"cap": 0.5}}):
        task = Portfolio.of(planted(200), window=5, horizon=10, mandate=mandate)
        found[task.feasible.long_only] = Policy(task, agent, None, planted(200).assets)
    names = planted(200).assets
    held = {names[0]: 1.3, names[1]: -0.4, "cash": 0.1}
    np.testing.assert_allclose(found[False].holdings(held)[:3], [0.1, 1.3, -0.4])
    assert found[False].holdings({names[0]: 1.25})[0] == pytest.approx(-0.25)
    with pytest.raises(QfolioError, match="it must be a number from 0 to 1"):
        found[True].holdings(held)


def test_a_policy_of_weights_says_what_it_is_for() -> None:
    task = Portfolio.of(planted(200), window=5, horizon=10, mandate=MANDATE)
    ppo = preset("fast", "portfolio", "ppo").build()
    with pytest.raises(QfolioError, match="which Portfolio has not; set network=flat"):
        ppo.init(task, jnp.zeros(2, jnp.uint32))


@pytest.mark.parametrize("kind", ["ppo", "sac", "td3"])
def test_a_network_that_assets_share_tells_them_apart(kind: str) -> None:
    """In another order, each asset keeps its outputs; means over all would be those of each."""
    task = Portfolio.of(planted(200), window=5, horizon=10, mandate=MANDATE)
    agent = settings.build(find("agent", kind), {"network": "mlp", "hidden": (8,)})
    view, key = task.observe(task.reset(jax.random.key(0))), jax.random.key(1)
    actor = agent.init(task, key).weights.actor if kind == "ppo" else None
    network = actor or agent.begin(task, view, key).actor.network
    network = eqx.tree_at(last_layer, network, replace_fn=lambda x: x + 0.3)
    order = jnp.array([2, 0, 3, 1, 5, 4])
    found = network(jax.tree.map(lambda x: x[None], view)).reshape(-1, 6)
    again = network(jax.tree.map(lambda x: x[None, order], view)).reshape(-1, 6)
    np.testing.assert_allclose(again, found[:, order], atol=1e-5)
    assert np.ptp(found, -1).min() > 1e-3


@pytest.mark.parametrize("agent", ["tilts", "pathwise"])
def test_actions_may_give_cash_or_leave_it_to_the_rest(agent: str) -> None:
    """What is checked before the first step accepts both."""
    chosen = preset("fast", "portfolio", agent)
    task = Portfolio.of(planted(900), mandate=MANDATE, **chosen.task)
    jax.eval_shape(partial(begin, task, chosen.build()), jnp.uint32(0))


@pytest.mark.slow
def test_what_is_learned_sells_short_within_the_mandate() -> None:
    few = preset("fast", "portfolio", "pathwise")._replace(episodes=192)
    backtest = Backtest.create(
        planted(900),
        {"pathwise": few},
        train="2y",
        test="9m",
        seeds=1,
        mandate=MANDATE,
        baselines=("minimum-variance",),
        cost_model="itemized(borrow_fee=0.01)",
    )
    backtest.run()
    entries, notes = backtest.entries()
    assert [note for note in notes if "figures a year" not in note] == []  # of a short test
    orders = entries["pathwise"].decisions
    assert orders[..., 1:].min() < -0.02
    assert abs(orders[..., 1:]).sum(-1).max() <= 1.6 + 1e-4
    assert orders[..., 0].min() >= -1e-4
    growth = {name: entry.simulation.growth.mean() for name, entry in entries.items()}
    assert growth["pathwise"] > growth["equal-weight"]
    assert backtest.assess(entries).bound is None  # constant weights with debts have none


@pytest.mark.parametrize(("lag", "later"), [(1, 240.0), (2, 240.0), (2, 120.0)])
def test_an_order_that_is_worth_nothing_while_it_waits_is_ruin(lag: int, later: float) -> None:
    values = np.full((40, 1), 100.0)
    values[21:] = 230.0  # a short position of the whole wealth cannot be paid back
    values[21 + lag - (later == 120) :] = later
    mandate = {"assets": {"floor": -1.0}, "cash": {"max": 2.0}, "exposure": {"gross": 1.0}}
    task = Portfolio.of(price_table(values), window=5, horizon=5, lag=lag, mandate=mandate)
    row, order = jnp.array(20), jnp.array([2.0, -1.0])
    cash = task.hold(jnp.array([1.0, 0.0]))
    reward, after = task.settle(row, row + 1, cash, order)
    assert float(reward) == pytest.approx(np.log(RUIN), abs=1e-5)
    np.testing.assert_array_equal(after.weights, [1, 0])
    # It is worth nothing from the start of the wait on, too.
    if later == 120:  # it is worth something again when it is executed
        return
    short = task.hold(order)
    reward, after = task.settle(row, row + 1, short, jnp.array([1.0, 0.0]))
    assert float(reward) == pytest.approx(np.log(RUIN), abs=1e-5)
