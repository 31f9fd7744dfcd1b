"""Networks that are linear in positions, and the agents that learn with them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.market import View
from qfolio.core.population import Population
from qfolio.experiments.presets import PRESETS
from qfolio.learning.positions import LEAST_CASH, OrderValue, Tilting, Values
from qfolio.portfolio.synthetic.merton import Merton
from qfolio.portfolio.task import Portfolio

from planted import persistent
from populations import train_to

SIGNALS = [[1.0, 0.5], [0.0, -1.0], [-1.0, 0.5]]


def view(held=(0.5, 0.3, 0.2), anchor=(0.25, 0.25, 0.5)):
    """One observation of three assets: a return that no network reads, and two signals."""
    features = np.concatenate([np.full((3, 1), 99.0), SIGNALS], 1)[None, :, None]
    return View(jnp.asarray(features, jnp.float32), jnp.array([held]), jnp.array([anchor]))


def test_a_new_policy_goes_part_of_the_way_to_the_anchor():
    weights = jax.nn.softmax(Tilting(view(), spread=False)(view()))[0]
    order = 0.7 * np.array([0.5, 0.3, 0.2]) + 0.3 * np.array([0.25, 0.25, 0.5])
    np.testing.assert_allclose(weights, [LEAST_CASH, *order] / np.array(1 + LEAST_CASH), rtol=1e-5)


def test_tilts_by_hand():
    network = eqx.tree_at(
        lambda n: (n.linear, n.rate), Tilting(view(), spread=True),
        (jnp.array([1.0, 2.0]), jnp.array(100.0)),
    )  # fmt: skip
    tilted = np.array([0.25, 0.25, 0.5]) * np.exp(np.array(SIGNALS) @ [1.0, 2.0])
    output = network(view())[0]
    np.testing.assert_allclose(jnp.exp(output[1:4]), tilted / tilted.sum(), rtol=1e-5)
    np.testing.assert_allclose(jnp.exp(output[4:]), 0.3, rtol=1e-5)


def test_an_order_is_worth_what_the_same_entry_of_a_menu_is():
    orders = jnp.array([[0.4, 0.4, 0.2], [0.0, 0.0, 0.0]])
    learned = (jnp.array([1.0, 2.0]), jnp.array(0.1), jnp.array(0.2), jnp.array(5.0))
    learn = lambda network: eqx.tree_at(  # noqa: E731
        lambda n: (n.linear, n.price, n.way_back, n.value), network, learned
    )
    by_menu = learn(Values(view()))(view()._replace(choices=orders[None]))
    assert by_menu[0, 0] == pytest.approx(
        5 + (0.15 * 2 - 0.15 * 2 - 0.3 * 0) - 0.1 * 0.2 - 0.2 * 0.6
    )
    for i, order in enumerate(orders):
        found = OrderValue(learn(Values(view())))(
            (view(), jnp.append(1 - order.sum(), order)[None])
        )
        assert found.shape == (1, 1)
        assert found[0, 0] == pytest.approx(float(by_menu[0, i]), abs=1e-6)
    held = learn(Values(view()))(view())
    assert held.shape == (1, 1), "without choices: the positions held, which cost nothing"


def test_no_gradient_is_lost_where_an_asset_cannot_be_held():
    shut = view(held=(1.0, 0.0, 0.0), anchor=(0.5, 0.5, 0.0))
    gradient = jax.grad(lambda n: (n(shut) ** 2).sum())(Tilting(shut, spread=False))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_an_anchor_in_cash_is_tilted_to_cash():
    empty = view(held=(0.5, 0.3, 0.2), anchor=(0.0, 0.0, 0.0))
    order = jax.nn.softmax(Tilting(empty, spread=False)(empty))[0]
    np.testing.assert_allclose(order, [0.3, 0.35, 0.21, 0.14], rtol=1e-5)
    gradient = jax.grad(lambda n: (n(empty) ** 2).sum())(Tilting(empty, spread=False))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def planted(**changes):
    """A table of persistent relative returns, and the momentum that shows them."""
    settings = {
        "window": 1, "horizon": 50, "active": True, "anchor": "equal-weight",
        "signals": "momentum:21,volatility:21", **changes,
    }  # fmt: skip
    return Portfolio.of(persistent(market=0.01), **settings)


def test_active_rewards_are_those_over_the_anchors():
    task, total = planted(), planted(active=False)
    state = task.reset(jax.random.key(0))
    moved = task.next_market(state.market, jax.random.key(1))
    order = jnp.array([0.1, 0.4, 0.1, 0.1, 0.1, 0.1, 0.1])
    active, after = task.settle(state.market, moved, state.holding, order)
    reward, same = total.settle(state.market, moved, state.holding, order)
    anchor = total.hold(jnp.append(0.0, jnp.full(6, 1 / 6)))
    held = total.settle(state.market, moved, anchor, anchor.weights)[0]
    assert active == pytest.approx(float(reward - held), abs=1e-7)
    np.testing.assert_array_equal(after.weights, same.weights)
    averse = planted(tracking_aversion=200.0)
    less = averse.settle(state.market, moved, state.holding, order)[0]
    assert less == pytest.approx(float(active - 100 * active**2), abs=1e-7)
    assert abs(task.settle(state.market, moved, anchor, anchor.weights)[0]) < 1e-7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"anchor": ""}, "set an anchor"),
        ({"active": False, "tracking_aversion": 1.0}, "set active=true, or tracking_aversion=0"),
        ({"reward": "differential-sharpe"}, "depends on earlier ones"),
    ],
)
def test_active_rewards_that_make_no_sense(changes, message):
    with pytest.raises(QfolioError, match=message):
        planted(**changes)


@pytest.mark.parametrize(
    "changes", [{"anchor": "", "active": False}, {"signals": ""}, {"menu": "tilts:0.1"}]
)
def test_tasks_without_positions_to_tilt(changes):
    agent = PRESETS["portfolio", "ppo"]["fast"].build()
    with pytest.raises(QfolioError, match="network=positions is for portfolios with signals"):
        agent.init(planted(**changes), jax.random.key(0))
    with pytest.raises(QfolioError, match="which Merton has not"):
        agent.init(Merton(), jax.random.key(0))


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "name",
    [
        "ppo",
        *(pytest.param(name, marks=SLOW) for name in ("a2c", "reinforce", "ddpg", "td3", "sac")),
    ],
)
def test_each_agent_finds_planted_momentum(name):
    off_policy = name in ("sac", "ddpg", "td3")
    decay = 600.0 if off_policy else 300.0
    agent = PRESETS["portfolio", name]["fast"].build(learning_rate_steps=decay)
    population = Population(planted(), agent, [0, 1, 2])
    train_to(population, 300 if off_policy else 2400)
    leaves = jax.tree.leaves(population.weights(), is_leaf=lambda x: isinstance(x, Tilting))
    (network,) = [leaf for leaf in leaves if isinstance(leaf, Tilting)]
    momentum, volatility = np.asarray(network.linear).T
    assert (momentum > 0.05).all(), "every seed buys winners"
    assert momentum.std() < momentum.mean() / 5, "as much as any other"
    assert abs(volatility.mean()) < momentum.mean(), "and cares less about what says nothing"
