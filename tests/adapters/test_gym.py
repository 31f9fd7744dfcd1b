"""The environment under Gymnasium's rules, and its money by the backtest's replay."""

import importlib.util
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from qfolio.adapters import gym
from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.market import RUIN
from qfolio.portfolio.prices.table import Prices

import probes
from tables import featured_table

ROWS, WINDOW, HORIZON = 60, 5, 12
CASH = [1.0, -1, -1, -1]
CAPPED = {"assets": {"cap": 0.5}, "cash": {"max": 0.2}}


def table(rows=ROWS, features=0):
    return featured_table(rows, features)


def environment(prices=None, **task):
    prices = table() if prices is None else prices
    return gymnasium.make(
        gym.ID, prices=prices, **{"window": WINDOW, "horizon": HORIZON, "cost": 0.01, **task}
    )


# Torques are in N m, and positions have no bounds: advice that does not apply.
@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*A Box action space")
@pytest.mark.parametrize("name", gym.IDS)
def test_every_task_is_an_environment(name):
    env = gymnasium.make(gym.IDS[name])
    check_env(env.unwrapped)
    first, again = [env.reset(seed=3)[0] for _ in range(2)]
    np.testing.assert_equal(first, again)


def test_an_episode_ends_at_the_horizon_or_before():
    env = gymnasium.make(gym.IDS["pendulum"], horizon=3, torques=0)
    env.reset(seed=0)
    ends = [env.step(np.ones(1, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(QfolioError, match="reset"):
        env.unwrapped.step(np.ones(1, np.float32))
    cliff = gymnasium.make(gym.IDS["finite/cliff"])
    cliff.reset(seed=0)
    *_, end = [cliff.step(action) for action in (0, *[1] * 11, 2)]  # up, along the edge, down
    assert end[2:4] == (True, False)
    with pytest.raises(QfolioError, match="reset"):
        cliff.unwrapped.step(0)


def test_chance_is_another_at_each_step_and_in_each_episode():
    bets, pendulum = gym.TaskEnv("market/kelly"), gym.TaskEnv("pendulum")
    bets.reset(seed=0)
    stake = np.array([0, 1], np.float32)
    assert {bets.step(stake)[1] > 0 for _ in range(20)} == {True, False}  # some won, others lost
    assert len({tuple(pendulum.reset()[0].tolist()) for _ in range(5)}) == 5


def test_its_steps_are_those_of_the_task():
    """Gymnasium's own pendulum is the oracle."""
    env = gymnasium.make(gym.IDS["pendulum"], torques=0)
    other = gymnasium.make("Pendulum-v1").unwrapped
    seen, _ = env.reset(seed=5)
    other.reset(seed=0)
    other.state = np.array([np.arctan2(seen[1], seen[0]), seen[2]], float)
    for torque in np.linspace(-2, 2, 40, dtype=np.float32):
        seen, reward, *_ = env.step(torque[None])
        expected, cost, *_ = other.step(torque[None])
        np.testing.assert_allclose(seen, expected, atol=1e-3)
        np.testing.assert_allclose(reward, cost, atol=1e-3)


def test_scores_become_the_nearest_weights_of_a_market():
    env = gymnasium.make(gym.IDS["market/kelly"])
    for scores in ([0.7, 0.7], [-0.5, -0.5], [0.5, 0.5]):
        env.reset(seed=1)
        seen = env.step(np.array(scores, np.float32))[0]
        holdings = seen["holding"]
        assert 0.4 < holdings[0] < 0.6  # a half, drifted by one step
    env.reset(seed=1)
    holdings = env.step(np.array([0.3, 0.9], np.float32))[0]["holding"]
    assert holdings[0] == pytest.approx(0.8, abs=0.02)  # 0.3 and 0.9 less 0.1 each


def test_a_task_says_what_is_wrong():
    env = gymnasium.make(gym.IDS["pendulum"])
    env.reset(seed=0)
    for action in (11, -1, 0.5, "left", [[1], [2, 3]]):
        with pytest.raises(QfolioError, match="must be in Discrete"):
            env.unwrapped.step(action)
    env = gymnasium.make(gym.IDS["pendulum"], torques=0)
    env.reset(seed=0)
    for torque in ("left", None, [np.nan], [0.0, 0.0]):
        with pytest.raises(QfolioError, match="must be in Box"):
            env.unwrapped.step(torque)
    with pytest.raises(QfolioError, match="did you mean torques"):
        gym.TaskEnv("pendulum", torqes=3)
    with pytest.raises(QfolioError, match="render_mode"):
        gym.TaskEnv("pendulum", render_mode="human")


def play(env, **reset):
    """An episode of random actions: what was seen, earned and told."""
    rng = np.random.default_rng(0)
    observation, info = env.reset(**reset)
    record, over = [(observation, 0.0, info)], False
    while not over:
        space = env.action_space
        discrete = isinstance(space, gymnasium.spaces.Discrete)
        action = int(rng.integers(space.n)) if discrete else rng.uniform(-1, 1, space.shape)
        observation, reward, terminated, over, info = env.step(action)
        assert not terminated
        record.append((observation, reward, info))
    return record


@pytest.mark.parametrize(
    "task",
    [{"lag": 0}, {"menu": "tilts:0.1", "max_weight": 0.5}, {"reward": "differential-sharpe"}],
)
def test_gymnasium_finds_nothing_to_warn_of(task):
    check_env(environment(table(features=1), **task).unwrapped)
    check_env(environment(render_mode="ansi", **task).unwrapped)


@pytest.mark.parametrize("lag", [0, 1, 3])
@pytest.mark.parametrize(
    "task",
    [
        {},
        {"menu": "tilts:0.3"},
        {"max_weight": 0.4},
        # A fee that takes the more of the wealth, the less of it is left.
        {"cost_model": "itemized(cost=0.01,fixed=4,capital=1000)"},
    ],
)
def test_its_wealth_is_that_of_the_replay(lag, task):
    env, prices = environment(lag=lag, **task), table()
    costs = env.unwrapped.task.costs
    terms = {"cost": costs, "lag": lag, "conditions": Conditions.of(prices, costs)}
    for start in (env.unwrapped.first, 20, env.unwrapped.last):
        (_, _, begun), *steps = play(env, options={"start": start})
        assert len(steps) == HORIZON
        assert begun["date"] == begun["return_date"] == str(prices.dates[start])[:10]
        infos = [info for _, _, info in steps]
        decisions = np.array([info["target"] for info in infos])
        replay = simulate(prices.values, decisions, first=start, **terms)
        wealth = [begun["wealth"], *(info["wealth"] for info in infos)]
        np.testing.assert_allclose(wealth, replay.wealth, rtol=1e-12)
        np.testing.assert_allclose([info["cost"] for info in infos], replay.cost, atol=1e-12)
        np.testing.assert_allclose(
            [info["turnover"] for info in infos], replay.turnover, atol=1e-12
        )
        rewards = [reward for _, reward, _ in steps]
        np.testing.assert_allclose(rewards, replay.growth, atol=1e-12)
        np.testing.assert_allclose(decisions.sum(1), 1, atol=1e-12)
        assert decisions[:, 1:].max() <= task.get("max_weight", 1.0) + 1e-7
        assert infos[-1]["date"] == str(prices.dates[start + HORIZON])[:10]
        assert infos[-1]["return_date"] == str(prices.dates[start + HORIZON + lag])[:10]
    assert env.unwrapped.last + HORIZON + lag == ROWS - 1


def test_a_mandate_with_shorts_and_a_loan_is_obeyed():
    prices = table()
    mandate = {"assets": {"floor": {"a": -0.3}}, "cash": {"min": -0.5}, "exposure": {"gross": 1.5}}
    env = environment(prices, mandate=mandate)
    assert env.action_space.shape == (3,)
    check_env(env.unwrapped)
    seen, _, infos = zip(*play(env, options={"start": 20}), strict=True)
    decisions = np.array([info["target"] for info in infos[1:]])
    np.testing.assert_allclose(decisions.sum(1), 1, atol=1e-12)
    assert -0.3 - 1e-7 <= decisions[:, 1].min() < -0.1
    assert -0.5 - 1e-7 <= decisions[:, 0].min() < -0.1
    assert min(observation["holding"][0] for observation in seen) < -0.1
    assert np.abs(decisions[:, 1:]).sum(1).max() <= 1.5 + 1e-7
    replay = simulate(prices.values, decisions, first=20, cost=0.01, lag=1, long_only=False)
    np.testing.assert_allclose([info["wealth"] for info in infos], replay.wealth, rtol=1e-12)
    with pytest.raises(QfolioError, match="3 finite numbers, the weights of the assets"):
        environment(prices, mandate=mandate).unwrapped._checked(CASH)


def test_ruin_ends_the_episode():
    env = environment(cost_model="itemized(fixed=1000,capital=100)")
    env.reset(seed=0)
    _, reward, terminated, truncated, _ = env.step([0.0, 1, 0, 0])
    assert reward == pytest.approx(np.log(RUIN))
    assert terminated
    assert not truncated
    with pytest.raises(QfolioError, match="over"):
        env.unwrapped.step(CASH)


def coming_and_going():
    """b joins, c is delisted with a haircut, and a is no member for a time."""
    prices = table()
    values, listed = prices.values.copy(), np.ones((ROWS, 3), bool)
    members = listed.copy()
    values[:30, 1], listed[:30, 1] = np.nan, False
    values[45:, 2], listed[45:, 2] = 0.6 * values[44, 2], False
    members[35:42, 0] = False
    return Prices(prices.dates, prices.assets, values, listed=listed, members=members)


@pytest.mark.parametrize("task", [{}, {"menu": "tilts:0.3", "lag": 0}, {"mandate": CAPPED}])
def test_assets_that_come_and_go_are_held_while_they_are_there(task):
    prices = coming_and_going()
    env, lag = environment(prices, **task), task.get("lag", 1)
    check_env(env.unwrapped)
    known, lost = Conditions.of(prices), 0
    for start in range(env.unwrapped.first, env.unwrapped.last, 2):
        record = play(env, options={"start": start})
        decisions = np.array([info["target"] for _, _, info in record[1:]])
        replay = simulate(
            prices.values, decisions, first=start, cost=0.01, lag=lag, conditions=known
        )
        np.testing.assert_allclose(record[-1][2]["wealth"], replay.wealth[-1], rtol=1e-12)
        for row, (seen, *_) in enumerate(record, start):
            np.testing.assert_array_equal(seen["tradable"], prices.tradable[row])
            assert (seen["holding"][~prices.listed[row]] == 0).all()
        rows = slice(start, start + HORIZON)
        assert (decisions[:, 1:][~prices.tradable[rows]] == 0).all()
        lost += replay.returns.min() < -0.06
    assert lost


def test_the_last_row_is_reached_but_not_passed():
    env = environment(lag=2)
    with pytest.raises(QfolioError, match="can start at rows 5 to 45"):
        env.reset(options={"start": env.unwrapped.last + 1})
    with pytest.raises(QfolioError, match="start is 4"):
        env.reset(options={"start": 4})
    with pytest.raises(QfolioError, match="start is '9'"):
        env.reset(options={"start": "9"})


def test_numbers_become_the_nearest_weights():
    env = environment(cost=0.0)
    for scores, weights in (
        ([0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.3, 0.4]),  # weights stand for themselves
        ([0.8, 0.8, -1, -1], [0.5, 0.5, 0, 0]),
        ([1.0, 0.4, 0, 0], [0.8, 0.2, 0, 0]),
        ([0.0, 0, 0, 0], [0.25, 0.25, 0.25, 0.25]),
        ([-1.0, -1, -1, 1], [0, 0, 0, 1]),
    ):
        env.reset(seed=0)
        info = env.step(np.array(scores, np.float32))[-1]
        np.testing.assert_allclose(info["target"], weights, atol=1e-7)
    capped = environment(max_weight=0.4)
    capped.reset(seed=0)
    for scores, weights in (
        ([0.0, 1, 0, 0], [0.2, 0.4, 0.2, 0.2]),
        ([-1.0, 1, 0, 0], [0, 0.4, 0.3, 0.3]),
        ([1.0, 0, 0, 0], [1, 0, 0, 0]),  # cash has no cap
    ):
        target = capped.step(scores)[-1]["target"]
        np.testing.assert_allclose(target, weights, atol=1e-7)


def test_no_order_costs_nothing():
    env = environment(menu="tilts:0.3", cost=0.1, lag=2)
    env.reset(seed=3)
    env.step(2)  # equal weights
    for _ in range(3):
        info = env.step(0)[-1]  # no order
        assert info["cost"] < 1e-15
        assert info["turnover"] < 1e-14


def test_a_seed_gives_one_episode():
    env, other = environment(), environment()
    first, again, different = play(env, seed=7), play(other, seed=7), play(env, seed=8)
    assert [info["wealth"] for *_, info in first] == [info["wealth"] for *_, info in again]
    assert first[0][2]["date"] != different[0][2]["date"]
    starts = set()
    env.reset(seed=0)
    for _ in range(400):
        starts.add(env.reset()[1]["date"])
    assert len(starts) == env.unwrapped.last - env.unwrapped.first + 1


def test_what_is_seen_ends_today():
    prices = table(features=1)
    values, features = prices.values.copy(), prices.features.copy()
    values[31:] *= 3
    features[31:] += 5
    other = Prices(prices.dates, prices.assets, values, features, prices.feature_names)
    train = prices.between(0, 30)
    env, changed = (environment(p, scaled_by=train) for p in (prices, other))
    seen, seen_too = (e.reset(options={"start": 30})[0] for e in (env, changed))
    np.testing.assert_array_equal(seen["features"], seen_too["features"])
    logs = np.diff(np.log(prices.values), axis=0)
    scale = logs[:29].std()
    np.testing.assert_allclose(
        seen["features"][..., 0], logs[30 - WINDOW : 30].T / scale, rtol=1e-4
    )
    seen, seen_too = (e.step(CASH)[0] for e in (env, changed))
    assert not np.array_equal(seen["features"], seen_too["features"])


def test_an_episode_knows_nothing_of_the_one_before():
    env = environment(reward="differential-sharpe")
    first, again = (play(env, options={"start": 20}) for _ in range(2))
    assert [reward for _, reward, _ in again] == [reward for _, reward, _ in first]


def test_rewards_by_name():
    prices, target = table(), [0.0, 0.5, 0.5, 0.0]
    growth = {}
    for reward in ("log", "crra", "mean-variance"):
        env = environment(prices, reward=reward, risk_aversion=3.0, lag=0)
        env.reset(options={"start": 10})
        _, growth[reward], *_, info = env.step(target)
    moved = prices.values[11] / prices.values[10]
    wealth = 0.99 * (moved[0] + moved[1]) / 2  # cash to assets at 1%
    np.testing.assert_allclose(info["wealth"], wealth, rtol=1e-12)
    np.testing.assert_allclose(growth["log"], np.log(wealth), rtol=1e-9)
    np.testing.assert_allclose(growth["crra"], (1 - wealth**-2) / 2, rtol=1e-9)
    np.testing.assert_allclose(growth["mean-variance"], wealth - 1 - 1.5 * (wealth - 1) ** 2)


def test_a_reward_that_is_defined_again_is_the_one_that_is_earned(monkeypatch):
    """As in a notebook whose cell is run again: environments of equal settings share programs."""

    def earned():
        market = gym.TaskEnv("probes:Rewarded")
        table = environment(reward="probes:Bonus").unwrapped
        for env in (market, table):
            env.reset(seed=0)
            yield env.step(np.eye(env.action_space.shape[0], dtype=np.float32)[0])[1]

    assert [*earned()] == [1, 1]
    monkeypatch.setattr(probes, "Bonus", type("Bonus", (probes.Bonus,), {"value": 2.0}))
    assert [*earned()] == [2, 2]


def test_active_rewards_are_those_over_the_anchors():
    prices = table()
    active = {"anchor": "equal-weight", "active": True, "lag": 0, "cost": 0.0}
    env = environment(prices, tracking_aversion=10.0, **active)
    for target, anchored in (([0.0, 1, 1, 1], True), ([0.0, 1, 0, 0], False)):
        env.reset(options={"start": 10})
        _, reward, *_ = env.step(np.array(target) / sum(target))
        moved = prices.values[11] / prices.values[10]
        over = 0.0 if anchored else np.log(moved[0] / moved.mean())
        np.testing.assert_allclose(reward, over - 5 * over**2, atol=1e-6)


def test_it_says_what_is_wrong():
    env = environment()
    with pytest.raises(QfolioError, match="reset"):
        env.unwrapped.step(CASH)
    env.reset(seed=0)
    for action, said in (
        ([1.0, 0, 0], r"has the shape \(3,\)"), ([np.nan, 0, 0, 0], "is not finite"),
        ("cash", "has the shape"), (None, "has the shape"),
    ):  # fmt: skip
        with pytest.raises(QfolioError, match=f"4 finite numbers, cash first; this one {said}"):
            env.unwrapped.step(action)
    menu = environment(menu="tilts:0.1")
    menu.reset(seed=0)
    for number in (9, -1, 0.5):
        with pytest.raises(QfolioError, match="from 0 to 8"):
            menu.unwrapped.step(number)
    with pytest.raises(QfolioError, match="options has 'begin'; the only option of reset"):
        env.reset(options={"begin": 12})
    with pytest.raises(QfolioError, match="did you mean window"):
        environment(windw=5)
    with pytest.raises(QfolioError, match="render_mode"):
        gym.PortfolioEnv(table(), render_mode="human")
    with pytest.raises(QfolioError, match="too few"):
        environment(table(rows=10))
    with pytest.raises(QfolioError, match="scaled_by"):
        environment(scaled_by=table(features=1))
    for _ in play(env, seed=0):
        pass
    with pytest.raises(QfolioError, match="over"):
        env.unwrapped.step(CASH)


def test_a_line_of_text():
    env = environment(render_mode="ansi")
    env.reset(options={"start": 10})
    assert env.render() == "2020-01-11  wealth 1.0000  cash 100%\n"
    env.step([0.0, 1.0, 0, 0])
    assert "a 100%" in env.render()
    short = environment(render_mode="ansi", mandate={"assets": {"floor": -0.3}}, cost=0.0)
    short.reset(options={"start": 10})
    short.step([-0.3, 0.5, 0])
    assert "a -30%, b 50%" in short.render()


def test_without_gymnasium_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    spec = importlib.util.spec_from_file_location("without_gymnasium", gym.__file__)
    assert spec is not None
    assert spec.loader is not None
    with pytest.raises(QfolioError, match=r'pip install "qfolio\[gym\]"'):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
