"""The trades that lead from holdings to target weights."""

import dataclasses
import datetime
import json

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.costs import Proportional
from qfolio.portfolio.desk.allocation import Allocation, require_fresh
from qfolio.portfolio.desk.ledger import Ledger, holdings_digest
from qfolio.portfolio.desk.orders_csv import order_rows
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.mandate.limits import mandate_text
from qfolio.portfolio.prices.table import Prices

from fixed import Fixed

PRICES = Prices(
    np.array(["2024-12-30", "2024-12-31"], "datetime64[s]"),
    ("A", "B"),
    np.array([[10.0, 50], [20, 40]]),
)
FREE, FEE = Proportional(0.0), Itemized(0.0, fixed=5.0, capital=1000.0)


def recorded(ledger, allocation, **more):
    """Adds an allocation to a ledger: the record, and what is said of it."""
    held = holdings_digest(allocation.assets, allocation.shares, allocation.cash)
    facts = {
        "agent": "x", "policy": None, "made": "", "version": "", "whole_shares": False,
        "digests": {"prices": "", "settings": "", "holdings": held},
    }  # fmt: skip
    return ledger.append(allocation, PRICES, keep_prices=False, **facts | more)


def plan(weights, shares, cash, cost=0.01, **options):
    policy = Fixed(weights, Proportional(cost))
    return Allocation.of(policy, PRICES, np.array(shares, float), cash, **options)


def test_from_cash_by_hand():
    """100 spent at 1% buys 99; half of it each."""
    allocation = plan([0, 0.5, 0.5], [0, 0], 100)
    np.testing.assert_allclose(allocation.trades, [49.5 / 20, 49.5 / 40])
    assert allocation.cost == pytest.approx(1)
    assert allocation.cash_after == pytest.approx(0, abs=1e-9)


class Patient(Proportional):
    """Costs that halve with each row that an order may wait."""

    def trade(self, before, after, context):
        return Proportional(0.01 * 0.5**context.rows).trade(before, after, context)


@pytest.mark.parametrize("lag", [0, 1, 2])
def test_a_cost_model_sees_how_long_orders_wait(lag):
    policy = Fixed([0.5, 0.5, 0], Patient())
    allocation = Allocation.of(policy, PRICES, np.zeros(2), 100.0, lag=lag)
    assert allocation.cost == pytest.approx(100 * 0.01 * 0.5**lag * 0.5, rel=0.02)


def test_from_one_asset_to_the_other_by_hand():
    """Selling 100 yields 99, which buys 98.01."""
    allocation = plan([0, 0, 1], [5, 0], 0)
    np.testing.assert_allclose(allocation.trades, [-5, 98.01 / 40])
    assert allocation.cost == pytest.approx(1.99)
    np.testing.assert_allclose(allocation.held, [0, 1, 0])


class Keeping(Fixed):
    """Wants what it holds."""

    def weights(self, prices, holdings=None, *, spent=0.0):
        assert min(holdings.values()) >= 0
        return holdings


def test_an_overdraft_is_repaid():
    """Prices rose before trades were filled: 100 in A and 100 in B, and 4 of them borrowed."""
    shares = np.array([5, 2.5])
    keeping = Keeping([1, 0, 0], Proportional(0.01))
    allocation = Allocation.of(keeping, PRICES, shares, -4.0, debts=False)
    assert allocation.cash_after == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(allocation.trades * [20, 40], [-2 / 0.99] * 2)
    with pytest.raises(QfolioError, match="an overdraft of 11"):
        Allocation.of(keeping, PRICES, shares, -20.0, debts=False)
    assert Allocation.of(Fixed([-0.1, 0.5, 0.6], FREE), PRICES, shares, -20.0).wealth == 180


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("whole", [False, True])
def test_money_is_neither_made_nor_lost(seed, whole):
    rng = np.random.default_rng(seed)
    weights, shares, cash = rng.dirichlet(np.ones(3)), rng.integers(0, 50, 2), rng.uniform(1, 1e3)
    allocation = plan(weights, shares, cash, whole_shares=whole)
    after = shares + allocation.trades
    assert (after >= -1e-9).all()
    kept = after @ allocation.prices + allocation.cash_after + allocation.cost
    assert kept == pytest.approx(allocation.wealth)
    assert allocation.cash_after >= 0
    if whole:
        np.testing.assert_array_equal(allocation.trades, np.round(allocation.trades))
    else:  # weights are of what is left after costs
        left = allocation.wealth - allocation.cost
        np.testing.assert_allclose(after * allocation.prices / left, weights[1:], atol=1e-9)


def test_what_is_wanted_and_held_is_not_traded():
    allocation = plan([0.5, 0.25, 0.25], [25, 12.5], 1000)
    np.testing.assert_allclose(allocation.trades, 0, atol=1e-12)
    assert allocation.cost == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("noise", [[1, -1, 0], [-2, 1, 1], [0, 1, -1]])
def test_noise_of_float32_is_no_order(noise, whole):
    """A hundred thousand shares, of which 1e-8 of the wealth is a part of one."""
    shares, cash = np.array([100_001.0, 50_000.0]), 1e6
    wealth = shares @ [20, 40] + cash
    held = np.append(cash, shares * [20, 40]) / wealth
    targets = held.astype(np.float32).astype(float) + 3e-8 * np.array(noise)
    allocation = plan(targets, shares, cash, whole_shares=whole)
    assert allocation.trades.tolist() == [0, 0]
    assert allocation.cost == 0
    assert allocation.cash_after == cash
    np.testing.assert_array_equal(allocation.weights, allocation.held)


def test_one_order_leaves_the_noise_of_the_others_alone():
    """Half of A's 40% is sold without cost; B's target is off by a hundred-millionth."""
    shares = np.array([200_000.0, 100_000.0])  # 4 million each
    noisy = [0.4, 0.2, 0.4 - 1e-8]
    for whole in (False, True):
        allocation = plan(noisy, shares, 2e6, cost=0.0, whole_shares=whole)
        np.testing.assert_allclose(allocation.trades, [-100_000, 0], atol=1e-6)
    assert allocation.trades[1] == 0


def test_noise_of_float32_is_no_loan():
    """Targets whose sum is 1 + 1e-7 leave no debt of a few cents."""
    allocation = plan([-1e-7, 0.5, 0.5 + 1e-7], [0, 0], 1e6)
    assert allocation.weights[0] == 0
    assert allocation.cash_after == pytest.approx(0, abs=1e-6)


def test_orders_through_zero_are_two_where_brokers_tell_short_sales():
    allocation = plan([0.9, -0.2, 0.3], [5, -1], 1000, cost=0.0)  # wealth of 1060
    np.testing.assert_allclose(allocation.trades, [-10.6 - 5, 7.95 + 1])
    for layout, said in (("alpaca", "sells whole shares short"), ("schwab", "takes whole shares")):
        with pytest.raises(QfolioError, match=f"{said} only; add --whole-shares"):
            order_rows(allocation, layout, "USD")
    whole = plan([0.9, -0.2, 0.3], [5, -1], 1000, cost=0.0, whole_shares=True)
    rows = order_rows(whole, "alpaca", "USD")[1]
    assert [row[:3] for row in rows] == [
        ["A", 5, "sell"], ["A", 11, "sell"], ["B", 1, "buy"], ["B", 8, "buy"],
    ]  # fmt: skip
    assert [str(row[1]) for row in rows] == ["5", "11", "1", "8"]
    long = plan([0.5, 0.3, 0.2], [20, 10], 0, cost=0.0)  # fractions of what is owned may be sold
    assert [row[:3] for row in order_rows(long, "alpaca", "USD")[1]] == [
        ["A", 8, "sell"], ["B", 6, "sell"],
    ]  # fmt: skip
    header, rows = order_rows(whole, "schwab", "USD")
    assert header[2:4] == ["instruction", "quantity"]
    assert [row[:4] for row in rows] == [
        ["A", "EQUITY", "SELL", 5], ["A", "EQUITY", "SELL_SHORT", 11],
        ["B", "EQUITY", "BUY_TO_COVER", 1], ["B", "EQUITY", "BUY", 8],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("layout", "place", "symbols"),
    [
        ("generic", 1, ["BRK-B", "VTI"]), ("ib", 2, ["BRK B", "VTI"]),
        ("alpaca", 0, ["BRK.B", "VTI"]), ("schwab", 0, ["BRK/B", "VTI"]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("spelled", ["BRK-B", "BRK.B", "BRK/B", "BRK B"])
def test_classes_of_shares_are_spelled_as_the_broker_does(layout, place, symbols, spelled):
    bought = plan([0, 0.5, 0.5], [0, 0], 400, cost=0.0, whole_shares=True)
    allocation = dataclasses.replace(bought, assets=("VTI", spelled))
    rows = order_rows(allocation, layout, "USD")[1]
    wanted = [spelled if layout == "generic" and each != "VTI" else each for each in symbols]
    assert sorted(row[place] for row in rows) == wanted
    abroad = dataclasses.replace(bought, assets=("VTI", "TSCO.L"))  # in London
    assert "TSCO.L" in [row[place] for row in order_rows(abroad, layout, "USD")[1]]


def test_whole_shares_by_hand():
    """Of 19 shares of A (380), 9.5 should go for 4.75 of B: 10 are sold for 5 of B."""
    allocation = plan([0, 0.5, 0.5], [19, 0], 0, cost=0.0, whole_shares=True)
    assert allocation.trades.tolist() == [-10, 5]
    assert allocation.cash_after == 0
    np.testing.assert_allclose(allocation.reached, [0, 9 * 20 / 380, 5 * 40 / 380])


def test_whole_shares_are_never_bought_on_credit():
    """Of 4 A (80), 2.2 should go for 1.1 of B: 2 sold pay for one of B."""
    assert plan([0, 0.45, 0.55], [4, 0], 0, 0.0, whole_shares=True).trades.tolist() == [-2, 1]
    # Of B (40 each), 1.1 of 10 should go for 2.2 of A: one is sold, which pays for 2 of A …
    weights = [0, 44 / 400, 356 / 400]
    assert plan(weights, [0, 10], 0, 0.0, whole_shares=True).trades.tolist() == [2, -1]
    # … and 0.9 for 1.8: one is sold again. With a cost, it pays for one of A only.
    weights = [0, 36 / 400, 364 / 400]
    assert plan(weights, [0, 10], 0, 0.0, whole_shares=True).trades.tolist() == [2, -1]
    allocation = plan(weights, [0, 10], 0, 0.01, whole_shares=True)
    assert allocation.trades.tolist() == [1, -1]
    assert allocation.cash_after == pytest.approx(40 * 0.99 - 20 / 0.99)


def test_fractions_that_are_held_stay_where_whole_shares_are_sold():
    allocation = plan([1, 0, 0], [2.5, 3], 0, cost=0.0, whole_shares=True)
    assert allocation.trades.tolist() == [-2, -3]
    assert allocation.cash_after == 2 * 20 + 3 * 40


def test_nothing_to_allocate():
    with pytest.raises(QfolioError, match="nothing to allocate"):
        plan([1, 0, 0], [0, 0], 0)
    with pytest.raises(QfolioError, match=r"The account is worth -900\.00, since its debts exceed"):
        plan([1, 0, 0], [-50, 0], 100)


def test_costs_by_kind():
    """Two orders of 1 money each, and a spread of 2% of which half is paid."""
    policy = Fixed([0.2, 0.4, 0.4], Itemized(0.0, fixed=1.0, spread="0.02"))
    allocation = Allocation.of(policy, PRICES, np.zeros(2), 10_000.0, whole_shares=True)
    assert allocation.costs["fixed"] == pytest.approx(2)
    bought = allocation.trades @ allocation.prices
    assert allocation.costs["spread"] == pytest.approx(bought * 0.01, rel=0.02)
    assert allocation.cash_after == pytest.approx(10_000 - bought - allocation.cost)
    np.testing.assert_allclose(allocation.reached, [0.2, 0.4, 0.4], atol=40 / 10_000)


@pytest.mark.parametrize(("fill", "fees"), [(1, 1), (3, 3)])
def test_each_order_has_its_own_cost(fill, fees):
    """A tenth of 10,000 is bought of A and half of B; both pay a fee, and B half of a 2% spread."""
    mandate = mandate_text({"trading": {"fill": fill}}, ("A", "B"))
    model = Itemized(0.0, fixed=4.0, spread="0.02", capital=10_000.0)
    policy = Fixed([0.4, 0.1, 0.5], model, mandate)
    allocation = Allocation.of(policy, PRICES, np.zeros(2), 10_000.0)
    spreads = allocation.trades * allocation.prices / 0.99 * 0.01
    assert allocation.costs["fixed"] == pytest.approx(8 * fees)
    assert allocation.cost == pytest.approx(8 * fees + spreads.sum())
    assert allocation.cash_after == pytest.approx(0.4 * (10_000 - allocation.cost))
    header, rows = order_rows(allocation, "generic", "USD")
    found = {row[1]: row[header.index("expected_cost")] for row in rows}
    wanted = dict(zip("AB", (4 * fees + spreads).tolist(), strict=True))
    assert found == pytest.approx(wanted, abs=0.01)


def test_monthly_prices_are_fresh_until_the_next_are_due():
    months = np.array(["2024-09-30", "2024-10-31", "2024-11-30"], "datetime64[s]")
    monthly = Prices(months, ("A", "B"), np.ones((3, 2)))
    require_fresh(monthly, "2025-01-05")
    with pytest.raises(QfolioError, match="stale"):
        require_fresh(monthly, "2025-01-10")


def test_prices_of_another_day():
    require_fresh(PRICES, "2024-12-31")
    require_fresh(PRICES, "2025-01-07")
    for day, message in (("2025-01-08", "stale"), ("2024-12-30", "after"), ("x", "must be a date")):
        with pytest.raises(QfolioError, match=message):
            require_fresh(PRICES, day)
    for day in ("NaT", "today", "2025", ""):  # numpy reads these
        with pytest.raises(QfolioError, match=f"--as-of is '{day}'; it must be a date"):
            require_fresh(PRICES, day)
    require_fresh(PRICES, "2025-01-07T23:00")  # the time counts for several rows a day alone
    assert require_fresh(PRICES, "2025-01-01") == datetime.timedelta(days=1)


def hourly(*hours, days=14, weekends=True):
    """Rows at some hours of each day, up to 2024-12-31, a Tuesday."""
    dates = np.datetime64("2024-12-31") - np.arange(days)[::-1]
    dates = dates[weekends | np.is_busday(dates)]
    moments = (dates[:, None] + np.array(hours, "timedelta64[h]")).ravel().astype("datetime64[s]")
    return Prices(moments, ("A",), np.ones((len(moments), 1)))


def test_prices_of_several_times_a_day_are_as_old_as_their_last_hour():
    always = hourly(*range(24))
    assert require_fresh(always, "2025-01-01T22:59") == datetime.timedelta(hours=23, minutes=59)
    assert require_fresh(always, "2025-01-01T22:00+02:00") == datetime.timedelta(hours=21)
    require_fresh(always, "2024-12-31")
    with pytest.raises(QfolioError, match="end on 2024-12-31 23:00:00, after 2024-12-31 22:00:00"):
        require_fresh(always, "2024-12-31T22:00")


def test_prices_are_stale_a_day_after_the_longest_pause_of_their_market():
    always, bourse = hourly(*range(24)), hourly(*range(9, 17), weekends=False)
    message = "stale: they end on 2024-12-31 23:00:00, 26 hours before .* --as-of 2024-12-31T23:00"
    require_fresh(always, "2025-01-01")
    with pytest.raises(QfolioError, match=message):
        require_fresh(always, "2025-01-02T01:00")
    require_fresh(bourse, "2025-01-04T09:00")  # a weekend is 65 hours from close to open
    with pytest.raises(QfolioError, match=r"stale.*, 3 days before 2025-01-04 10:00:00"):
        require_fresh(bourse, "2025-01-04T10:00")
    short = hourly(*range(24), days=3)  # says nothing of weekends
    require_fresh(short, "2025-01-07")
    with pytest.raises(QfolioError, match="stale"):
        require_fresh(short, "2025-01-08")


def today_is(off):
    """A calendar that is some days off that of UTC."""

    class Elsewhere(datetime.date):
        @classmethod
        def today(cls):
            return datetime.datetime.now(datetime.UTC).date() + datetime.timedelta(days=off)

    return Elsewhere


@pytest.mark.parametrize(
    ("away", "fresh", "stale"),
    [
        (slice(20, 32), "2025-01-02T09:00", "2025-01-02T10:00"),  # 16 hours, and a day
        (slice(740, 760), "2025-01-07T17:00", "2025-01-07T18:00"),
    ],
)
def test_pauses_count_up_to_a_week_and_if_they_are_of_the_last_year(away, fresh, stale):
    """Of rows at 9 and 17 o'clock, those of 6 days are missing long ago, or of 10 days lately."""
    twice = hourly(9, 17, days=400)
    dates = np.delete(twice.dates, away)
    prices = Prices(dates, ("A",), np.ones((len(dates), 1)))
    require_fresh(prices, fresh)
    with pytest.raises(QfolioError, match="The prices are stale"):
        require_fresh(prices, stale)


def test_rows_in_utc_are_not_after_today_in_an_evening_of_the_west(monkeypatch):
    monkeypatch.setattr("datetime.date", today_is(-1))
    now = np.datetime64("now", "s")
    latest = Prices(now - np.arange(3)[::-1] * np.timedelta64(3600, "s"), ("A",), np.ones((3, 1)))
    assert require_fresh(latest, None) < datetime.timedelta(minutes=5)
    with pytest.raises(QfolioError, match="leave out the later rows"):
        require_fresh(
            dataclasses.replace(latest, dates=latest.dates + np.timedelta64(1, "D")), None
        )


def test_rows_in_the_time_of_the_east_are_not_younger_than_now(monkeypatch):
    """In Tokyo it is up to 9 hours later than in UTC."""
    monkeypatch.setattr("datetime.date", today_is(1))
    hours = np.arange(7, 10) * np.timedelta64(3600, "s")
    latest = Prices(np.datetime64("now", "s") + hours, ("A",), np.ones((3, 1)))
    assert require_fresh(latest, None) == datetime.timedelta()


@pytest.mark.parametrize("whole", [False, True])
def test_what_keeps_its_weight_is_no_order_and_pays_no_fee(whole):
    """Of 1,000, half in each; 100 of A are sold at a fee of 5, and B stays as it is."""
    policy = Fixed([0.1, 0.4, 0.5], FEE)
    shares = np.array([25.0, 12.5])
    allocation = Allocation.of(policy, PRICES, shares, 0.0, whole_shares=whole)
    sold = 5 if whole else 25 - 495 * 0.8 / 20  # of the 500 that pay, a fifth becomes cash
    np.testing.assert_allclose(allocation.trades, [-sold, 0], atol=1e-9)
    assert allocation.costs["fixed"] == pytest.approx(5)
    assert allocation.cash_after == pytest.approx(20 * sold - 5)
    assert len(list(order_rows(allocation, "generic", "USD")[1])) == 1


@pytest.mark.parametrize("shares", [[0.1, 24.95], [0.1, 24.9], [0.11, 24.9]])
def test_an_order_that_costs_more_than_it_moves_is_left_out(shares):
    """Weights times wealth are not always the money held, to the last digit."""
    held = np.array(shares) * [20, 40]
    sold = held[0] / held.sum()
    policy = Fixed([sold, 0.0, 1 - sold], FEE)
    allocation = Allocation.of(policy, PRICES, np.array(shares), 0.0)
    assert not allocation.trades.any()
    assert (allocation.cost, allocation.cash_after) == (0, 0)


def test_what_keeps_its_weight_beside_debts_is_no_order_either():
    """Of 1,000, A falls from 120% to 110%; the 20% of B that are owed stay as they are."""
    policy = Fixed([0.1, 1.1, -0.2], FEE)
    allocation = Allocation.of(policy, PRICES, np.array([60.0, -5.0]), 0.0)
    left = 0.995  # of the wealth; A is scaled to it, and cash takes the rest
    np.testing.assert_allclose(allocation.trades, [1100 * left / 20 - 60, 0], atol=1e-9)
    assert allocation.costs["fixed"] == pytest.approx(5)
    assert allocation.cash_after == pytest.approx(1200 - 1100 * left - 5)
    assert len(order_rows(allocation, "generic", "USD")[1]) == 1
    few = Allocation.of(policy, PRICES, np.array([0.3, -0.025]), 0.0)  # 5 in all, as the fee
    assert not few.trades.any()


def test_an_overdraft_that_no_order_repays_is_said():
    """50 shares are less than a lot."""
    mandate = mandate_text({"trading": {"lot": 100}}, ("A", "B"))
    policy = Fixed([0, 1, 0], Proportional(0.001), mandate)
    allocation = Allocation.of(policy, PRICES, np.array([50.0, 0.0]), -40.0, debts=False)
    assert not allocation.trades.any()
    assert allocation.cash_after == -40
    np.testing.assert_allclose(allocation.reached, [-40 / 960, 1000 / 960, 0])


def test_only_what_is_traded_counts_as_turnover(tmp_path):
    """All are due to fall by 1% of the wealth, and a lot is more than all."""
    mandate = mandate_text({"trading": {"lot": 1000}}, ("A", "B"))
    ledger = Ledger(tmp_path)
    for lots, turnover in ((True, 0.0), (False, 0.02)):
        policy = Fixed([0.02, 0.49, 0.49], FREE, mandate if lots else "")
        allocation = Allocation.of(policy, PRICES, np.array([250.0, 125.0]), 0.0)
        assert allocation.trades.any() != lots
        assert allocation.turnover == pytest.approx(turnover)
        made, _ = recorded(ledger, allocation, whole_shares=lots)
        assert made.turnover == pytest.approx(turnover)


def test_a_record_is_found_by_its_day_or_time(tmp_path):
    """Of several on a day, the day alone means the last; midnight has a time of its own."""
    ledger, policy = Ledger(tmp_path), Fixed([1, 0, 0], FREE)
    for at in ("2024-12-31T00:00", "2024-12-31T15:00", "2024-12-31T15:00:30"):
        dates = np.array(["2024-12-30T00:00", at], "datetime64[s]")
        allocation = Allocation.of(
            policy, dataclasses.replace(PRICES, dates=dates), np.zeros(2), 100.0
        )
        recorded(ledger, allocation)
    for date, number in (
        ("2024-12-31", 3), ("2024-12-31 00:00", 1), ("2024-12-31T00:00:00", 1),
        ("2024-12-31 15:00:00", 2), ("2024-12-31T15:00", 3), ("2024-12-31 15:00:30", 3),
    ):  # fmt: skip
        assert ledger.on(date).number == number
    for date in ("2024-12-30", "2024-12", "2024-12-31 15", "2024-12-31 16:00"):
        with pytest.raises(QfolioError, match=f"no allocation of '{date}'; its latest are of"):
            ledger.on(date)


def test_the_last_record_of_a_date_is_the_one_that_counts(tmp_path):
    """What it has already is not recorded again; what only earlier ones have, is."""
    ledger = Ledger(tmp_path)
    poor, rich = (plan([0.5, 0.5, 0], [0, 0], cash) for cash in (100.0, 200.0))
    numbers = [recorded(ledger, each)[0].number for each in (poor, poor, rich, poor)]
    assert numbers == [1, 1, 2, 3]
    assert [record.supersedes for record in ledger.records()] == [None, 1, 2]
    for before, number in ((None, 3), (3, 2), (2, 1)):
        assert [record.number for record in ledger.current(before)] == [number]
    other, said = recorded(ledger, plan([0.4, 0.6, 0], [0, 0], 100.0))
    assert other.number == 4
    assert said.endswith("It supersedes record 3 of the same date, which had other orders.")


def test_a_record_never_takes_the_number_of_another(tmp_path):
    ledger = Ledger(tmp_path)
    for cash in (100.0, 200.0):
        recorded(ledger, plan([0.5, 0.5, 0], [0, 0], cash))
    (tmp_path / "0001.json").unlink()
    assert recorded(ledger, plan([0.5, 0.5, 0], [0, 0], 300.0))[0].number == 3


def test_a_record_whose_lists_do_not_fit_is_damaged(tmp_path):
    ledger, path = Ledger(tmp_path), tmp_path / "0001.json"
    recorded(ledger, plan([0.5, 0.5, 0], [0, 0], 100.0))
    content = json.loads(path.read_text())
    for name in ("trades", "weights_after"):
        path.write_text(json.dumps(content | {name: content[name][1:]}))
        with pytest.raises(QfolioError, match=r"is damaged .*its lists do not fit its assets"):
            ledger.records()


@pytest.mark.parametrize(
    ("cash", "agent"),
    [(60.0, "x"), (40.0, "x"), (48.0, "y")],
)
def test_after_its_trades_only_other_money_or_another_agent_is_recorded(tmp_path, cash, agent):
    """50 of 100 buy A, and a fee takes 2; or 10 are paid in or out."""
    ledger = Ledger(tmp_path)
    recorded(ledger, plan([0.5, 0.5, 0], [0, 0], 100.0, cost=0.0))
    with pytest.raises(QfolioError, match="are those of record 1 of 2024-12-31 after its trades"):
        recorded(ledger, plan([0.5, 0.5, 0], [2.5, 0], 48.0, cost=0.0))
    later = plan([0.5, 0.5, 0], [2.5, 0], cash, cost=0.0)
    assert recorded(ledger, later, agent=agent)[0].number == 2


def test_an_asset_without_a_price_is_no_part_of_the_account():
    """Of 200, half is in A, which rises to 72.5%: 7.25 shares of 20, or 7 whole ones."""
    prices = dataclasses.replace(PRICES, values=np.array([[10.0, np.nan], [20.0, np.nan]]))
    policy = Fixed([0.275, 0.725, 0], FREE)
    found = Allocation.of(policy, prices, np.array([5.0, 0.0]), 100.0, whole_shares=True)
    assert found.wealth == 200
    assert found.turnover == pytest.approx(0.2)
    told = found.to_json()
    assert (told["cash_weight"], told["cash_weight_after"]) == pytest.approx((0.275, 0.3))
    assert told["assets"] == [
        {"asset": "A", "price": 20, "weight_now": 0.5, "weight": pytest.approx(0.725),
         "weight_after": 0.7, "trade_shares": 2, "trade_money": 40},
        {"asset": "B", "price": None, "weight_now": 0, "weight": 0, "weight_after": 0,
         "trade_shares": 0, "trade_money": 0},
    ]  # fmt: skip


class Sparing(Fixed):
    """Keeps as much in cash as has been spent."""

    def weights(self, prices, holdings=None, *, spent=0.0):
        return {"cash": spent, "A": 1 - spent, "B": 0.0}


def test_a_policy_knows_what_has_been_spent_of_the_year():
    found = Allocation.of(Sparing([1, 0, 0], FREE), PRICES, np.zeros(2), 100.0, spent=0.3)
    np.testing.assert_allclose(found.weights, [0.3, 0.7, 0])
