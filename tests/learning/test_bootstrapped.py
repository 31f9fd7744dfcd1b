"""Bootstrapped heads: their samples of the data, and cautious choices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.hindsight import Move
from qfolio.core.errors import QfolioError
from qfolio.learning.bootstrapped import BLOCKS, Heads, cautious, samples
from qfolio.portfolio.synthetic.merton import Merton
from qfolio.portfolio.task import Portfolio
from qfolio.report.contrast import contrast_of

from planted import persistent

KEY = jax.random.key(0)


def planted():
    """A table of persistent relative returns, and the momentum that shows them."""
    return Portfolio.of(
        persistent(), window=1, horizon=64, anchor="equal-weight", menu="signals:1",
        signals="momentum:21,volatility:21",
    )  # fmt: skip


def agent(**changes):
    return DQN(**{
        "network": "positions", "all_actions": True, "market_baseline": True, "outcomes": 2,
        "bootstrap_heads": 4, "num_envs": 8, "batch_size": 64, "replay_capacity": 512,
        "learning_starts": 512, "learning_rate": 0.03, "reward_scale": 100.0, "discount": 0.9,
        "target_update_interval": 1, "tau": 0.1, **changes,
    })  # fmt: skip


def test_a_cautious_choice_by_hand():
    values = jnp.array([[[5.0, 6.0, 8.0]], [[1.0, 3.0, 2.0]]])  # two heads, one state
    np.testing.assert_allclose(cautious(values, 0.0), [[0, 1.5, 2]])
    np.testing.assert_allclose(cautious(values, 1.0), [[0, 1.5 - 0.5**0.5, 2 - 2**0.5]])
    np.testing.assert_allclose(cautious(values, 1e6).argmax(-1), [0])


def test_each_head_counts_the_same_half_of_the_blocks_twice():
    task = planted()
    rows = task.first_decision + jnp.arange(int(task.moves))
    counts = np.asarray(samples(task, rows, 50))
    assert set(np.unique(counts)) == {0, 2}
    assert abs(counts.mean() - 1) < 0.1
    assert (np.diff(counts, axis=1) != 0).sum(1).max() < BLOCKS, "whole blocks"
    np.testing.assert_array_equal(counts, samples(task, rows, 50))
    drawn_anew = Merton()
    market = jax.vmap(drawn_anew.reset_market)(jax.random.split(KEY, 3))
    np.testing.assert_array_equal(samples(drawn_anew, market, 2), np.ones((2, 3)))


def test_values_begin_at_zero_and_the_first_action_is_the_way_to_the_anchor():
    task, dqn = planted(), agent(caution=1.0)
    state = dqn.init(task, KEY)
    assert isinstance(state.online, Heads)
    view = jax.tree.map(lambda x: x[None], task.observe(task.reset(KEY)))
    np.testing.assert_array_equal(dqn.policy(dqn.weights(state), view), [0])


def trained(dqn, task, updates):
    """After updates on all moves of the task's data."""
    state = dqn.init(task, KEY)
    rows = task.first_decision + jnp.arange(512, dtype=jnp.int32)
    replay = state.replay.extend(Move(rows, rows + 1))

    def update(carry, key):
        learned, target = carry
        learned, _ = dqn._update(task, replay, target, learned, key)
        target = jax.tree.map(lambda old, new: old + dqn.tau * (new - old), target, learned[0])
        return (learned, target), None

    start = ((state.online, state.optimizer, None), state.target)
    keys = jax.random.split(KEY, updates)
    return jax.jit(lambda: jax.lax.scan(update, start, keys)[0][0][0])()


def test_planted_momentum_is_found_and_tilted_to():
    task = planted()
    dqn = agent(caution=1.0)
    weights = trained(dqn, task, 200)
    linear = weights.networks.linear
    assert (linear[:, 0] > 0).all(), "every head values momentum"
    held = jnp.append(0.0, jnp.full(6, 1 / 6))
    views = jax.vmap(lambda row: task.view(row, task.hold(held)))(jnp.arange(100, 600, 5))
    assert (dqn.policy(weights, views) == 1).mean() > 0.5, "towards winners of the last month"
    unsure = agent(caution=1000.0).policy(weights, views)
    assert (unsure == 0).all(), "nobody can be that sure: it follows the anchor"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"all_actions": False}, "bootstrap_heads is for moves of a market; set all_actions=true"),
        ({"bootstrap_heads": 1, "caution": 1.0}, "caution compares heads"),
        ({"bootstrap_heads": 0}, "bootstrap_heads is 0"),
        ({"caution": -1.0}, "caution is -1"),
        ({"batch_size": 1}, "market_baseline compares"),
    ],
)
def test_settings_that_do_not_fit(changes, message):
    with pytest.raises(QfolioError, match=message):
        agent(**changes)


def test_a_report_compares_heads_with_one_network():
    contrast = contrast_of(agent(caution=1.0))
    assert contrast is not None
    alone = {"all_actions": False, "outcomes": 0, "market_baseline": False, "bootstrap_heads": 1}
    assert contrast.variant == agent(**alone)


def test_positions_need_a_menu_of_signals():
    with pytest.raises(QfolioError, match="network=positions is for portfolios"):
        agent().init(Merton(menu="grid:2"), KEY)
    with pytest.raises(QfolioError, match="plain action values"):
        agent(dueling=True).init(planted(), KEY)
