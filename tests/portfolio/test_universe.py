"""Assets that join, are delisted, and are members for a time."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Discrete, Position, Transition
from qfolio.experiments.presets import preset
from qfolio.portfolio.anchors import path
from qfolio.portfolio.backtest.baselines import Baseline, History, baseline
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.orders import AT_EVERY_ROW, orders
from qfolio.portfolio.backtest.replay import Replay
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.untrained import Rule
from qfolio.portfolio.following import on_table
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.mandate.feasible import exactly
from qfolio.portfolio.mandate.limits import feasible, mandate_text
from qfolio.portfolio.market import Holding
from qfolio.portfolio.prices.gaps import cash_outs
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.task import Portfolio
from qfolio.portfolio.universe import Patterns, spread

from populations import assert_same
from tables import findings, price_table, random_walk, weekdays
from tiny import DQN, PATHWISE

NAMES = tuple("ABCDEFGH")
SIGNALS = {"signals": "momentum:5,volatility:5", "anchor": "equal-weight"}


def moving(seed: int, rows: int, assets: int, haircut: float = 0.0) -> tuple[Prices, np.ndarray]:
    """A random table, in which the first asset stays, and the last row of each asset.

    Some assets join late, some are delisted, and some are members for a time.
    """
    rng = np.random.default_rng(seed)
    values = random_walk(rows, assets, rng, volatility=0.03)
    late = rng.random(assets) < 0.4
    begin = np.where(late, rng.integers(1, rows // 2, assets), 0)
    ends = rng.random(assets) < 0.5
    last = np.where(ends, rng.integers(rows // 2, rows - 1, assets), rows - 1)
    begin[0], last[0] = 0, rows - 1
    row = np.arange(rows)[:, None]
    values[(row < begin) | (row > last)] = np.nan
    paid = cash_outs(values, np.empty((rows, assets, 0)), haircut)
    paid.pop("features", None)
    member = rng.random((rows, assets)) < 0.8
    member[:, 0] = True
    content: dict[str, Any] = {"values": values, **paid, "members": member}
    return price_table(names=NAMES, dates=weekdays(rows, "2024-01-01"), **content), last


def frame_of_weights(prices: Prices) -> pd.DataFrame:
    """All in the first asset, from the first row on."""
    weights = np.tile(np.eye(len(prices.assets))[0], (1, 1))
    return pd.DataFrame(weights, pd.DatetimeIndex(prices.dates[:1], name="date"), prices.assets)


class Ledger:
    """Shares and money, one trade and one day at a time; prices after the last are not read."""

    def __init__(self, model: Itemized, prices: Prices, last: np.ndarray, haircut: float) -> None:
        self.model, self.last, self.haircut = model, last, haircut
        self.prices = np.where(np.isnan(prices.values), 1.0, prices.values)
        self.days = np.diff(prices.dates) / np.timedelta64(1, "D")

    def held(
        self, shares: np.ndarray, cash: float, start: int, end: int
    ) -> tuple[np.ndarray, float]:
        """Shares and cash some rows later; an asset is cashed out at its last price."""
        shares = shares.copy()
        for row in range(start, end):
            years = float(self.days[row]) / 365
            for i in range(len(shares)):
                if self.last[i] == row:
                    cash += shares[i] * self.prices[row, i] * (1 - self.haircut)
                    shares[i] = 0
            cash *= math.exp(float(self.model.cash_rate) * years)
            shares *= math.exp(float(self.model.carry_rate) * years)
        return shares, cash

    def worth(self, shares: np.ndarray, cash: float, row: int) -> float:
        priced = row <= self.last
        return float((shares * self.prices[row])[priced].sum() + cash)

    def paid(
        self, shares: np.ndarray, target: np.ndarray, wealth: float, left: float, row: int
    ) -> float:
        cost, total = self.model.cost, 0.0
        for i in range(len(shares)):
            if row > self.last[i]:
                assert shares[i] == target[1 + i] == 0
                continue
            change = target[1 + i] * left - shares[i] * self.prices[row, i]
            total += abs(change) * (cost / (1 - cost) if change > 0 else cost)
            if abs(target[1 + i] - shares[i] * self.prices[row, i] / wealth) > 1e-6:
                total += self.model.fixed
        return total

    def run(self, decisions: np.ndarray, lag: int) -> np.ndarray:
        shares, cash, returns = np.zeros(decisions.shape[1] - 1), self.model.capital, []
        for day, order in enumerate(decisions):
            row = day + lag
            wealth = self.worth(shares, cash, row)
            if not np.isnan(order).any():
                wanted, money = self.held(order[1:] / self.prices[day], order[0], day, row)
                worth = self.worth(wanted, money, row)
                target = np.append(money, wanted * self.prices[row]) / worth
                left = wealth
                for _ in range(14):  # each repetition is right for two more digits
                    left = wealth - self.paid(shares, target, wealth, left, row)
                shares, cash = target[1:] * left / self.prices[row], target[0] * left
            shares, cash = self.held(shares, cash, row, row + 1)
            returns.append(self.worth(shares, cash, row + 1) / wealth - 1)
        return np.array(returns)


def random_decisions(rng: np.random.Generator, prices: Prices, days: int) -> np.ndarray:
    """Orders that hold assets which are there alone; about a third of the rows have none."""
    assert prices.tradable is not None
    decisions = rng.dirichlet(np.ones(len(prices.assets) + 1), days)
    decisions[:, 1:] *= prices.tradable[:days]
    decisions[:, 0] += 1 - decisions.sum(-1)
    decisions[rng.random(days) < 0.3] = np.nan
    return decisions


def replayed(prices: Prices, decisions: np.ndarray, model: Itemized, lag: int) -> Any:
    known = Conditions.of(prices, model)
    return simulate(prices.values, decisions, first=0, cost=model, lag=lag, conditions=known)


@pytest.mark.parametrize(
    "group", [0, *(pytest.param(group, marks=pytest.mark.slow) for group in range(1, 5))]
)
def test_equals_a_ledger(group: int) -> None:
    """A hundred random tables, haircuts, memberships, costs, lags and orders a group."""
    rows, ended = 10, 0
    for case in range(100 * group, 100 * group + 100):
        rng = np.random.default_rng(case)
        haircut = float(rng.choice([0, 0.3, 0.9]))
        prices, last = moving(case, rows, 4, haircut)
        draw = lambda value, none: value if rng.random() < 0.5 else none  # noqa: B023, E731
        model = Itemized(
            cost=draw(0.01, 0.0), fixed=draw(20.0, 0.0), cash_rate=draw("0.05", "0"),
            carry_rate=draw("-0.02", "0"), capital=1e5,
        )  # fmt: skip
        lag = int(rng.integers(0, 4))
        decisions = random_decisions(rng, prices, rows - lag - 1)
        result = replayed(prices, decisions, model, lag)
        expected = Ledger(model, prices, last, haircut).run(decisions, lag)
        np.testing.assert_allclose(result.returns, expected, rtol=0, atol=1e-10)
        over = np.arange(lag, rows - 1)[:, None] > last
        assert (result.weights[:, 1:][over] == 0).all()
        ended += int(over.any())
    assert ended > 40


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_training_earns_what_the_replay_earns(lag: int) -> None:
    prices, _ = moving(3, 40, 5, haircut=0.5)
    text = "itemized(cash_rate=0.04, carry_rate=0.03)"
    task = Portfolio.of(prices, window=5, lag=lag, horizon=10, cost=0.002, cost_model=text)
    days = 40 - lag - 1
    decisions = random_decisions(np.random.default_rng(0), prices, days)
    decisions[np.isnan(decisions)] = np.tile([0.2, 0.8, 0, 0, 0, 0], (days, 1))[np.isnan(decisions)]
    assert isinstance(task.costs, Itemized)
    result = replayed(prices, decisions, task.costs, lag)
    settle = jax.jit(lambda *moves: task.settle(*moves))
    holding, growth = task.hold(jnp.eye(6)[0]), []
    for row in range(days):
        action = jnp.asarray(decisions[row], jnp.float32)
        reward, holding = settle(jnp.array(row), jnp.array(row + 1), holding, action)
        growth.append(float(reward))
    np.testing.assert_allclose(growth, result.growth, rtol=0, atol=3e-6)
    assert result.returns.min() < -0.05  # a haircut


@pytest.mark.parametrize("mandate", [None, {"cash": {"max": 0.2}, "trading": {"turnover": 0.5}}])
@pytest.mark.parametrize("seed", range(3))
def test_what_comes_and_goes_later_changes_nothing_before(seed: int, mandate: Any) -> None:
    prices, _ = moving(seed, 60, 6, haircut=0.4)
    now = 30 + 5 * seed
    gone = np.array(prices.listed)
    gone[now + 1 :, 0] = False  # the asset that stays is delisted after all
    members = np.array(prices.members)
    members[now + 1 :] ^= True
    values = np.array(prices.values)
    values[now + 1 :] *= np.linspace(0.5, 2, 6)
    other = replace(prices, values=values, listed=gone, members=members)
    one, two = (
        Portfolio.of(p, window=5, horizon=5, mandate=mandate, **SIGNALS).part(0, now)
        for p in (prices, other)
    )
    wanted = jnp.asarray(np.random.default_rng(seed).dirichlet(np.ones(7)), jnp.float32)
    view = jax.jit(
        lambda task, row: (
            task.view(row, task.hold(wanted)),
            task.target(row, task.hold(wanted), wanted),
        )
    )
    for row in range(6, now + 1):
        seen = [jax.tree.map(np.asarray, view(task, jnp.array(row))) for task in (one, two)]
        assert_same(*seen)
        there = prices.tradable[row]  # type: ignore[index]
        assert (seen[0][1][1:][~there] == 0).all()
        assert (seen[0][0].anchor[~there] == 0).all()
    for name in ("equal-weight", "inverse-volatility"):
        np.testing.assert_array_equal(path(name, prices)[: now + 1], path(name, other)[: now + 1])
    folds = [Fold("one", slice(0, 20), slice(20, 59), slice(0, 20))]
    for name in ("equal-weight", "buy-and-hold", "inverse-volatility", "pamr"):
        given = [
            orders(name, baseline(name), folds, p.dates, p.values, universe=p.tradable)
            for p in (prices, other)
        ]
        decided = [x.decisions[: now - 19] for x in given]
        np.testing.assert_array_equal(decided[0], decided[1], err_msg=name)


def test_equal_weights_are_spread_over_what_is_there() -> None:
    prices, _ = moving(1, 60, 6)
    assert prices.tradable is not None
    equal = prices.tradable / prices.tradable.sum(1, keepdims=True)
    folds = [Fold("one", slice(0, 20), slice(20, 59), slice(0, 20))]
    given = orders(
        "equal-weight", baseline("equal-weight"), folds, prices.dates, prices.values,
        universe=prices.tradable,
    )  # fmt: skip
    np.testing.assert_allclose(given.decisions[:, 1:], equal[20:59], atol=1e-15)
    np.testing.assert_allclose(path("equal-weight", prices), equal, atol=1e-15)
    anchored = Portfolio.of(prices, window=5, horizon=5, **SIGNALS)
    weights = jax.vmap(anchored.anchor_weights)(jnp.arange(60))
    assert weights is not None
    np.testing.assert_allclose(weights, equal, atol=1e-6)


def test_once_a_fold_is_a_new_target_only_where_assets_come_or_go() -> None:
    class Fastest(Baseline):
        """All in what rose most since the table began."""

        def decide(self, history: History, held: np.ndarray) -> np.ndarray:
            asked.append(len(history.prices) - 1)
            rose = np.where(history.tradable, history.prices[-1] / history.prices[0], 0)
            return np.append(0.0, rose == rose.max())

    folds = [Fold("one", slice(0, 20), slice(20, 35), slice(0, 20)),
             Fold("two", slice(0, 35), slice(35, 59), slice(0, 35))]  # fmt: skip
    values, every = random_walk(60, 3), np.ones((60, 3), bool)
    gone = every.copy()
    gone[45:, int((values[35] / values[0]).argmax())] = False
    found = []
    for universe, expected in ((None, [20, 35]), (every, [20, 35]), (gone, [20, 35, 45])):
        asked: list[int] = []
        given = orders("own", Fastest(), folds, weekdays(60), values, universe=universe)
        found.append(given.decisions)
        assert asked == expected
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0][:25], found[2][:25])  # what leaves later is not known
    assert (found[2][25:] != found[0][25:]).any(axis=1).all()


def test_signals_rank_those_that_are_there() -> None:
    prices, _ = moving(2, 60, 6)
    assert prices.tradable is not None
    task = Portfolio.of(prices, window=5, horizon=5, **SIGNALS)
    momentum = np.asarray(task.extra[..., 0])
    assert np.isnan(momentum[~prices.tradable]).all()
    for row in range(40, 60):
        known = prices.tradable[row] & ~np.isnan(prices.known[row - 5])
        if known.sum() > 1:
            assert sorted(momentum[row, known]) == pytest.approx(np.linspace(-1, 1, known.sum()))


def test_a_policy_over_all_assets_becomes_one_over_those_that_are_there() -> None:
    there = jnp.array([True, False, True])
    put = lambda *weights, long_only=True: spread(jnp.array(weights), there, long_only)  # noqa: E731
    np.testing.assert_allclose(put(0.2, 0.2, 0.4, 0.2), [0.2, 0.4, 0, 0.4], atol=1e-6)
    np.testing.assert_allclose(put(0.5, 0.0, 0.5, 0.0), [1.0, 0, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(put(0.25, 0.5, 0, 0.25), [0.25, 0.5, 0, 0.25])
    shorted = put(0.2, 1.0, 0.3, -0.5, long_only=False)
    np.testing.assert_allclose(shorted, [0.5, 1.0, 0, -0.5], atol=1e-6)


def test_a_complete_table_has_no_masks() -> None:
    frame = frame_of(30, 3)
    task = Portfolio.of(load(frame, ended="cash-out"), window=5, horizon=5)
    assert task.tradable is None
    assert task.conditions.listed is None


def test_survivors_alone_look_better_than_the_truth() -> None:
    """A third of a made-up market dies after a fall, with nothing left for its holders."""
    rng = np.random.default_rng(5)
    logs = 0.01 * rng.normal(size=(750, 30)) + 0.0003
    for asset, end in enumerate(rng.integers(300, 740, 10)):
        logs[end - 40 : end, asset] -= 0.02
        logs[end:, asset] = np.nan
    frame = pd.DataFrame(100 * np.exp(np.cumsum(logs, 0)), pd.bdate_range("2020", periods=750))
    frame.columns = [f"X{j}" for j in range(30)]
    true = load(frame, ended="cash-out", delisting_haircut=1)
    survivors = load(frame.iloc[:, 10:])
    growth = []
    for table in (true, survivors):
        folds = [Fold("one", slice(0, 200), slice(200, 748), slice(0, 200))]
        given = orders(
            "equal-weight", baseline("equal-weight"), folds, table.dates, table.values,
            universe=table.tradable,
        )  # fmt: skip
        known = Conditions.of(table)
        result = simulate(table.values, given.decisions, first=200, cost=0.001, conditions=known)
        growth.append(result.growth.sum())
    assert growth[1] > growth[0] + 0.3


def test_a_backtest_keeps_its_universe(tmp_path: Path) -> None:
    prices, _ = moving(4, 160, 4, haircut=0.2)
    agents = {"tilts": preset("fast", "portfolio", "tilts")}
    made = Backtest.create(
        prices, agents, train="100d", test="30d", out=tmp_path / "run",
        baselines=["equal-weight"],
    )  # fmt: skip
    again = Backtest.open(tmp_path / "run").prices
    assert again.digest == made.prices.digest
    np.testing.assert_array_equal(again.tradable, prices.tradable)
    # Orders of later days lose what a delisting lost there.
    known = pd.DataFrame(prices.known, pd.DatetimeIndex(prices.dates, name="date"), prices.assets)
    known.to_csv(tmp_path / "latest.csv")
    for options, lost in (({}, 0.2), ({"delisting_haircut": 0.5}, 0.5), ({"ended": "gap"}, None)):
        read = Desk.open(tmp_path / "run", missing="forward-fill", **options).inspect
        latest, _ = read(tmp_path / "latest.csv")
        assert latest is not None
        assert latest.haircut == lost


# Mandates and menus.

LIMITS = {
    "assets": {"cap": 0.5, "floor": {"B": 0.05}},
    "groups": {"kind": {"x": {"assets": ["C", "D"], "cap": 0.6, "floor": 0.1}}},
    "cash": {"max": 0.2},
}


def required(there: np.ndarray) -> dict[str, float]:
    """The floors and the maximum of cash that can be met with the assets that are there."""
    caps = 0.5 * there
    group = min(0.6, caps[2:4].sum())
    most = min(1.0, caps.sum() - caps[2:4].sum() + group)
    return {"B": 0.05 * there[1], "group": min(0.1, group), "cash": max(0.2, 1 - most)}


@pytest.mark.parametrize("cases", [range(10), pytest.param(range(10, 200), marks=pytest.mark.slow)])
def test_every_order_obeys_the_mandate_of_its_row(cases: range) -> None:
    """Random tables, by training's functions and by baselines."""
    order = jax.jit(jax.vmap(lambda task, row, w: task.wanted(row, task.hold(w), w), (None, 0, 0)))
    absent = 0
    for case in cases:
        prices, _ = moving(case, 40, 5)
        assert prices.tradable is not None
        task = Portfolio.of(prices, window=5, horizon=5, mandate=LIMITS)
        rng = np.random.default_rng(case)
        wanted = rng.dirichlet(np.full(6, 0.6), 40)
        found = np.asarray(order(task, jnp.arange(40), jnp.asarray(wanted, jnp.float32)))
        folds = [Fold("one", slice(0, 10), slice(10, 38), slice(0, 10))]
        backtest = Replay(prices, folds, task, 1.0)
        entry, _ = backtest.baseline("baseline", "equal-weight", baseline("equal-weight"))
        for row, weights in [*enumerate(found), *enumerate(entry.decisions[0], 10)]:
            there = prices.tradable[row]
            assert (weights[1:][~there] == 0).all()
            least = required(there)
            assert weights[1:].max() <= 0.5 + 2e-6
            assert weights[2] >= least["B"] - 2e-6
            assert least["group"] - 2e-6 <= weights[3:5].sum() <= 0.6 + 2e-6
            assert weights[0] <= least["cash"] + 2e-6
            absent += int((~there).any())
    assert absent > 10 * len(cases)


def test_limits_of_every_set_of_assets_can_be_met() -> None:
    """Also where those that are there are fewer than floors need, and where only others go short.

    With three holdings at a cap of 0.3, A and B alone cannot invest 0.8.
    """
    there = np.array([[(i >> j) & 1 for j in range(4)] for i in range(16)], bool)
    few = {"assets": {"cap": {"A": 0.1, "B": 0.3, "C": 0.3, "D": 0.3}}, "cash": {"max": 0.2},
           "trading": {"holdings": 3}}  # fmt: skip
    short = {"assets": {"cap": 0.6, "floor": {"A": -0.2}}, "cash": {"min": 0.0, "max": 1.0},
             "groups": {"kind": {"x": {"assets": ["C"], "floor": 0.3}}}}  # fmt: skip
    for mandate in (few, short):
        text = mandate_text(mandate, NAMES[:4])
        patterns, _ = Patterns.of(text, there, 1.0)
        every = feasible(text, np.ones(4, bool))
        for row, present in enumerate(there):
            made = patterns.at(row, every)
            weights = exactly(made, np.array([0, 0.25, 0.25, 0.25, 0.25]), np.eye(5)[0])
            assert max(made.violations(weights).values()) < 1e-6, (mandate, present)
            assert (weights[1:][~present] == 0).all()
    patterns, said = Patterns.of(mandate_text(few, NAMES[:4]), there, 1.0)
    cash = 1 + patterns.most[patterns.of_row, 1]
    assert cash[there.all(1)] == pytest.approx(0.2)
    np.testing.assert_allclose(cash[there.sum(1) == 3], [0.3, 0.3, 0.3, 0.2], atol=1e-6)
    assert said == ["cash at 14 of 16 rows"]


@pytest.mark.slow
def test_a_mandate_in_motion_is_said_and_checked_over_a_whole_backtest(tmp_path: Path) -> None:
    prices, _ = moving(4, 160, 4, haircut=0.2)
    backtest = Backtest.create(
        prices, {"pathwise": PATHWISE, "dqn": DQN}, train="100d", test="30d", seeds=1,
        out=tmp_path / "run", baselines=["momentum"], mandate=LIMITS,
        strategies={"mine": frame_of_weights(prices)},
    )  # fmt: skip
    backtest.run()
    entries, notes = Backtest.open(tmp_path / "run").entries()
    assert any(note.startswith("The mandate is relaxed to fit the assets") for note in notes)
    assert any(note.startswith("mine breaks the mandate in") for note in notes)
    first = backtest.folds[0].decisions.start
    for name in ("pathwise", "dqn", "momentum", "equal-weight"):
        assert (~np.isnan(entries[name].decisions[0])).all(1).any(), name
        for row, order in enumerate(entries[name].decisions[0], first):
            if not np.isnan(order).any():
                there = prices.tradable[row]  # type: ignore[index]
                assert (order[1:][~there] == 0).all(), name
                assert order[0] <= required(np.append(there, False))["cash"] + 1e-5, name


@pytest.mark.parametrize("seed", range(3))
def test_an_order_over_several_rows_buys_nothing_that_has_left(seed: int) -> None:
    prices, _ = moving(seed, 60, 5)
    assert prices.tradable is not None
    limits = {"trading": {"fill": 6}}
    task = Portfolio.of(prices, window=5, horizon=5, calendar="8", mandate=limits)
    wanted = np.random.default_rng(seed).dirichlet(np.ones(6), 60)

    def step(held: Holding, given: tuple) -> tuple[Holding, tuple]:
        row, action = given
        target, plan = task.trade(row, held, task.wanted(row, held, action))
        after = Holding(task.drifted(row, target), held.reward, task.planned(row, plan))
        return after, (held.weights, target)

    start = task.hold(jnp.eye(6)[0])
    rows = jnp.arange(5, 59)
    given = rows, jnp.asarray(wanted[5:59], jnp.float32)
    held, after = (np.asarray(x) for x in jax.jit(lambda: jax.lax.scan(step, start, given)[1])())
    gone = ~prices.tradable[5:59]
    assert (after[:, 1:] <= held[:, 1:] + 1e-6)[gone].all()
    assert (after[:, 1:] > held[:, 1:] + 1e-3).sum() > 50
    folds = [Fold("one", slice(0, 20), slice(20, 58), slice(0, 20))]
    terms = AT_EVERY_ROW._replace(decides=np.arange(60) % 8 == 0, fill=6)
    found = orders(
        "equal-weight", baseline("equal-weight"), folds, prices.dates, prices.values,
        universe=prices.tradable, conditions=Conditions.of(prices), terms=terms,
    )  # fmt: skip
    relatives = np.nan_to_num(prices.values[1:] / prices.values[:-1], nan=1.0)
    holding = np.eye(6)[0]
    assert (~np.isnan(found.decisions)).all(1).sum() > 10
    for row, order in zip(range(20, 58), found.decisions, strict=True):
        if not np.isnan(order).any():
            assert (order[1:] <= holding[1:] + 1e-9)[~prices.tradable[row]].all()
            holding = order
        holding = holding * np.append(1, relatives[row])
        holding /= holding.sum()


def test_baselines_keep_to_the_calendar_in_every_fold() -> None:
    """Also those that decide once a fold, whose second one begins between two decisions."""
    prices, _ = moving(0, 60, 5)
    folds = [Fold("one", slice(0, 20), slice(20, 37), slice(0, 20)),
             Fold("two", slice(0, 37), slice(37, 58), slice(0, 37))]  # fmt: skip
    task = Portfolio.of(prices, window=5, horizon=5, calendar="10").deciding_at(20)
    entry, _ = Replay(prices, folds, task, 1.0).baseline(
        "baseline", "equal-weight", baseline("equal-weight")
    )
    assert np.flatnonzero(~np.isnan(entry.decisions[0, :, 0])).tolist() == [0, 10, 20, 30]


def test_what_a_delisting_paid_counts_as_cash_for_baselines() -> None:
    """Its sale takes nothing of the turnover that a mandate allows."""
    frame = frame_of(40, 3)
    frame.iloc[25:, 0] = np.nan
    prices = load(frame, ended="cash-out")
    mandate = {"trading": {"turnover": 0.1}}
    task = Portfolio.of(prices, window=5, horizon=5, mandate=mandate)
    folds = [Fold("one", slice(0, 10), slice(10, 38), slice(0, 10))]
    entry, _ = Replay(prices, folds, task, 1.0).baseline(
        "baseline", "equal-weight", baseline("equal-weight")
    )
    decisions = entry.decisions[0]
    assert decisions[14, 1] > 0.3  # the last row with a price of A
    assert decisions[15, 0] == pytest.approx(decisions[14, 1] - 0.1, abs=0.02)
    assert decisions[16, 0] == pytest.approx(decisions[15, 0] - 0.1, abs=0.02)


@pytest.mark.parametrize("name", ["minimum-variance", "volatility-timing"])
def test_what_was_delisted_long_ago_does_not_shorten_the_training(name: str) -> None:
    """It started late; what it paid out is no price of the years since."""
    frame = frame_of(90, 4)
    frame.iloc[:20, 3], frame.iloc[30:, 3] = np.nan, np.nan
    folds = [Fold("one", slice(0, 60), slice(60, 88), slice(30, 60))]
    found = []
    for columns in (4, 3):
        prices = load(frame.iloc[:, :columns], late="join", ended="cash-out")
        task = Portfolio.of(prices, window=5, horizon=5)
        entry, _ = Replay(prices, folds, task, 1.0).baseline("baseline", name, baseline(name))
        rule = Rule(name, baseline(name), prices.assets, task, train="60d", expanding=True, cap=1.0)
        found.append((entry.decisions[0, :, :4], list(rule.weights(prices).values())[:4]))
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_an_asset_earns_what_cash_earns_until_its_first_price() -> None:
    frame = frame_of(40, 3)
    frame.iloc[:25, 0] = np.nan
    prices = load(frame, late="join")
    costs = {"cost_model": "itemized(cash_rate=0.05,carry_rate=0.02)"}
    task = Portfolio.of(prices, window=5, horizon=5, **costs)
    folds = [Fold("one", slice(0, 10), slice(10, 38), slice(0, 10))]
    cash, late, *others = Replay(prices, folds, task, 1.0).growth.T
    assert (cash > 1).all()
    np.testing.assert_array_equal(late[:14], cash[:14])  # up to the return of row 25
    assert (late[14:] != cash[14:]).all()
    assert (others[0] != cash).all()


def test_what_a_delisting_paid_earns_what_cash_earns() -> None:
    """In the returns that are attributed, too, and not what is paid to hold assets."""
    frame = frame_of(40, 3)
    frame.iloc[25:, 0] = np.nan
    costs = {"cost_model": "itemized(cash_rate=0.05,carry_rate=0.02)"}
    task = Portfolio.of(load(frame, ended="cash-out"), window=5, horizon=5, **costs)
    folds = [Fold("one", slice(0, 10), slice(10, 38), slice(0, 10))]
    cash, paid, *others = Replay(load(frame, ended="cash-out"), folds, task, 1.0).growth.T
    assert (cash > 1).all()
    np.testing.assert_allclose(paid[14:], cash[14:], rtol=1e-12)
    assert (others[0][14:] != cash[14:]).all()


@pytest.mark.parametrize("lag", [0, 1])
def test_a_step_in_which_an_asset_pays_out_is_measured(lag: int) -> None:
    frame = frame_of(40, 2)
    frame.iloc[25:, 0] = np.nan
    prices = load(frame, ended="cash-out", delisting_haircut=0.3)
    task = Portfolio.of(prices, window=5, horizon=5, lag=lag, anchor="equal-weight")
    state = Position(jnp.array(24 - lag), task.hold(jnp.array([0.0, 1.0, 0.0])))
    action, end = jnp.array([0.0, 1.0, 0.0]), jnp.array(False)
    step = task.step(state, action, jax.random.key(0))
    now = Transition(state, (), action, step.reward, step.state, (), end, end)
    measured = {name: float(x) for name, x in task.measure(now).items()}
    assert measured["growth"] == pytest.approx(float(step.reward), abs=1e-6)
    assert measured["growth"] == pytest.approx(np.log(0.7), abs=1e-6)
    wanted = {"turnover": 0.0, "cash": 0.0, "assets": 1.0, "distance": 0.5}
    assert {name: measured[name] for name in wanted} == pytest.approx(wanted, abs=1e-5)


def test_rows_without_a_member_are_too_few() -> None:
    prices = load(frame_of(80, 2))
    members = np.ones((80, 2), bool)
    members[:40] = False
    with pytest.raises(QfolioError, match=r"No asset can be traded over these rows; .*members"):
        Portfolio.of(replace(prices, members=members), window=5, horizon=5).part(0, 38)


@pytest.mark.parametrize("menu", ["grid:4", "tilts:0.2", "overweight:0.2"])
def test_menus_order_what_is_there(menu: str) -> None:
    prices, _ = moving(2, 60, 5)
    assert prices.tradable is not None
    task = Portfolio.of(prices, window=5, horizon=5, menu=menu)
    held = task.hold(jnp.asarray(np.append(0.4, 0.6 * np.eye(5)[0]), jnp.float32))
    assert isinstance(task.actions, Discrete)
    every = jnp.arange(task.actions.n)
    orders_at = jax.jit(jax.vmap(task.wanted, (None, None, 0)))
    for row in range(10, 60, 7):
        found = np.asarray(orders_at(jnp.array(row), held, every))
        there = prices.tradable[row]
        assert (found[:, 1:][:, ~there] == 0).all()
        np.testing.assert_allclose(found.sum(1), 1, atol=1e-6)
        if menu != "grid:4":
            equal = np.append(0, there / there.sum())
            assert (abs(found - equal).max(1) < 1e-6).any()


# Reading.


def frame_of(rows: int, assets: int) -> pd.DataFrame:
    dates = pd.bdate_range("2024-01-01", periods=rows, name="date")
    return pd.DataFrame(random_walk(rows, assets), dates, list(NAMES[:assets]))


def test_a_table_with_leavers_is_read(tmp_path: Path) -> None:
    frame = frame_of(30, 4)
    frame.loc[frame.index[:6], "B"] = np.nan
    frame.loc[frame.index[20:], "C"] = np.nan
    file = tmp_path / "prices.csv"
    frame.to_csv(file)
    said = " ".join(f"{finding} {finding.advice}" for finding in findings(file, late="join"))
    assert "no prices after 2024-01-26" in said
    assert "--ended" in said
    prices = load(file, late="join", ended="cash-out", delisting_haircut=0.25)
    assert prices.tradable is not None
    assert (prices.haircut, prices.between(0, 20).haircut) == (0.25, None)
    np.testing.assert_array_equal(prices.tradable, frame.notna())
    np.testing.assert_allclose(prices.values[20:, 2], 0.75 * frame["C"].iloc[19], rtol=1e-12)
    np.testing.assert_allclose(prices.values[prices.tradable], frame.to_numpy()[frame.notna()])
    frame.loc[frame.index[10], "C"] = np.nan  # a gap inside remains one
    with pytest.raises(QfolioError, match="is missing"):
        load(frame, late="join", ended="cash-out")
    filled = load(frame, late="join", ended="cash-out", missing="forward-fill")
    assert filled.listed is not None
    assert filled.listed[:, 2].sum() == 20
    with pytest.raises(QfolioError, match=r"delisting_haircut is 0\.5, .*ended=cash-out"):
        load(frame, delisting_haircut=0.5)


@pytest.mark.parametrize("missing", ["error", "forward-fill", "drop-asset"])
def test_a_folder_keeps_the_delistings_of_its_tables(tmp_path: Path, missing: str) -> None:
    frame = frame_of(30, 3)
    frame.loc[frame.index[20:], "B"] = np.nan
    folder, apart = tmp_path / "together", tmp_path / "apart"
    for place in (folder, apart):
        place.mkdir()
    frame.to_csv(folder / "prices.csv")
    for name in frame:
        frame[[name]].rename(columns={name: "close"}).to_csv(apart / f"{name}.csv")
    whole = load(frame, missing=missing, ended="cash-out", delisting_haircut=0.5)
    assert whole.listed is not None
    assert whole.listed[:, 1].sum() == 20
    for place in (folder, apart):
        found = load(place, missing=missing, ended="cash-out", delisting_haircut=0.5)
        assert found.assets == whole.assets
        np.testing.assert_array_equal(found.listed, whole.listed)
        np.testing.assert_allclose(found.values, whole.values)


@pytest.mark.parametrize("choice", [{"missing": "forward-fill"}, {"ended": "cash-out"}])
def test_a_column_of_all_assets_needs_no_row_of_each(choice: dict[str, str]) -> None:
    frame = frame_of(30, 3)
    rate = pd.Series(np.linspace(0.01, 0.02, 30), frame.index, name="rate")
    long = frame.rename_axis(columns="ticker").stack().rename("close").reset_index()
    long["rate"] = rate.reindex(long["date"]).to_numpy()
    gone = (long["ticker"] == "B") & (long["date"] >= frame.index[28])
    if "missing" in choice:
        gone = (long["ticker"] == "B") & (long["date"] == frame.index[7])
    found = load(long[~gone], columns=["rate"], **choice)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.market[:, 0], rate)
    long.loc[4, "rate"] = 0.5
    with pytest.raises(QfolioError, match="has several numbers on one date"):
        load(long, columns=["rate"])


def test_members_by_rows_and_by_spans(tmp_path: Path) -> None:
    frame = frame_of(30, 3)
    rows = pd.DataFrame(
        {"A": [1, 1], "B": [0, 1], "C": [1, 0], "Z": [1, 1]},
        pd.Index(["2024-01-03", "2024-01-15"], name="date"),
    )
    rows.to_csv(tmp_path / "rows.csv")
    (tmp_path / "spans.csv").write_text(
        "asset,from,to\nA,2024-01-03,2024-01-08\nB,2024-01-15,\nC,2024-01-03,2024-01-12\nZ,,\n"
        "A,2024-01-09,\n"  # it comes back the next day
    )
    day = frame.index
    wanted = np.stack(
        [
            day >= "2024-01-03",
            day >= "2024-01-15",
            (day >= "2024-01-03") & (day < "2024-01-15"),
        ],
        -1,
    )
    with pytest.raises(QfolioError, match=r"do not name|has no rows"):
        load(frame, members=pd.DataFrame())
    numbered = rows.reset_index()
    numbered.to_csv(tmp_path / "numbered.csv")
    rows.astype(bool).to_csv(tmp_path / "truth.csv")
    for source in (
        rows,
        rows[::-1],
        numbered.set_axis([7, 9]),  # numbers that are no dates
        numbered[["A", "B", "C", "Z", "date"]],
        rows.astype(bool),
        *(tmp_path / name for name in ("rows.csv", "numbered.csv", "truth.csv", "spans.csv")),
    ):
        np.testing.assert_array_equal(load(frame, members=source).members, wanted)
    for text, said in (("", "has no rows"), ("2024-01-03,1,1,1\n" * 2, "2024-01-03 appears twice")):
        (tmp_path / "wrong.csv").write_text("date,A,B,C\n" + text)
        with pytest.raises(QfolioError, match=said):
            load(frame, members=tmp_path / "wrong.csv")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("date,A,B\n2024-01-01,1,1\n", "do not name 'C'"),
        ("date,A,B,C\n2024-01-01,1,2,1\n", "'B' is neither 0 nor 1 in row 2"),
        ("date,A,B,C\nsoon,1,1,1\n", "in row 2"),
        ("name,from,to\nA,,\n", "name it asset|do not name"),
        ("asset,from,to\nA,,\nB,,\nC,never,\n", "'from' in row 4"),
        ("asset,from,to\nA,,\nB,,\nC,2024-01-09,2024-01-02\n", "row 4 goes from 2024-01-09 to"),
        ("asset,from,until\nA,,\nB,,\nC,,\n", "'asset', but not both from and to; .* 'until'"),
    ],
)
def test_members_that_cannot_be_read(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "members.csv").write_text(text)
    with pytest.raises(QfolioError, match=said):
        load(frame_of(30, 3), members=tmp_path / "members.csv")


@pytest.mark.parametrize("short", [False, True])
def test_what_a_delisting_costs_or_pays_earns_what_cash_does_without_an_order(short: bool) -> None:
    """A short position that was settled is no loan, although cash was not ordered to pay it."""
    frame = frame_of(40, 2)
    frame.iloc[10:, 0] = np.nan
    model = Itemized(cash_rate="0.03", borrow_fee="0.05", borrow_spread=0.05, cost=0.0)
    prices = load(frame, ended="cash-out")
    order = np.array([1.5, -0.5, 0.0] if short else [0.5, 0.5, 0.0])
    decisions = np.full((39, 3), np.nan)
    decisions[0] = order
    known = Conditions.of(prices, model)
    replay = partial(
        simulate, prices.values, first=0, cost=model, lag=0, conditions=known, long_only=False
    )
    cash = np.full((39, 3), np.nan)
    cash[0] = [1, 0, 0]
    np.testing.assert_allclose(
        replay(decisions=decisions).returns[10:], replay(decisions=cash).returns[10:], atol=1e-12
    )


def late_then_ending(rows: int = 120) -> tuple[Prices, Prices]:
    """A table in which D starts late, and the same in which C then ends."""
    frame = frame_of(rows, 4)
    frame.iloc[: rows - 20, 3] = np.nan
    late = load(frame, late="join")
    frame.iloc[rows - 5 :, 2] = np.nan
    return late, load(frame, late="join", ended="cash-out")


@pytest.mark.parametrize("limits", [{"max_weight": 0.5}, {"mandate": {"assets": {"cap": 0.5}}}])
def test_a_first_delisting_opens_no_asset_that_training_did_not_cover(limits: dict[str, Any]):
    late, ended = late_then_ending()
    task = Portfolio.of(late, window=5, horizon=10, **limits)
    live, last = on_table(task, ended), jnp.array(len(ended) - 1)
    cash, wanted = jnp.eye(5)[0], jnp.array([0.0, 0.1, 0.1, 0.1, 0.7])
    ordered = live.allow(last, live.hold(cash), wanted)
    assert ordered[4] == pytest.approx(0, abs=1e-6)
    again = on_table(task.on_rows(ended, 60), ended)  # an update covers it
    assert again.allow(last, again.hold(cash), wanted)[4] == pytest.approx(0.5, abs=1e-5)


def test_floors_yield_where_training_did_not_cover_their_asset():
    late, ended = late_then_ending()
    groups = {"kind": {"late": {"assets": ["D"], "floor": 0.1}}}
    task = Portfolio.of(late, window=5, horizon=10, mandate={"groups": groups})
    live, last, first = on_table(task, ended), jnp.array(len(ended) - 1), jnp.eye(5)[1]
    ordered = live.allow(last, live.hold(jnp.eye(5)[0]), first)
    np.testing.assert_allclose(ordered, first, atol=1e-5)
