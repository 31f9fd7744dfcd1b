"""From a backtest on assets that come and go to orders, their ledger and what they earn."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.presets import Preset
from qfolio.portfolio.backtest.baselines.equal_weight import BuyAndHold
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.holdings import cashed_out
from qfolio.portfolio.desk.live import mark
from qfolio.portfolio.desk.untrained import Rule
from qfolio.portfolio.prices.table import Prices

from tables import days, price_table, random_walk

ASSETS = ("A", "B", "C", "D", "E")
ROWS, FIRST, NOW, LEAVES = 170, 140, 150, 156
AGENT = Preset(
    "pathwise", {"rollout_length": 10, "num_envs": 2, "hidden": (4,)}, episodes=4,
    task={"window": 5, "horizon": 10},
)  # fmt: skip
MANDATE = {
    "assets": {"cap": 0.4},
    "groups": {"kind": {"x": {"assets": ["B", "C"], "cap": 0.5, "floor": 0.2}}},
    "cash": {"max": 0.3},
}


def table(rows: int) -> Prices:
    """E joins, C is no member around row NOW, D is delisted before it, and B at LEAVES."""
    values = random_walk(ROWS, 5, seed=1, volatility=0.02)
    listed, members = np.ones((ROWS, 5), bool), np.ones((ROWS, 5), bool)
    values[:60, 4], listed[:60, 4] = np.nan, False
    for asset, row, paid in ((3, NOW - 5, 0.5), (1, LEAVES, 0.8)):
        values[row:, asset] = values[row - 1, asset] * paid
        listed[row:, asset] = False
    members[NOW - 3 : NOW + 3, 2] = False
    dates = days(ROWS, "2024-01-01")
    return price_table(values, ASSETS, dates, listed=listed, members=members).between(0, rows)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Its backtest ends before anything is delisted; then there are more rows."""
    folder = tmp_path_factory.mktemp("moving") / "run"
    Backtest.create(
        table(FIRST), {"pathwise": AGENT}, out=folder, train="100d", test="30d", seeds=1,
        baselines=["inverse-volatility"], mandate=MANDATE,
    ).run()  # fmt: skip
    opened = Desk.open(folder)
    opened.inspect = lambda path: (table(int(str(path))), [])
    return opened


@pytest.mark.parametrize("name", ["pathwise", "equal-weight", "inverse-volatility"])
def test_orders_hold_what_is_there_and_are_reproduced(desk, name):
    followed = desk.followed(name)
    prices = desk.table(followed, Path(str(NOW + 1)))
    held = np.array([1.0, 2, 3, 4, 0])
    shares, cash, said = cashed_out(held, 100.0, prices)
    assert cash == pytest.approx(100 + 4 * prices.values[-1, 3])
    assert len(said) == 1
    assert said[0].startswith("D is delisted; 4 shares count as")
    made = Allocation.of(followed, prices, shares, cash)
    assert made.trades[2] == -3  # no member
    assert made.trades[3] == 0
    assert made.weights[2] >= 0.2 - 1e-5  # B has the group's floor alone
    assert made.weights[1:].max() <= 0.4 + 1e-5
    assert made.weights[0] <= 0.3 + 1e-5
    record, _ = desk.record(name, made, prices, whole_shares=False)
    date = record.date
    for given in (
        (None, None),
        (Path(str(ROWS)), (held, 100.0)),
    ):  # a longer table has more delistings
        again, found = desk.reproduce(date, *given)
        assert again.number == record.number
        np.testing.assert_allclose(found.weights, made.weights, atol=1e-6)
    weights = followed.weights(prices, {"D": 0.5, "cash": 0.5})
    assert weights["D"] == weights["C"] == 0


def test_what_is_told_to_be_held_of_a_delisted_asset_is_cash(desk):
    policy, prices = desk.run.policy("pathwise"), table(NOW)
    assert policy.weights(prices, {"A": 0.3, "D": 0.4}) == policy.weights(prices, {"A": 0.3})
    task = desk.run.any_task
    rule = Rule("hold", BuyAndHold(), ASSETS, task, train="100d", expanding=True, cap=1.0)
    held = {"cash": 0.4, "A": 0.6, "B": 0, "C": 0, "D": 0, "E": 0}
    assert rule.weights(prices, {"A": 0.6, "D": 0.4}) == pytest.approx(held)


def test_a_table_without_its_members_is_refused(desk):
    desk = Desk(desk.run, desk.folder, lambda path: (_without_members(int(str(path))), []))
    with pytest.raises(QfolioError, match="--members"):
        desk.table(desk.followed("equal-weight"), Path(str(NOW)))


def test_prices_that_may_be_late_are_no_delisting(desk):
    """D has its last price at row NOW − 6. Five rows without one may be late, six are not."""
    for rows in (NOW - 4, NOW):
        with pytest.raises(QfolioError) as error:
            desk.read(Path(str(rows)))
        assert str(error.value) == (
            f"The prices end on {table(rows).dates[-1].astype('M8[D]')}, but those of D "
            "(2024-05-24) end earlier; fetch them again or, if the assets were delisted, add "
            "--ended cash-out."
        )
    assert desk.read(Path(str(NOW + 1))).listed is not None
    known = Desk(desk.run, desk.folder, desk.inspect, delists=True)
    followed, prices = desk.followed("equal-weight"), known.read(Path(str(NOW)))
    allocation = Allocation.of(followed, prices, np.zeros(5), 1000.0)
    said = known.terms(followed, prices, allocation, 0.0)
    assert "These assets count as delisted since the backtest: D (2024-05-24)." in said


def test_where_only_members_change_a_missing_price_is_an_error(desk, tmp_path):
    frame = table(FIRST + 5).to_frame()
    members = pd.DataFrame(1, frame.index[:1], list(ASSETS)).rename_axis("date")
    path = tmp_path / "latest.csv"
    frame.to_csv(path)
    assert len(Desk.open(desk.folder, members=members).read(path)) == FIRST + 5
    frame.iloc[-1, 0] = np.nan
    frame.to_csv(path)
    with pytest.raises(QfolioError, match=r"no prices after 2024-05-23.*\(--ended\)"):
        Desk.open(desk.folder, members=members).read(path)
    assert Desk.open(desk.folder, members=members, ended="cash-out").read(path).listed is not None


def test_memberships_that_have_ended_are_refused(desk, tmp_path):
    """They would have everything sold."""
    path = tmp_path / "latest.csv"
    table(FIRST + 5).to_frame().to_csv(path)
    spans = pd.DataFrame({"asset": ASSETS, "from": "2020-01-01", "to": "2024-05-23"})
    ended = Desk.open(desk.folder, members=spans)
    with pytest.raises(QfolioError, match=r"^No asset may be held on 2024-05-24, .* --members\.$"):
        ended.table(ended.followed("equal-weight"), path)
    ended.read(path)  # to value what is held
    spans.loc[0, "to"] = None
    there = Desk.open(desk.folder, members=spans).read(path).members
    assert there is not None
    assert there[-1].tolist() == [True, False, False, False, False]


def _without_members(rows: int) -> Prices:
    prices = table(rows)
    return Prices(prices.dates, prices.assets, prices.values, listed=prices.listed)


def test_a_delisting_is_marked_as_the_replay_does(desk):
    prices, followed, first = table(ROWS), desk.followed("equal-weight"), LEAVES - 1
    made = Allocation.of(followed, prices.between(0, first + 1), np.zeros(5), 1000.0)
    record, _ = desk.record("equal-weight", made, prices.between(0, first + 1), False)
    assert made.weights[2] > 0.2
    decisions = np.full((ROWS - 1 - first, 6), np.nan)
    decisions[0] = made.weights
    replay = simulate(
        prices.values, decisions, first=first, cost=followed.costs, lag=0,
        conditions=Conditions.of(prices, followed.costs),
    )  # fmt: skip
    found = mark([record], prices, followed.costs, 0)
    np.testing.assert_allclose(found.returns, replay.returns, atol=1e-12)
    assert found.returns[0] < -0.02  # a haircut of a fifth
    # With a lag of a row, the order comes too late, and its money stays in cash.
    late = mark([record], prices, followed.costs, 1)
    spent = ((made.trades * (np.arange(5) != 1)) * prices.values[LEAVES]).sum()
    assert late.cash[0] == pytest.approx(1000 - spent / (1 - followed.costs.cost), abs=1e-6)
