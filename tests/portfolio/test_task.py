from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.pathwise import Pathwise
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import evaluate, start_keys
from qfolio.core.market import MenuActions
from qfolio.core.mdp import Discrete, Position, Simplex, Transition
from qfolio.core.population import Population
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.costs import drift
from qfolio.portfolio.following import begin, follow
from qfolio.portfolio.menu import Menu, Signalled
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from populations import train_to
from tables import featured_table, price_table, random_walk

ROWS, ASSETS, WINDOW = 60, 3, 5


def table(features=0):
    return featured_table(ROWS, features)


def portfolio(prices=None, **settings):
    prices = table() if prices is None else prices
    return Portfolio.of(prices, **{"window": WINDOW, "horizon": 10, **settings})


@pytest.mark.parametrize("lag", [0, 1, 2])
@pytest.mark.parametrize("menu", ["", "tilts:0.2"])
def test_rewards_are_the_log_returns_of_the_replay(lag, menu):
    """The task pays, in float32, what the float64 replay of the same decisions earns.

    It measures the same turnover and cost, too.
    """
    task, prices = portfolio(lag=lag, menu=menu, cost=0.01), table()
    state = Position(task.first_decision, task.hold(jnp.array([1.0, 0, 0, 0])))
    rng, decisions, rewards, measured = np.random.default_rng(1), [], [], []
    for _ in range(20):
        action = jnp.array(rng.integers(task.actions.n) if menu else rng.dirichlet(np.ones(4)))
        action = action.astype(jnp.int32 if menu else jnp.float32)
        decisions.append(np.asarray(task.intent(state, action), float))
        step = task.step(state, action, jax.random.key(0))
        rewards.append(float(step.reward))
        end = jnp.array(False)
        now = Transition(state, (), action, step.reward, step.state, (), end, end)
        measured.append({name: float(x) for name, x in task.measure(now).items()})
        state = step.state
    decisions = np.array(decisions) / np.sum(decisions, axis=1, keepdims=True)
    replay = simulate(prices.values, decisions, first=WINDOW, cost=0.01, lag=lag)
    np.testing.assert_allclose(rewards, replay.growth, atol=2e-6)
    for name in ("growth", "turnover", "cost"):
        column = [each[name] for each in measured]
        np.testing.assert_allclose(column, getattr(replay, name), atol=5e-6, err_msg=name)
    np.testing.assert_allclose([each["cash"] for each in measured], decisions[:, 0], atol=1e-6)
    assert all(0.99 < each["assets"] < ASSETS + 1e-3 for each in measured if each["cash"] < 0.99)


def test_an_equal_weight_is_at_its_anchor_and_holds_all_assets():
    task = portfolio(anchor="equal-weight", lag=0)
    state = Position(task.first_decision, task.hold(jnp.array([1.0, 0, 0, 0])))
    action, end = jnp.array([0.0, 1, 1, 1]) / 3, jnp.array(False)
    step = task.step(state, action, jax.random.key(0))
    measured = task.measure(Transition(state, (), action, step.reward, step.state, (), end, end))
    assert measured["distance"] == pytest.approx(0, abs=1e-5)
    assert measured["assets"] == pytest.approx(ASSETS, rel=1e-5)
    assert measured["cash"] == pytest.approx(0, abs=1e-6)


def test_no_order_is_free_at_any_lag():
    task = portfolio(menu="tilts:0.5", lag=2, cost=0.1)
    held = task.hold(jnp.array([0.1, 0.2, 0.3, 0.4]))
    state = Position(task.first_decision, held)
    reward = task.step(state, jnp.array(0), jax.random.key(0)).reward
    moved = task.relatives(task.first_decision, task.first_decision + 1)
    after = drift(held.weights, moved.waiting)
    np.testing.assert_allclose(reward, jnp.log(after[0] + after[1:] @ moved.earning), atol=1e-6)


def test_a_window_ends_today():
    prices = table()
    task = portfolio(prices)
    logs = np.diff(np.log(prices.values), axis=0)
    seen = task.features(jnp.array(20))[..., 0] * task.scale[0]
    np.testing.assert_allclose(seen, logs[20 - WINDOW : 20].T, rtol=1e-4, atol=1e-7)


def test_extra_features_are_standardised_over_the_part():
    prices = table(features=2)
    task = portfolio(prices).part(10, 40)
    part = prices.features[11:41]
    expected = (prices.features[30] - part.mean((0, 1))) / part.std((0, 1))
    np.testing.assert_allclose(task.features(jnp.array(30))[:, -1, 1:], expected, atol=1e-4)


def test_a_part_knows_nothing_of_the_rest():
    """Starts, windows, rewards and scales come from the rows of the part alone."""
    prices = table()
    later = prices.values.copy()
    later[41:] *= 7.0
    later[:10] *= 5.0
    other = Prices(prices.dates, prices.assets, later)
    one, two = (portfolio(p, lag=1).part(10, 40) for p in (prices, other))
    assert (int(one.first_decision), int(one.last_decision)) == (10 + WINDOW, 40 - 2)
    np.testing.assert_array_equal(one.scale, two.scale)
    for row in range(int(one.first_decision), int(one.last_decision) + 1):
        np.testing.assert_array_equal(one.features(jnp.array(row)), two.features(jnp.array(row)))
        for x, y in zip(
            *(task.relatives(jnp.array(row), jnp.array(row + 1)) for task in (one, two)),
            strict=True,
        ):
            np.testing.assert_array_equal(x, y)
    starts = jax.vmap(one.reset_market)(start_keys(500))
    assert starts.min() == one.first_decision
    assert starts.max() == one.last_decision - one.horizon + 1


def test_no_value_is_judged_by_rows_behind_the_part():
    """The last decision's outcome is the last that is known; nothing repeats it."""
    task = portfolio().part(0, 40)
    state = Position(task.last_decision, task.hold(jnp.ones(4) / 4))
    assert int(task.steps_left(state)) == 1
    agent = DQN(network="flat", hidden=(4,), discount=0.9)
    chosen = portfolio(menu="tilts:0.2").part(0, 40)
    weights = agent.weights(agent.init(chosen, jax.random.key(0)))
    known = evaluate(chosen, agent, weights, start_keys(64), 14).overestimation
    assert np.isfinite(known)  # of starts up to row 15
    assert np.isnan(evaluate(chosen, agent, weights, start_keys(64), 25).overestimation)


AGENTS = {
    "dqn": (DQN(network="mlp", hidden=(8, 8), all_actions=True, num_envs=2, batch_size=8,
                learning_starts=20, replay_capacity=100, episode_steps=0), "tilts:0.1"),
    "dqn-single": (DQN(network="flat", hidden=(8,), num_envs=2, batch_size=8,
                       learning_starts=20, replay_capacity=100, episode_steps=0), "tilts:0.1"),
    "pathwise": (Pathwise(rollout_length=5, num_envs=4, hidden=(8, 8), learning_rate=0.03), ""),
    "pathwise-cnn": (Pathwise(network="cnn", rollout_length=5, num_envs=4, hidden=(8, 8)), ""),
    "pathwise-rnn": (Pathwise(network="rnn", rollout_length=5, num_envs=4, hidden=(8, 8)), ""),
}  # fmt: skip


QUICK = ("pathwise",)


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in AGENTS],
)
def trained(request):
    agent, menu = AGENTS[request.param]
    task = portfolio(menu=menu, signals="momentum:8-2,volatility:5").part(0, 40)
    return task, agent, train_to(Population(task, agent, [0, 1]), 60).weights()


def test_no_agent_looks_ahead(trained):
    """Changing every price after t changes no weight decided up to t."""
    task, agent, members = trained
    start = begin(task, np.tile([1.0, 0, 0, 0], (2, 1)))
    targets, _ = follow(task, agent, members, 40, start, 20)
    assert np.isfinite(targets).all()
    for seed in range(5):
        rng = np.random.default_rng(seed)
        t = int(rng.integers(40, ROWS - 1))
        other = table().values.copy()
        other[t + 1 :] *= np.exp(rng.normal(0, 0.5, other[t + 1 :].shape))
        changed = task.on(Prices(table().dates, ("a", "b", "c"), other))
        again, _ = follow(changed, agent, members, 40, start, 20)
        np.testing.assert_array_equal(again[:, : t - 39], targets[:, : t - 39])
        assert not np.array_equal(changed.log_relatives, task.log_relatives)


def test_weights_stay_on_the_simplex(trained):
    task, agent, members = trained
    start = begin(task, np.tile([1.0, 0, 0, 0], (2, 1)))
    targets, held = follow(task, agent, members, 40, start, 20)
    for weights in (targets, np.asarray(held.weights)):
        np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-5)
        assert weights.min() >= 0


def test_agents_do_not_depend_on_the_order_of_columns(trained):
    task, agent, members = trained
    if getattr(agent, "network", "") == "flat":
        pytest.skip("a flat network reads columns in their order")
    order = np.array([2, 0, 1])
    own = table()
    assets = tuple(own.assets[i] for i in order)
    shuffled = task.on(Prices(own.dates, assets, own.values[:, order]))
    start = np.tile([0.4, 0.3, 0.2, 0.1], (2, 1))
    targets, _ = follow(task, agent, members, 40, begin(task, start), 1)
    entries = np.append(0, 1 + order)
    again, _ = follow(shuffled, agent, members, 40, begin(task, start[:, entries]), 1)
    np.testing.assert_allclose(again, targets[..., entries], atol=1e-5)


def test_limits():
    values = table().values.copy()
    values[:30, 1] = np.nan
    task = portfolio(Prices(table().dates, ("a", "b", "c"), values), max_weight=0.4)
    np.testing.assert_allclose(task.limits, [0.4, 0, 0.4])
    target = task.target(jnp.array(0), task.hold(jnp.eye(4)[0]), jnp.array([0.1, 0.5, 0.3, 0.1]))
    np.testing.assert_allclose(target, [0.5, 0.4, 0, 0.1], atol=1e-6)
    assert task.part(30, 59).limits.min() == pytest.approx(0.4)


def test_menus():
    grid = Menu("grid:4", jnp.ones(1))
    assert grid.actions == Discrete(5)
    np.testing.assert_allclose(grid.weights(jnp.array([1.0, 0]), jnp.array(3)), [0.25, 0.75])
    tilts = Menu("tilts:0.1", jnp.ones(2))
    assert tilts.actions == MenuActions(7, pooled=3, each=2)
    held = jnp.array([0.5, 0.3, 0.2])
    choices = [tilts.weights(held, jnp.array(i)) for i in range(7)]
    expected = [held, [1, 0, 0], [0, 0.5, 0.5], [0, 1, 0], [0, 0, 1], [0.45, 0.37, 0.18],
                [0.45, 0.27, 0.28]]  # fmt: skip
    np.testing.assert_allclose(choices, np.array(expected), atol=1e-6)
    some = Menu("tilts:0.1", jnp.array([0.5, 0.0, 0.5]))
    np.testing.assert_allclose(some.weights(jnp.ones(4) / 4, jnp.array(2)), [0, 0.5, 0, 0.5])
    over = Menu("overweight:0.1", jnp.ones(2))
    assert over.actions == MenuActions(5, pooled=3, each=1)
    choices = [over.weights(held, jnp.array(i)) for i in (0, 2, 3, 4)]
    expected = [held, [0, 0.5, 0.5], [0, 0.55, 0.45], [0, 0.45, 0.55]]
    np.testing.assert_allclose(choices, np.array(expected), atol=1e-6)
    assert portfolio().actions == Simplex(3)


def test_a_menu_of_signals_by_hand():
    menu = Menu("signals:2", jnp.ones(2), signals=1)
    assert menu.actions == MenuActions(3, pooled=3, each=0)
    start = Signalled(jnp.array([0.5, 0.5]), jnp.array([[1.0], [-1.0]]))

    def orders(held):
        return [menu.weights(jnp.asarray(held), jnp.array(i), start) for i in range(3)]

    up, down = np.array([[0, np.exp(2), np.exp(-2)], [0, np.exp(-2), np.exp(2)]]) / (2 * np.cosh(2))
    equal = np.array([0, 0.5, 0.5])
    # Idle cash is invested at once.
    np.testing.assert_allclose(orders([1.0, 0, 0]), [equal, up, down], atol=1e-6)
    # The anchor's band reaches from 0.4 to 0.6; a tilt has none.
    for held, anchored in (([0, 0.58, 0.42], [0, 0.58, 0.42]), ([0, 0.7, 0.3], [0, 0.67, 0.33])):
        tilts = [0.7 * np.array(held) + 0.3 * tilt for tilt in (up, down)]
        np.testing.assert_allclose(orders(held), [anchored, *tilts], atol=1e-6)
    # Cash that the anchor holds is raised at once; the third asset cannot be traded.
    start = Signalled(jnp.array([0.4, 0.4, 0.0]), jnp.array([[1.0], [-1.0], [9.0]]))
    anchor, tilted = np.array([0.2, 0.4, 0.4, 0]), 0.8 * np.insert(up, 3, 0) + [0.2, 0, 0, 0]
    expected = np.array([anchor, 0.7 * anchor + 0.3 * tilted])
    np.testing.assert_allclose(orders([0, 0.5, 0.5, 0])[:2], expected, atol=1e-6)


def test_what_all_assets_share_cancels_in_a_tilt():
    anchor = jnp.array([0.5, 0.0, 0.3])
    for shared in (-300.0, 0.0, 300.0):
        signals = jnp.array([[1.0], [9.0], [-1.0]]) + shared
        tilted = Menu.tilted(Signalled(anchor, signals), jnp.array([0.5]))
        expected = np.array([0.5 * np.exp(0.5), 0, 0.3 * np.exp(-0.5)])
        np.testing.assert_allclose(tilted[1:], 0.8 * expected / expected.sum(), rtol=1e-4)
    empty = Menu.tilted(Signalled(jnp.zeros(3), jnp.ones((3, 1))), jnp.array([0.5]))
    np.testing.assert_array_equal(empty, [1, 0, 0, 0])


def signalling(**settings):
    given = {"window": 1, "signals": "momentum:5,volatility:21", "menu": "signals:0.5"}
    return Portfolio.of(price_table(random_walk(160)), **given, **settings)


def test_a_menu_of_signals_draws_holdings_near_the_anchor():
    task, row = signalling(anchor="equal-weight"), jnp.array(100)
    draw = partial(task.draw_reachable, row)
    weights = jax.vmap(draw)(jax.random.split(jax.random.key(0), 200)).weights
    np.testing.assert_allclose(weights[:, 0], 0, atol=1e-6)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-5)
    assert weights[:, 1:].std(0).min() > 0.02
    np.testing.assert_allclose(weights[:, 1:].mean(0), 1 / 3, atol=0.03)
    plain = portfolio()
    key = jax.random.key(1)
    np.testing.assert_array_equal(
        plain.draw_reachable(row, key).weights, plain.draw_holding(key).weights
    )


def test_a_view_shows_what_a_menu_of_signals_orders_within_the_cap():
    task, held = signalling(max_weight=0.35), jnp.array([0, 0.4, 0.3, 0.3])
    view = task.view(jnp.array(100), task.hold(held))
    assert view.choices is not None
    assert view.choices.shape == (5, 3)
    assert view.choices.max() <= 0.35 + 1e-6
    np.testing.assert_allclose(
        view.choices[3], task.target(jnp.array(100), task.hold(held), jnp.array(3))[1:], rtol=1e-6
    )
    assert view.anchor is not None, "equal weights, where no anchor is set"
    np.testing.assert_allclose(view.anchor, 1 / 3, rtol=1e-6)
    assert portfolio(menu="tilts:0.1").view(jnp.array(100), task.hold(held)).choices is None


def test_the_reference_is_the_reward_of_holding_the_anchor():
    task, row = signalling(anchor="equal-weight"), jnp.array(100)
    reward = task.reference(row, row + 1)
    moved = task.relatives(row, row + 1)
    after = moved.waiting / moved.waiting.sum()
    np.testing.assert_allclose(reward, jnp.log((after * moved.earning).sum()), atol=1e-6)
    assert signalling().reference(row, row + 1) is None


@pytest.mark.parametrize(
    "menu", ["grid", "grid:0", "grid:1.5", "grid:inf", "tilts:1", "tilts:x", "grid:400"]
)
def test_menus_that_are_none(menu):
    with pytest.raises(QfolioError, match="menu"):
        _ = portfolio(menu=menu).actions


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"window": 0}, "window is 0"), ({"lag": -1}, "lag is -1"), ({"cost": 0.5}, "cost is 0.5"),
        ({"reward": "profit"}, "no reward 'profit'"), ({"max_weight": 0.0}, "max_weight is 0"),
        ({"cost_model": "free"}, "no cost 'free'"),
        ({"reward": "crra", "risk_aversion": -1.0}, "risk_aversion is -1.0"),
        ({"risk_aversion": float("inf")}, "risk_aversion is inf; it must be finite"),
        ({"sharpe_rate": float("-inf")}, "sharpe_rate is -inf; it must be finite"),
        ({"window": 50}, r"60 rows are too few: .*lower window or horizon \(--set horizon=…\)"),
        ({"window": 58}, r"60 rows are too few: .*lower window \(--set window=…\)"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit(settings, message):
    with pytest.raises(QfolioError, match=message):
        portfolio(**settings)
