"""The ledger marked to market, against replays and by hand."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import Proportional
from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.follow import Following
from qfolio.portfolio.desk.ledger import Record, _of
from qfolio.portfolio.desk.live import mark
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.mandate.limits import mandate_text

from fixed import Fixed
from tables import days, price_table, random_walk

NAMES = ("A", "B", "C")


def table(rows=60, seed=0):
    values = random_walk(rows, seed=seed, volatility=0.02)
    return price_table(values, dates=days(rows, "2024-01-01"))


def record(allocation, number):
    """As the ledger has it."""
    return Record(
        number=number, made="", version="", agent="x", policy=None, digests={}, whole_shares=False,
        **_of(allocation),
    )  # fmt: skip


def traded(prices, model, rows, targets):
    """Allocations at some rows without lag, each from what the one before has left."""
    shares, cash, last = np.zeros(3), 1000.0, None
    records: list[Record] = []
    for row, target in zip(rows, targets, strict=True):
        if last is not None:
            before = np.append(cash, shares * prices.values[last])
            known = Conditions.of(prices, model)
            relatives = prices.values[row] / prices.values[last]
            cash *= float(model.growth(before, relatives, known.holding(last, row))[0])
        plan = Allocation.of(Fixed(target, model), prices.between(None, row + 1), shares, cash)
        records.append(record(plan, len(records) + 1))
        shares, cash, last = shares + plan.trades, plan.cash_after, row
    return records


def replayed(prices, model, rows, targets, **rules):
    """The replay of the same decisions, from row 10 on."""
    decisions = np.full((len(prices) - 1 - 10, 4), np.nan)
    decisions[np.array(rows) - 10] = targets
    known = Conditions.of(prices, model)
    return simulate(
        prices.values, decisions, first=10, cost=model, lag=0, conditions=known, **rules
    )


@pytest.mark.parametrize("model", [Proportional(0.002), Itemized(0.001, cash_rate="0.05")])
@pytest.mark.parametrize("seed", range(5))
def test_returns_equal_the_replay_of_the_same_decisions(model, seed):
    prices = table(seed=seed)
    rng = np.random.default_rng(seed)
    rows = [10, 11, 25, 40]
    targets = rng.dirichlet(np.ones(4), 4)
    found = mark(traded(prices, model, rows, targets), prices, model, lag=0)
    replay = replayed(prices, model, rows, targets)
    np.testing.assert_allclose(found.returns, replay.returns, atol=1e-12)
    np.testing.assert_array_equal(found.dates, prices.dates[11:])
    np.testing.assert_allclose(found.flows, 0, atol=1e-9)
    earned = 1000 * np.prod(1 + replay.returns)
    assert found.wealth[-1] == pytest.approx(earned)


@pytest.mark.parametrize("seed", range(3))
def test_shorts_and_loans_equal_the_replay_of_the_same_decisions(seed):
    prices, model = table(seed=seed), Itemized(0.001, cash_rate="0.05", spread="0.02")
    rng = np.random.default_rng(seed)
    assets = rng.uniform(-0.4, 0.9, (4, 3))
    targets = np.column_stack([1 - assets.sum(1), assets])
    rows = [10, 11, 12, 13]
    found = mark(traded(prices, model, rows, targets), prices, model, lag=0)
    replay = replayed(prices, model, rows, targets, long_only=False)
    assert (targets < 0).any()
    np.testing.assert_allclose(found.returns[:4], replay.returns[:4], atol=1e-12)


@pytest.mark.parametrize("rate", ["0.03", "-0.01"])
def test_carry_is_paid_in_cash_where_the_replay_reinvests_it(rate):
    """The first return is the replay's, and later ones differ no more than the docs say."""
    model, rows = Itemized(0.001, carry_rate=rate), list(range(10, 250, 21))
    ahead = []
    for seed in range(10):
        prices = table(260, seed=seed)
        targets = np.random.default_rng(seed).dirichlet(np.ones(4), len(rows))
        records = traded(prices, model, rows, targets)
        found = mark(records, prices, model, lag=0)
        replay = replayed(prices, model, rows, targets)
        assert found.returns[0] == pytest.approx(replay.returns[0], abs=1e-12)
        off = found.returns - replay.returns
        assert 1e-6 < abs(off).max() < 6e-5
        ahead.append(np.prod(1 + found.returns) / np.prod(1 + replay.returns) - 1)
        # Shares stay as they were traded, and cash takes what they earn.
        shares = np.array(records[-1].shares) + records[-1].trades
        held = prices.values[rows[-1] :] @ shares
        paid = np.cumsum(held[1:] * np.expm1(float(rate) / 365))  # on each new price
        cash = records[-1].cash_after + paid
        np.testing.assert_allclose(found.cash[rows[-1] - 10 :], cash, rtol=1e-9, atol=1e-9)
    assert abs(np.array(ahead)).max() < 4e-4


def by_hand(values, shares, cash, trades):
    prices = price_table(np.array(values), dates=days(len(values), "2024-01-01"))
    plan = Allocation(
        "2024-01-01", ("A",), prices.values[0], np.array([shares]), cash,
        np.array([0.5, 0.5]), np.array([trades]), {}, 0.0,
        np.zeros(1),
    )  # fmt: skip
    return prices, record(plan, 1)


@pytest.mark.parametrize("parts", [1, 3, 7])
@pytest.mark.parametrize(
    "model",
    [
        Proportional(0.002), Itemized(0.001, fixed=2.0, minimum=5.0, capital=1e4),
        Itemized(0.001, fixed=2.0, impact=1.0, volume="1000", capital=1e4),
    ],
)  # fmt: skip
@pytest.mark.parametrize("whole", [False, True])
def test_what_a_filled_order_costs_is_what_was_expected(parts, model, whole):
    """While prices stay, all parts together, and they leave the cash that was expected."""
    values = np.concatenate([table(40).values, np.repeat(table(40).values[-1:], 10, axis=0)])
    prices = price_table(values, dates=days(50, "2024-01-01"))
    mandate = mandate_text({"trading": {"fill": parts}}, NAMES)
    before = prices.between(None, 40)
    held = np.array([20.0, 0.0, 60.0])
    for target in ([0.0, 0.5, 0.2, 0.3], [0.4, 0.2, 0.2, 0.2]):
        policy = Fixed(target, model, mandate)
        plan = Allocation.of(policy, before, held, 5000.0, whole_shares=whole)
        found = mark([record(plan, 1)], prices, model, lag=0, fills=[parts])
        # Impact depends on the volatility of the last rows, which falls while prices stay.
        rel = 0.1 if "impact" in plan.costs else 1e-9
        assert plan.cost == pytest.approx(found.costs.sum(), rel=rel)
        assert plan.cash_after == pytest.approx(found.cash[-1], abs=plan.cost * rel + 1e-2)
        assert plan.cash_after >= 0
        assert plan.order_costs.sum() == pytest.approx(plan.cost)
        if not whole:
            np.testing.assert_allclose(plan.reached, target, atol=1e-5)


def test_a_trade_that_waits_a_row_by_hand():
    """10 shares are bought at 20 instead of 10, at 1%: the cost is in the row after."""
    prices, one = by_hand([[10.0], [20.0], [30.0], [30.0]], 0.0, 1000.0, 10.0)
    found = mark([one], prices, Proportional(0.01), lag=1)
    cost = 200 / 0.99 - 200
    np.testing.assert_allclose(found.wealth, [1100 - cost] * 2)
    np.testing.assert_allclose(found.returns, [(1100 - cost) / 1000 - 1, 0])
    np.testing.assert_allclose(found.costs, [cost, 0])
    assert found.short == 0
    poor = mark(
        [by_hand([[10.0], [20.0], [30.0]], 0.0, 100.0, 10.0)[1]], prices, Proportional(0.0), 1
    )
    assert poor.short == 1
    prices, short = by_hand([[10.0], [10.0], [10.0]], 0.0, 100.0, 10.02)
    assert mark([short], prices, Proportional(0.0), lag=1).short == 1  # by 0.2% of the wealth


def told(found, records):
    """What a summary of a ledger says of the differences."""
    count = len(found.returns)
    none = np.zeros(count)
    known = Following(
        "x", records, found, none, none, none, "y", none, "", np.ones((3, count)), none + 1, 252,
        None, False, "1y",
    )  # fmt: skip
    said = known.sentences()
    return " ".join(each for each in said if "differed" in each or "not filled" in each)


def test_holdings_that_differ_are_named_with_their_date_and_asset():
    """Orders at row 10 buy 250 of each; then A has 50 less, and B is sold with 100 paid in."""
    prices = price_table(np.full((20, 3), 1.0), dates=days(20, "2024-01-01"))
    records = traded(prices, Proportional(0.0), [10, 15], [np.full(4, 0.25)] * 2)
    late = msgspec.structs.replace(records[1], shares=[200.0, 0.0, 250.0], cash=600.0)
    found = mark([records[0], late], prices, Proportional(0.0), lag=0)
    (difference,) = found.differences
    assert (difference.date, difference.where) == ("2024-01-16", "cash")
    assert difference.money == pytest.approx(350)
    assert difference.unfilled is None
    assert told(found, records) == (
        "Holdings differed from those expected 1 time, by +50.00 in all (deposits, other fills); "
        "this is not counted as a return. The last time, on 2024-01-16, cash differed most, by "
        "+350.00."
    )
    row = price_table(np.full((16, 3), 1.0), dates=days(16, "2024-01-01"))
    at_the_end = mark([records[0], late], row, Proportional(0.0), lag=0)
    assert "1 time, by +50.00 in all" in told(at_the_end, records)  # before it earns a return
    exact = mark(records, prices, Proportional(0.0), lag=0)
    assert exact.differences == []
    assert not told(exact, records)


@pytest.mark.parametrize("split", [1.0, 2.0])
@pytest.mark.parametrize("lag", [0, 1])
def test_orders_that_were_never_filled_are_named(lag, split):
    """The account holds 100 A, is to buy 100 B, and still holds 100 A, or 200 after a split."""
    values = np.full((20, 3), 1.0)
    prices = price_table(values, dates=days(20, "2024-01-01"))
    (first,) = traded(prices, Proportional(0.0), [10], [np.array([1.0, 0, 0, 0])])
    first = msgspec.structs.replace(
        first, shares=[100.0, 0.0, 0.0], cash=100.0, trades=[0.0, 100.0, 0.0],
        prices=[split, 1.0, 1.0],
    )  # fmt: skip
    then = msgspec.structs.replace(
        first, number=2, date="2024-01-16", shares=[100.0 * split, 0.0, 0.0], trades=[0.0] * 3,
        prices=[1.0] * 3,
    )  # fmt: skip
    found = mark([first, then], prices, Proportional(0.0), lag=lag)
    (difference,) = found.differences
    assert (difference.where, difference.unfilled) in [("B", first.date), ("cash", first.date)]
    assert "orders of 2024-01-11 were not filled, since" in told(found, [first, then])
    partly = msgspec.structs.replace(then, shares=[100.0 * split, 50.0, 0.0], cash=50.0)
    found = mark([first, partly], prices, Proportional(0.0), lag=lag)
    assert found.differences[0].unfilled is None


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_a_model_knows_how_long_orders_waited(lag):
    """As in the replay, which says it, too."""

    class Noting(Proportional):
        def trade(self, before, after, context):
            waited.append(context.rows)
            return super().trade(before, after, context)

    waited: list[int] = []
    prices = table()
    records = traded(prices, Proportional(), [10], np.full((1, 4), 0.25))
    mark(records, prices, Noting(), lag)
    assert waited
    assert set(waited) == {lag}


def test_an_account_is_wiped_out_once():
    """10 shares bought for 100 with a loan of 50 fall to 4 each, and then rise again."""
    prices, one = by_hand([[10.0], [10.0], [4.0], [8.0]], 10.0, -50.0, 0.0)
    found = mark([one], prices, Proportional(0.0), lag=0)
    np.testing.assert_allclose(found.returns, [0, -1, 0])
    np.testing.assert_allclose(found.wealth, [50, -10, 30])
    assert found.ruin == prices.dates[2]
    np.testing.assert_allclose(found.gross, [2, np.inf, 80 / 30])
    none = np.zeros(3)
    followed = Following(
        "x", [one], found, none, none, none, "y", none, "", np.ones((3, 3)), none + 1, 252, None,
        False, "1y",
    )  # fmt: skip
    said = followed.sentences()
    assert "WIPED OUT on 2024-01-03: the account's debts exceeded what it owned." in said
    assert not any("consistent" in each or "differed" in each for each in said)
    assert mark([one], prices.between(None, 2), Proportional(0.0), lag=0).ruin is None


def test_an_account_that_owes_more_than_it_owns_trades_no_more():
    prices, one = by_hand([[10.0], [4.0], [4.0]], 10.0, -50.0, -5.0)
    found = mark([one], prices, Proportional(0.01), lag=1)
    np.testing.assert_array_equal((found.costs, found.cash, found.wealth), [[0], [-50], [-10]])


def test_a_short_position_adds_to_the_gross_exposure():
    prices, one = by_hand([[10.0], [10.0]], -5.0, 150.0, 0.0)
    np.testing.assert_allclose(mark([one], prices, Proportional(0.0), lag=0).gross, [0.5])


def test_sharpe_ratios_are_of_returns_over_cash():
    prices, one = by_hand([[10.0], [10.0], [12.0], [11.0], [13.0]], 10.0, 0.0, 0.0)
    found, cash = mark([one], prices, Proportional(0.0), lag=0), np.array([0.01, 0, 0.02, 0.01])
    none = np.zeros(4)
    followed = Following(
        "x", [one], found, none, cash, none, "y", none, "", np.ones((3, 4)), none + 1, 12, None,
        False, "1y",
    )  # fmt: skip
    excess = found.returns - cash
    sharpe = excess.mean() / excess.std(ddof=1) * 12**0.5
    assert followed.rows()["live"]["sharpe"] == pytest.approx(sharpe)


def following(values, band, year=252.0, evidence=1.0):
    """A holding of 10 shares, whose backtest leads one to expect this band at every row."""
    prices, one = by_hand([[value] for value in values], 10.0, 0.0, 0.0)
    found = mark([one], prices, Proportional(0.0), lag=0)
    none = np.zeros(len(found.returns))
    return Following(
        "x", [one], found, none, none, none, "y", none, "", np.outer(band, none + 1),
        none + evidence, year, None, False, "1y",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("band", "place"),
    [((1.1, 1.2, 1.3), "Live is below the band."), ((0.7, 0.8, 0.9), "Live is above the band.")],
)
def test_outside_the_band_live_is_not_called_consistent(band, place):
    said = " ".join(following([10.0, 10, 10], band, evidence=1.2).sentences())
    assert place in said
    assert "consistent" not in said
    assert (
        "There is no alarm yet: the backtest is not refuted (evidence against it 1.2, alarm at 40)."
    ) in said
    said = " ".join(following([10.0, 10, 10], (0.9, 1.0, 1.1)).sentences())
    assert "Live returns are consistent with the backtest (evidence against it 1, " in said
    assert "no alarm" not in said


@pytest.mark.parametrize(("rows", "annual"), [(1, False), (62, False), (63, True), (64, True)])
def test_less_than_a_quarter_of_a_year_is_not_annualized(rows, annual):
    band = (0.9, 1.0, 1.1)
    found = following(np.append(np.linspace(10, 9, rows), 9.5), band).rows()["live"]
    known = {name for name, value in found.items() if not np.isnan(value)}
    always = {"growth", "drawdown"}
    assert known == (always | {"a year", "volatility", "sharpe"} if annual else always)
    assert found["growth"] == pytest.approx(-0.05)
    assert all(np.isnan(x) for x in following([10.0], band).rows()["live"].values())


def test_a_margin_call_is_said_while_it_lasts():
    """10 shares bought for 100 with a loan of 50: at 8 each, 80 are held with a wealth of 30."""
    prices, one = by_hand([[10.0], [10.0], [8.0], [12.0]], 10.0, -50.0, 0.0)
    for rows, called in ((3, True), (4, False)):
        found = mark([one], prices.between(None, rows), Proportional(0.0), lag=0)
        none = np.zeros(rows - 1)
        followed = Following(
            "x", [one], found, none, none, none, "y", none, "", np.ones((3, rows - 1)), none + 1,
            252, None, False, "1y", 2.5,
        )  # fmt: skip
        said = [each for each in followed.sentences() if each.startswith("MARGIN CALL")]
        assert bool(said) == called
        if said:
            assert (
                "2024-01-03: gross exposure is 2.67 times the wealth, and the mandate's" in said[0]
            )


def test_a_loan_that_is_wanted_is_no_overdraft():
    prices, one = by_hand([[10.0], [20.0], [20.0]], 0.0, 100.0, 15.0)
    owed = Record(**{f: getattr(one, f) for f in one.__struct_fields__} | {"target": [-0.5, 1.5]})
    assert mark([one], prices, Proportional(0.0), 1).short == 1
    assert mark([owed], prices, Proportional(0.0), 1).short == 0


def test_orders_filled_over_several_rows_equal_the_replay_of_their_parts():
    prices, model = table(), Proportional(0.002)
    target, fill = np.array([0.1, 0.3, 0.4, 0.2]), 4
    plan = Allocation.of(Fixed(target, model), prices.between(None, 11), np.zeros(3), 1e4)
    live = mark([record(plan, 1)], prices, model, 1, [fill])
    shares, cash, wealth = np.zeros(3), 1e4, []
    for row in range(11, len(prices)):  # the first part is traded a row after the decision
        wealth.append(cash + shares @ prices.values[row])
        if row < 11 + fill:
            value = plan.trades / fill * prices.values[row]
            cash -= value.sum() / (1 - 0.002)  # what is bought costs a share of what is paid
            shares = shares + plan.trades / fill
    np.testing.assert_allclose(live.wealth, wealth[1:], rtol=1e-9)


@pytest.mark.parametrize("lag", [1, 2, 3])
@pytest.mark.parametrize("fill", [1, 2])
def test_each_order_is_filled_after_the_lag_until_the_next_takes_its_place(lag, fill):
    prices, model = table(), Proportional(0.0)
    trades, rows = np.array([2.0, 1.0, 0.0]), range(10, 16)
    shares, cash, wealth, records = np.zeros(3), 1e4, [], []
    for row in range(10, 40):
        if row > 10 + lag:
            wealth.append(cash + shares @ prices.values[row])
        for ordered in rows:  # part of a share at each of ``fill`` rows, cut off by the next order
            later = row - ordered - lag
            if 0 <= later < fill and (later == 0 or ordered + 1 not in rows):
                cash -= trades / fill @ prices.values[row]
                shares = shares + trades / fill
        if row in rows:
            idle = Fixed(np.eye(4)[0], model)
            plan = Allocation.of(idle, prices.between(None, row + 1), shares, cash)
            records.append(msgspec.structs.replace(record(plan, row), trades=trades.tolist()))
    live = mark(records, prices.between(None, 40), model, lag, [fill] * len(records))
    np.testing.assert_allclose(live.wealth, wealth, rtol=1e-12)
    np.testing.assert_allclose(live.flows, 0, atol=1e-9)


@pytest.mark.parametrize("fills", [(1, 1, 1), (2, 2, 2), (3, 1, 2)])
def test_without_a_lag_an_order_takes_the_place_of_what_is_due_at_its_row(fills):
    """Each of several strategies fills its orders over rows of its own."""
    prices, model = table(), Proportional(0.001)
    trades, rows = np.array([2.0, 1.0, 0.0]), (10, 11, 13)
    shares, cash, wealth, records = np.zeros(3), 1e4, [], []
    due: list[np.ndarray] = []
    for row in range(10, 30):
        if row > 10:
            wealth.append(cash + shares @ prices.values[row])
        if row in rows:
            idle, fill = Fixed(np.eye(4)[0], model), fills[rows.index(row)]
            plan = Allocation.of(idle, prices.between(None, row + 1), shares, cash)
            records.append(msgspec.structs.replace(record(plan, row), trades=trades.tolist()))
            due = [trades / fill] * fill
        if due:
            part = due.pop(0)
            cash -= part @ prices.values[row] / (1 - 0.001)
            shares = shares + part
    live = mark(records, prices.between(None, 30), model, 0, fills)
    np.testing.assert_allclose(live.wealth, wealth, rtol=1e-9)
    np.testing.assert_allclose(live.flows, 0, atol=1e-6)


@pytest.mark.parametrize("band", [0.0, 0.05])
def test_an_allocation_within_the_band_leaves_what_remains_of_an_order(band):
    prices, model = table(), Proportional(0.0)
    target = np.array([0.1, 0.3, 0.4, 0.2])
    order = Allocation.of(Fixed(target, model), prices.between(None, 11), np.zeros(3), 1e4)
    shares = order.trades / 3  # the first part, without a lag
    cash = 1e4 - shares @ prices.values[10]
    held = np.append(cash, shares * prices.values[11])
    still = Fixed(held / held.sum(), model)
    nothing = Allocation.of(still, prices.between(None, 12), shares, cash)
    assert not nothing.trades.any()
    given = [record(order, 1), record(nothing, 2)], prices, model, 0, (3, 3), band
    kept = 1e4 - order.trades @ prices.values[[10, 11, 12]].mean(0)
    assert mark(*given).cash[-1] == pytest.approx(kept if band else cash)


def test_a_split_and_a_deposit_earn_nothing():
    """The table is adjusted for a split of 2 after the first record; 500 are paid in later."""
    prices, one = by_hand([[5.0], [5.0], [6.0], [6.0]], 100.0, 0.0, 0.0)
    one = Record(**{f: getattr(one, f) for f in one.__struct_fields__} | {"prices": [10.0]})
    two = {"number": 2, "date": "2024-01-03", "prices": [6.0], "shares": [200.0], "cash": 500.0}
    again = Record(**{f: getattr(one, f) for f in one.__struct_fields__} | two)
    found = mark([one, again], prices, Proportional(0.0), lag=0)
    np.testing.assert_allclose(found.wealth, [1000, 1200, 1700])
    np.testing.assert_allclose(found.returns, [0, 0.2, 0])
    np.testing.assert_allclose(found.flows, [0, 0, 500])


def test_costs_of_a_trade_are_no_withdrawal():
    """10 shares are bought for 100 / 0.99 a row later, when the next allocation knows of them."""
    prices, one = by_hand([[10.0]] * 4, 0.0, 1000.0, 10.0)
    then: dict[str, Any] = {"shares": [10.0], "cash": 1000 - 100 / 0.99, "trades": [0.0]}
    two = msgspec.structs.replace(one, number=2, date="2024-01-02", **then)
    found = mark([one, two], prices, Proportional(0.01), lag=1)
    np.testing.assert_allclose(found.costs, [100 / 0.99 - 100, 0], atol=1e-9)
    np.testing.assert_allclose(found.flows, 0, atol=1e-9)


def test_an_order_of_before_a_split_buys_as_much_after_it():
    """50 shares at 10 are 100 units of a table that is adjusted for a later split of 2."""
    prices, one = by_hand([[5.0], [5.0], [6.0]], 0.0, 1000.0, 50.0)
    one = msgspec.structs.replace(one, prices=[10.0])
    found = mark([one], prices, Proportional(0.0), lag=1)
    np.testing.assert_allclose(found.wealth, [100 * 6 + 500])
    np.testing.assert_allclose(found.returns, [0.1])


def test_an_order_is_void_once_its_asset_is_delisted():
    prices, one = by_hand([[10.0], [10.0], [10.0]], 0.0, 1000.0, 50.0)
    ended = dataclasses.replace(prices, listed=np.array([[True], [False], [False]]))
    found = mark([one], ended, Proportional(0.01), lag=1)
    np.testing.assert_array_equal(found.costs, [0])
    np.testing.assert_array_equal(found.wealth, [1000])


def test_a_holding_that_is_delisted_becomes_cash():
    prices, one = by_hand([[10.0], [8.0], [8.0]], 10.0, 20.0, 0.0)
    ended = dataclasses.replace(prices, listed=np.array([[True], [False], [False]]))
    found = mark([one], ended, Proportional(0.01), lag=0)
    np.testing.assert_allclose(
        (found.cash, found.wealth, found.gross), [[100] * 2, [100] * 2, [0] * 2]
    )


def test_a_ledger_that_does_not_fit_is_refused():
    prices, one = by_hand([[10.0], [20.0]], 1.0, 0.0, 0.0)
    with pytest.raises(QfolioError, match="empty"):
        mark([], prices, Proportional(0.0), 1)
    with pytest.raises(QfolioError, match="have no row of 2024-01-01, on which record 1"):
        mark([one], prices.between(1, None), Proportional(0.0), 1)
    earlier = price_table(np.ones((2, 1)), dates=days(2, "2023-12-30"))
    with pytest.raises(QfolioError, match="2023-12-30 to 2023-12-31, have no row of 2024-01-01"):
        mark([one], earlier, Proportional(0.0), 1)
    with pytest.raises(QfolioError, match="other assets"):
        mark([one], table(), Proportional(0.0), 1)
    assert len(mark([one], prices, Proportional(0.0), lag=1).returns) == 0
