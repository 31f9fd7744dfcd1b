import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox import filter_jit as jit

from qfolio.agents.dqn import DQN
from qfolio.agents.pathwise import Paths, Pathwise
from qfolio.core import faults, settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import evaluate, start_keys, step_key
from qfolio.core.mdp import Agent, Box, Position
from qfolio.core.registry import TASKS, find
from qfolio.experiments.run import Run
from qfolio.portfolio.costs import remainder_factor
from qfolio.portfolio.synthetic.ar1 import Ar1
from qfolio.portfolio.synthetic.garleanu_pedersen import GarleanuPedersen, Signals
from qfolio.portfolio.synthetic.kelly import Kelly
from qfolio.portfolio.synthetic.leverage import Leverage
from qfolio.portfolio.synthetic.liquidation import Liquidation
from qfolio.portfolio.synthetic.merton import Merton
from qfolio.portfolio.synthetic.no_trade import NoTrade
from qfolio.portfolio.synthetic.regime import Regime
from qfolio.solvers.almgren_chriss import almgren_chriss
from qfolio.solvers.followed import FollowedOptimum
from qfolio.solvers.garleanu_pedersen import garleanu_pedersen

MARKETS = [name for name in TASKS if name.startswith("market/")]


@pytest.fixture(params=MARKETS)
def market(request):
    return find("task", request.param)(horizon=40)


class Fixed(Agent):
    """Plays a policy that is given, to be graded as an agent is."""

    policy_of: object = None
    num_envs = 1
    episode_steps = 0
    discount = None

    def init(self, task, key): ...
    def warm_up(self): ...
    def act(self, state, observation, key): ...
    def observe(self, state, rollout): ...
    def learn(self, task, state, rollout, key): ...
    def weights(self, state): ...

    def policy(self, weights, observation):
        return jnp.broadcast_to(weights, (observation.holding.shape[0], *weights.shape))


def test_the_optimum_is_followed_on_the_paths_of_an_evaluation():
    """A constant policy is graded the same as an agent and as an optimum."""
    task = Ar1(horizon=30)
    weights, keys = jnp.array([0.3, 0.7]), start_keys(16)
    followed = FollowedOptimum(task, lambda state: weights).returns(keys)
    graded = evaluate(task, Fixed(), weights, keys, 0).returns
    np.testing.assert_allclose(followed, graded, atol=1e-6)


@pytest.mark.parametrize(("stay", "mean", "cost"), [(0.5, 0.2, 0.2), (0.5, 0.02, 0.02)])
def test_no_band_beats_the_optimum_of_regimes_that_do_not_pay_for_a_switch(stay, mean, cost):
    task, keys = Regime(stay=(stay,), mean=(mean,), cost=cost), start_keys(256)
    best = task.optimum().returns(keys).mean()
    for low, high in ((0, 0), (0, 1), (0.1, 0.9), (0.2, 0.8), (0.3, 0.7), (0.4, 0.6), (1, 1)):

        def policy(state, low=low, high=high):
            weight = jnp.clip(state.holding.weights[1], low, high)
            return jnp.stack([1 - weight, weight])

        assert FollowedOptimum(task, policy).returns(keys).mean() < best


def test_the_optimum_of_a_persistent_signal_looks_as_far_ahead_as_an_episode():
    task, keys = Ar1(rho=0.99, noise=0.1409, cost=0.1), start_keys(128)
    short = dataclasses.replace(task, horizon=33)  # looks ahead by a discount of 0.97
    near = FollowedOptimum(task, short.best()).returns(keys).mean()
    assert task.optimum().returns(keys).mean() > 1.05 * near


def test_no_perturbed_policy_beats_the_exact_one(market):
    """On common paths; markets differ in what a mistake costs, so only its sign is tested."""
    best = market.optimum().policy
    keys = start_keys(2048)
    exact = market.optimum().returns(keys)
    assert exact.mean() < 0 if isinstance(market, Liquidation) else exact.mean() > 0

    def perturbed(shift):
        def policy(state):
            action = best(state)
            if isinstance(market.actions, Box):
                return action + shift
            risky = jnp.clip(action[1:] + shift, 0, 1)
            risky = risky / jnp.maximum(risky.sum(), 1)
            return jnp.concatenate([1 - risky.sum(keepdims=True), risky])

        return policy

    for shift in (-0.3, 0.3):
        other = FollowedOptimum(market, perturbed(shift)).returns(keys)
        difference = exact - other
        error = difference.std() / np.sqrt(len(keys))
        assert difference.mean() > -2 * error
        if not isinstance(market, Regime):  # always in or out: a shift is often clipped away
            assert difference.mean() > 2 * error


def test_figures_of_the_exact_rules():
    assert Kelly().rule(Kelly().best())["fraction"] == pytest.approx(0.6)
    region = NoTrade().rule(NoTrade().best())
    assert region["low"] == pytest.approx(0.4091, abs=1e-3)  # monthly; continuously 0.4010
    assert region["high"] == pytest.approx(0.5909, abs=1e-3)
    coefficients = GarleanuPedersen().rule(GarleanuPedersen().best())
    assert coefficients["of the position"] == pytest.approx(0.645664384, abs=1e-5)
    assert coefficients["of the factor"] == pytest.approx(6.139213092, abs=1e-4)
    signals = Signals().rule(Signals().best())
    assert len(signals) == 21
    assert signals["1: of position 1"] == pytest.approx(0.5523, abs=1e-4)
    assert signals["2: of factor 2"] == pytest.approx(-4.9226, abs=1e-4)
    sale = Liquidation().rule(Liquidation().best())
    exact = almgren_chriss(1.0, 0.95, 2.5, 0.25, 1.0, 5.0, 5)
    assert list(sale.values()) == pytest.approx(exact.positions[1:-1], abs=1e-6)
    weights = Merton().rule(Merton().best())
    assert weights["weight of asset 3"] == 0
    assert weights["weight of asset 1"] > 0.3
    regime = Regime().rule(Regime().best())
    assert regime == {"from 0.0 in bad times": 0, "from 1.0 in bad times": 0,
                      "from 0.0 in good times": 1, "from 1.0 in good times": 1}  # fmt: skip
    stay_out = Regime(cost=0.03).rule(Regime(cost=0.03).best())
    assert stay_out["from 0.0 in good times"] == 0


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [
        (0.05, 0.97, {"low": 0.05, "high": 0.97}),
        (0.41, 0.59, {"low": 0.41, "high": 0.59}),
        (0.0, 0.6, {"low": None, "high": 0.6}),
        (0.0, 1.0, {"low": None, "high": None}),  # a policy that never trades
        (0.5, 0.5, {"low": 0.5, "high": 0.5}),
    ],
)
def test_edges_are_found_wherever_they_are_or_reported_as_none(low, high, found):
    """A holding of 0.1 or 0.9 that stands as it is is no edge."""

    def policy(state):
        weight = jnp.clip(state.holding.weights[1], low, high)
        return jnp.stack([1 - weight, weight])

    assert NoTrade().rule(policy) == pytest.approx(found, abs=1e-6)


def test_merton_scenarios_have_the_moments_that_are_stated():
    logs = np.log(Merton.table())
    np.testing.assert_allclose(logs.std(0, ddof=1), Merton.volatilities, rtol=1e-6)
    expected = np.array(Merton.means) - np.array(Merton.volatilities) ** 2 / 2
    np.testing.assert_allclose(logs.mean(0), expected, atol=1e-9)


def test_regimes_may_differ_in_how_long_they_last_and_what_they_pay():
    task = settings.build(Regime, {"stay": "0.9,0.98", "mean": "-0.004,0.001"})
    assert settings.build(Regime, settings.describe(task)) == task
    assert settings.build(Regime, {"stay": 0.9}) == Regime(stay=(0.9,))
    keys = start_keys(4000)
    markets = jax.jit(jax.vmap(task.reset_market))(keys)
    assert float(markets.mean()) == pytest.approx(0.1 / 0.12, abs=0.03)
    for market, stay, mean in ((0, 0.9, -0.004), (1, 0.98, 0.001)):
        now = jnp.array(market)
        after = jax.jit(jax.vmap(lambda key, now=now: task.next_market(now, key)))(keys)
        assert float((after == market).mean()) == pytest.approx(stay, abs=0.02)
        np.testing.assert_allclose(jnp.log(task.relatives(now, now).earning), mean, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [
        ("stay", "1", "1.0"),
        ("stay", "0.9,0.999999", "0.9, 0.999999"),
        ("stay", "0.9,0.9,0.9", "0.9, 0.9, 0.9"),
        ("mean", "0", "0.0"),
        ("mean", "0.01,0.001", "0.01, 0.001"),
        ("mean", "-1,0", "-1.0, 0.0"),
    ],
)
def test_regimes_that_make_no_sense(name, value, shown):
    with pytest.raises(QfolioError, match=f"^{name} is {shown}; it must be "):
        settings.build(Regime, {name: value})


def test_ar1_looks_at_most_ten_thousand_steps_ahead():
    with pytest.raises(QfolioError, match=r"^horizon is 10001; it must be from 1 to 10,000\.$"):
        Ar1(horizon=10_001)
    assert Ar1(horizon=10_000).horizon == 10_000


def test_the_regime_pays_what_was_seen():
    task = Regime(cost=0.005)
    for market, sign in ((0, -1), (1, 1)):
        state = Position(jnp.array(market), task.hold(jnp.array([0.0, 1.0])))
        step = task.step(state, jnp.array([0.0, 1.0]), jax.random.key(market))
        np.testing.assert_allclose(step.reward, sign * 0.002, atol=1e-7)
        step = task.step(state, jnp.array([1.0, 0.0]), jax.random.key(market))
        np.testing.assert_allclose(step.reward, np.log(1 - 0.005), atol=1e-6)


def test_no_trade_pays_expected_growth():
    task = NoTrade()
    state = Position(jnp.array(0.0), task.hold(jnp.array([0.5, 0.5])))
    rewards = [task.step(state, jnp.array([0.5, 0.5]), jax.random.key(i)).reward for i in (1, 2)]
    assert rewards[0] == rewards[1]
    dt, half = task.dt, 0.5
    expected = (half * task.rate - half**2 * task.volatility**2 / 2) * dt
    np.testing.assert_allclose(rewards[0], expected, rtol=0.02)
    traded = task.step(state, jnp.array([0.2, 0.8]), jax.random.key(1)).reward
    cost = remainder_factor(jnp.array([0.5, 0.5]), jnp.array([0.2, 0.8]), task.cost)
    assert traded < jnp.log(cost) + 0.001


def test_cash_that_earns_interest_leaves_the_region_where_it_is():
    """Both grow by the rate; rewards and holdings are those of a market's own arithmetic."""
    task, plain = NoTrade(cash_rate=0.05), NoTrade()
    assert task.region()[:2] == pytest.approx(plain.region()[:2])
    assert task.region().growth == pytest.approx(plain.region().growth + 0.05)
    start, key = jnp.array(0.0), jax.random.key(4)
    state = Position(start, task.hold(jnp.array([0.8, 0.2])))
    step, action = jax.jit(task.step), jnp.array([0.5, 0.5])
    ours, other = step(state, action, key), jax.jit(plain.step)(state, action, key)
    np.testing.assert_allclose(ours.reward - other.reward, 0.05 / 12, atol=1e-7)
    np.testing.assert_allclose(ours.state.holding.weights, other.state.holding.weights, rtol=1e-6)
    nodes, chances = np.polynomial.hermite_e.hermegauss(5)
    own = super(NoTrade, task).settle
    moves = [task._log_relative(jnp.array(node)) for node in nodes]
    rewards = [own(start, move, state.holding, action)[0] for move in moves]
    expected = np.array(rewards) @ chances / chances.sum()
    np.testing.assert_allclose(ours.reward, expected, atol=3e-7)
    _, moved = own(start, ours.state.market, state.holding, action)
    np.testing.assert_allclose(ours.state.holding.weights, moved.weights, rtol=1e-6)


def test_a_path_and_its_mirror_image_have_opposite_shocks():
    task, start = NoTrade(dt=1 / 252), jnp.array(0.0)
    moves = jax.vmap(lambda key: task.next_market(start, key))(start_keys(100))
    images = jax.vmap(task.mirror)(moves)
    np.testing.assert_allclose(jax.vmap(task.mirror)(images), moves, atol=1e-8)
    mean = (task.rate - task.volatility**2 / 2) * task.dt
    np.testing.assert_allclose((moves + images) / 2, mean, atol=1e-8)
    assert Ar1().mirror(Ar1().reset_market(jax.random.key(0))) is None


def test_the_stationary_signal():
    task = Ar1()
    signals = jax.vmap(task.reset_market)(start_keys(4000))
    keys = jax.random.split(jax.random.key(1), 4000)
    later = jax.vmap(task.next_market)(signals, keys)
    for x in (signals.signal, later.signal):
        assert float(x.std()) == pytest.approx(task.spread, rel=0.05)
    gains = later.relative - 1 - task.drift - task.slope * signals.signal
    assert float(gains.std()) == pytest.approx(task.volatility, rel=0.05)
    assert float(gains.mean()) == pytest.approx(0, abs=4 * task.volatility / 4000**0.5)


def test_a_sale_pays_its_expected_shortfall_and_its_risk():
    """Whatever the policy leaves: by the solver, and the last step sells all of it."""
    task = Liquidation(horizon=8, risk_aversion=0.7)
    exact = almgren_chriss(1.3, 0.95, 2.5, 0.25, 0.7, 5.0, 8)
    best, position, total = task.best(), jnp.array([1.3]), jnp.array(0.0)
    for time in range(8):
        state = Position(jnp.array(time), position)
        step = task.step(state, best(state) + (time == 7), jax.random.key(0))
        position, total = step.state.holding, total + step.reward
        assert bool(step.terminated) == (time == 7)
    assert float(position[0]) == 0
    assert float(total) == pytest.approx(-exact.cost - 0.7 * exact.variance, rel=1e-5)


@pytest.mark.parametrize(
    ("risk_aversion", "cash"),
    [(1.0, -0.5688), (1.5, -0.0629), (1.6, 0.0), (3.2, 0.0), (3.3, 0.0146), (4.0, 0.1858)],
)
def test_leverage_has_three_regimes(risk_aversion, cash):
    task = Leverage(risk_aversion=risk_aversion)
    rule = task.rule(task.best())
    assert rule["weight of cash"] == pytest.approx(cash, abs=1e-4)
    assert rule["weight of asset 3"] < -0.2  # sold short in all of them
    assert sum(rule.values()) == pytest.approx(1)


def test_interest_depends_on_the_sign_of_cash():
    task = Leverage(risk_aversion=1.0)
    start, scenario = jnp.array(0), jnp.array(7)
    holding = task.hold(jnp.array([0.4, 0.3, 0.3, 0.0]))
    settle = jax.jit(lambda action: task.settle(start, scenario, holding, action))
    moved = Leverage().table()[7]
    for action, rate in ((np.array([0.5, 0.2, -0.4]), 0.02), (np.array([1.5, 0.7, -0.4]), 0.05)):
        growth = moved @ action + (1 - action.sum()) * np.exp(rate / 4)
        reward, after = settle(jnp.asarray(action, jnp.float32))
        np.testing.assert_allclose(reward, np.log(growth), atol=1e-6)
        np.testing.assert_allclose(after.weights[1:], action * moved / growth, atol=1e-6)
    # An account whose debts exceed what it owns is wiped out, and goes on in cash.
    reward, after = settle(jnp.array([-40.0, 0.0, 0.0]) * np.sign(moved[0] - 1))
    assert np.exp(reward) == pytest.approx(1e-3)
    assert after.weights.tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize("loading", [float("inf"), -1e20])
def test_loadings_that_make_no_sense(loading):
    with pytest.raises(QfolioError, match=r"^loading is "):
        GarleanuPedersen(loading=loading)


def test_factors_that_hardly_decay_have_a_spread():
    with pytest.raises(QfolioError, match=r"^phi is 1e-08; it must be from 1e-5 to 1\.$"):
        GarleanuPedersen(phi=1e-8)
    slow = GarleanuPedersen(phi=1e-5)
    exact = 0.066 / (1 - (1 - 1e-5) ** 2) ** 0.5
    assert float(slow.tables.spread[0]) == pytest.approx(exact, rel=0.01)


def test_sales_that_make_no_sense():
    with pytest.raises(QfolioError, match=r"^temporary is 2\.5"):
        Liquidation(permanent=5.0)
    assert Liquidation(permanent=5.0, horizon=10).horizon == 10  # smaller steps
    with pytest.raises(QfolioError, match=r"^permanent is inf; it must be from 0 to 1e6\.$"):
        Liquidation(permanent=float("inf"))


@pytest.mark.parametrize("kind", [GarleanuPedersen, Signals])
def test_the_return_on_signals_is_the_solvers_value(kind):
    """From no position, over all time; most of it is earned within the default horizon."""
    task = kind(horizon=1000)
    phi, loading, noise, covariance, cost = task.tables
    innovation = np.asarray(noise) ** 2
    rule = garleanu_pedersen(phi, 1.0, cost, loading, covariance, task.rho, innovation)
    flat = lambda state: state._replace(holding=jnp.zeros_like(state.holding))  # noqa: E731
    keys = start_keys(1000)
    starts = jax.vmap(lambda key: flat(task.reset(key)))(keys)
    best = jax.vmap(task.best())

    def step(states, time):
        after = jax.vmap(task.step)(states, best(states), jax.vmap(step_key, (0, None))(keys, time))
        return after.state, after.reward

    returns = jax.lax.scan(step, starts, jnp.arange(1000))[1].sum(0)
    error = float(returns.std()) / len(keys) ** 0.5
    assert float(returns.mean()) == pytest.approx(rule.value, abs=4 * error)
    assert error < 0.03 * rule.value


@pytest.fixture
def double_precision():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("tail", [0, 5])
@pytest.mark.usefixtures("double_precision")
def test_gradient_of_a_rollout_against_finite_differences(tail):
    """Through costs, drift and the simplex, by hand; in the tail, decisions stand as they are."""
    task = Ar1(horizon=8, cost=0.01)
    agent = Pathwise(rollout_length=8, tail=tail, num_envs=3, hidden=(4, 4), simplex_penalty=0.0)
    policy = jit(agent.init)(task, jax.random.key(2)).policy
    starts = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.key(5), 3))
    markets, after = [starts.market], jax.jit(jax.vmap(task.next_market))
    for key in jax.random.split(jax.random.key(6), 8):
        markets.append(after(markets[-1], jax.random.split(key, 3)))
    stack = lambda trees: jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *trees)  # noqa: E731
    holdings = stack([starts.holding] * 8)
    now, after = stack(markets[:-1]), stack(markets[1:])
    seen = jax.jit(jax.vmap(jax.vmap(task.observe)))(Position(now, holdings))
    paths = Paths(now, after, seen.features, starts.holding)

    def with_linear(linear):
        return eqx.tree_at(lambda p: p.network.linear, policy, linear)

    @jax.jit
    def by_hand(linear):
        holding, total = starts.holding, 0.0
        for time in range(8):
            acting = with_linear(linear) if time < 8 - tail else policy
            view = jax.vmap(task.observe)(Position(markets[time], holding))
            settle = jax.vmap(task.settle)
            reward, holding = settle(markets[time], markets[time + 1], holding, acting(view))
            total -= reward.sum() / (3 * (8 - tail))
        return total

    linear, zeros = policy.network.linear, jnp.zeros((8, 3, 1))

    @jax.jit
    def loss(linear, nudges):
        return agent._loss(with_linear(linear), nudges, None, task, paths)[0]

    gradient, worth = jax.jit(jax.grad(loss, (0, 1)))(linear, zeros)
    assert abs(gradient).max() > 1e-4
    for time, path in ((0, 0), (3, 1), (7, 2)):
        bump = np.zeros(zeros.shape)
        bump[time, path] = 1e-7
        slope = (loss(linear, jnp.asarray(bump)) - loss(linear, jnp.asarray(-bump))) / 2e-7
        np.testing.assert_allclose(worth[time, path, 0], slope, rtol=1e-4, atol=1e-8)
    for place in ((0, 0), (1, 1), (0, 1)):
        bump = np.zeros(linear.shape)
        bump[place] = 1e-7
        here = np.asarray(linear)
        slope = (by_hand(here + bump) - by_hand(here - bump)) / 2e-7
        np.testing.assert_allclose(gradient[place], slope, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize(
    ("agent", "menu", "message"),
    [
        (DQN(), "", "menu of allocations"),
        (Pathwise(rollout_length=10), "grid:4", "leave menu empty"),
        (DQN(network="mlp"), "grid:4", "menu with choices for each"),
        (Pathwise(rollout_length=7), "", "rollout_length is 7"),
    ],
)  # fmt: skip
def test_agents_that_do_not_fit(agent, menu, message):
    task = settings.build(Regime, {"menu": menu, "horizon": 40})
    with pytest.raises(QfolioError, match=message):
        agent.init(task, jax.random.key(0))


class Unscaled(Pathwise):
    """Forgets that weights sum to 1."""

    def policy(self, weights, observation):
        return 0.9 * super().policy(weights, observation)


class Drifting(Pathwise):
    """Leaves the simplex as it learns."""

    def weights(self, state):
        return super().weights(state), state.optimizer.count

    def policy(self, weights, observation):
        learned, count = weights
        return super().policy(learned, observation) * (1 + count)


class Unknown(Pathwise):
    def act(self, state, observation, key):
        return jnp.nan * super().act(state, observation, key)


class Nowhere(Pathwise):
    def policy(self, learned, observation):
        return jnp.nan * super().policy(learned, observation)


def test_weights_of_ones_own_agent_are_those_of_a_portfolio():
    task = Merton()
    with pytest.raises(QfolioError, match=r"Unscaled.policy gives weights .* that sum to 0\.9;"):
        Run.create(task, Unscaled(), episodes=8, seeds=1)
    for each in (task, GarleanuPedersen()):  # weights, and positions
        with pytest.raises(QfolioError, match=r"^Nowhere.policy gives an action that is not fin"):
            faults.require_actions(each, Nowhere(rollout_length=20))
    run = Run.create(task, Drifting(num_envs=8, rollout_length=20), episodes=8, seeds=2)
    run.train()
    with pytest.raises(QfolioError, match=r"Drifting.policy gives weights .* that sum to [^1]"):
        run.grade()
    with pytest.raises(QfolioError, match="The action of Unknown is not finite at step 1"):
        raise QfolioError(faults.find(task, Unknown(), 0))


def test_all_actions_need_a_market(task):
    with pytest.raises(QfolioError, match="all_actions needs a market"):
        DQN(all_actions=True).init(task, jax.random.key(0))
