import dataclasses

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.own import Own, place
from qfolio.portfolio.backtest.own_tables import read_own
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.writing import write_tables
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from tables import days, price_table, random_walk
from tiny import PATHWISE

AGENTS = {"pathwise": PATHWISE}
ROWS, FIRST, LAST = 160, 98, 157  # rows of the table, and of the first and the last decision
DAYS = days(ROWS).astype(str)


def table(rows=ROWS, every=1, late=0):
    """every: days from a row to the next."""
    values = random_walk(rows, drift=3e-4)
    values[:late, 2] = np.nan
    return price_table(values, dates=days(rows * every)[::every])


def create(prices=None, out=None, **options):
    prices = table() if prices is None else prices
    rest = {"train": "100d", "test": "30d", "seeds": 1, "cost": 0.002, "baselines": []}
    return Backtest.create(prices, AGENTS, out=out, **{**rest, **options})


def weights(rows, **columns):
    return pd.DataFrame({"date": DAYS[rows], **columns})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """With each form of strategy, of which files are deleted before it is replayed."""
    place = tmp_path_factory.mktemp("own")
    rng = np.random.default_rng(1)
    weights([0, 100, 120], A=[0.5, 0.2, 0.0], cash=[0.5, 0.8, 1.0]).to_csv(
        place / "mine.csv", index=False
    )
    returns = pd.DataFrame({"date": DAYS, "return": rng.normal(0, 0.01, ROWS)})
    returns.to_csv(place / "fund.csv", index=False)
    level = pd.DataFrame({"date": DAYS, "level": table().values.mean(1)}).drop(index=[120, 121])
    level.to_csv(place / "index.csv", index=False)
    backtest = create(
        out=place / "run",
        strategies={
            "mine": place / "mine.csv",
            "fund": place / "fund.csv",
            "daily": np.full((ROWS, 3), 1 / 3),
        },
        benchmark=place / "index.csv",
    )
    backtest.run()
    for file in ("mine.csv", "fund.csv", "index.csv"):
        (place / file).unlink()
    return backtest, returns["return"].to_numpy(), level


def test_equal_weights_of_ones_own_are_the_baseline(finished):
    entries, _ = finished[0].entries()
    ours, theirs = (entries[name].simulation for name in ("daily", "equal-weight"))
    np.testing.assert_allclose(ours.returns, theirs.returns, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.weights, theirs.weights, rtol=0, atol=1e-12)


def test_returns_pass_through_exactly(finished):
    backtest, returns, _ = finished
    entry = backtest.entries()[0]["fund"]
    np.testing.assert_array_equal(entry.simulation.returns[0], returns[FIRST + 2 : LAST + 3])
    assert not entry.weighted
    assert np.isnan(entry.simulation.turnover).all()


def test_an_index_earns_what_its_levels_say(finished):
    backtest, _, level = finished
    earned = backtest.entries()[0]["index"].simulation.returns[0]
    known = pd.Series(level["level"].to_numpy(), level["date"]).reindex(DAYS).ffill()
    expected = known.pct_change().to_numpy()[FIRST + 2 : LAST + 3]
    np.testing.assert_allclose(earned, expected, atol=1e-15)
    assert earned[120 - FIRST - 2] == 0  # a holiday: the last level stands


def test_orders_are_decided_at_their_date_and_executed_after_the_lag(finished):
    """Half of A in shares from day 0, of which the test begins with what it has drifted to."""
    entry = finished[0].entries()[0]["mine"]
    a = table().values[:, 0]
    grown = 0.5 * a[FIRST] / a[0]
    start = grown / (grown + 0.5)
    assert entry.decisions[0, 0, 1] == pytest.approx(start)
    given = np.flatnonzero(~np.isnan(entry.decisions[0, :, 0])) + FIRST
    np.testing.assert_array_equal(given, [FIRST, 100, 120])
    turnover = entry.simulation.turnover[0]
    np.testing.assert_array_equal(np.flatnonzero(turnover) + FIRST, [FIRST, 100, 120])
    # Sold at row 121 for what A was worth then, so the return of row 123 is the first of cash.
    returns = entry.simulation.returns[0]
    np.testing.assert_array_equal(returns[121 - FIRST :], 0)
    assert returns[120 - FIRST] == pytest.approx(-entry.simulation.cost[0, 120 - FIRST])


def test_a_benchmark_is_the_reference_of_everything(finished, tmp_path):
    backtest = finished[0]
    entries, _ = backtest.entries()
    assert entries["index"].kind == "baseline"
    assert {entries[name].kind for name in ("mine", "fund", "daily")} == {"strategy"}
    assert not any(entry.kind == "rebalancing" for entry in entries.values())
    found = backtest.assess(entries)
    assert found.reference == "index"
    assert found.strategies["mine"].to_reference.reference == "index"
    assert found.strategies["mine"].relative["beta"].mean > 0
    write_tables(backtest, entries, found)
    rows = (backtest.folder / "weights.csv").read_text().splitlines()[1:]
    assert {row.split(",")[1] for row in rows} == {"pathwise", "mine", "daily", "equal-weight"}
    assert "turnover" in backtest._repr_html_()


def test_a_backtest_is_resumed_without_the_files(finished):
    backtest = finished[0]
    again = Backtest.open(backtest.folder)
    assert again.config.strategies == ("mine", "fund", "daily", "index")
    ours, theirs = backtest.entries(), again.entries()
    assert ours[1] == theirs[1]
    for name, entry in ours[0].items():
        other = theirs[0][name].simulation
        np.testing.assert_array_equal(entry.simulation.returns, other.returns)
    assert again.assess(theirs[0]).to_json() == again.assess(ours[0]).to_json()


def placed(source, prices=None, **options):
    """The decisions or returns of a strategy, and its notes."""
    made = create(prices, strategies={"mine": source}, **options)._own["mine"]
    return made.decisions if made.returns is None else made.returns, made.notes


def test_later_rows_change_nothing_earlier():
    rng = np.random.default_rng(2)
    dates, t = np.arange(90, 150, 7), 125
    shares = rng.dirichlet(np.ones(4), len(dates))
    changed = np.where((dates > t)[:, None], rng.dirichlet(np.ones(4), len(dates)), shares)
    moved = table().values.copy()
    moved[t + 1 :] *= np.exp(rng.normal(0, 0.3, moved[t + 1 :].shape))
    other = Prices(table().dates, table().assets, moved)
    known = slice(0, t + 1 - FIRST)
    before, after, elsewhere = (
        placed(weights(dates, **dict(zip(("cash", "A", "B", "C"), each.T, strict=True))), prices)[0]
        for each, prices in ((shares, None), (changed, None), (shares, other))
    )
    assert not np.array_equal(before, after, equal_nan=True)
    np.testing.assert_array_equal(after[known], before[known])
    np.testing.assert_array_equal(elsewhere, before)


@pytest.mark.parametrize("quantity", ["weight", "shares"])
def test_orders_after_the_last_price_wait_for_it(quantity):
    """A month's order may be dated on the Sunday after the table's last Friday."""
    dates, asset = [DAYS[100], "2020-06-09", "2020-06-14"], ["A", "A", "B"]
    source = pd.DataFrame({"date": dates, "asset": asset, quantity: [0.5, 0.5, 0.5]})
    if quantity == "shares":
        cash = pd.DataFrame({"date": dates[:1], "asset": ["cash"], "shares": [100.0]})
        source = pd.concat([cash, source])
    decisions, _ = placed(source)
    assert np.flatnonzero(~np.isnan(decisions[:, 0])).tolist() == [100 - FIRST]


def test_a_holding_from_before_the_test_has_earned_interest():
    prices, cost = table(), "itemized(cash_rate=0.2)"
    task = Portfolio.of(prices, window=5, horizon=20, cost_model=cost)
    own = Own("weights", prices.dates[[10]], np.array([[0.5, 0.5, 0.0, 0.0]]))
    found = place("mine", own, prices, slice(100, 150), task, 1.0).decisions
    moved = prices.values[100, 0] / prices.values[10, 0]
    worth = np.array([np.exp(0.2 * 90 / 365), moved, 0, 0])
    np.testing.assert_allclose(found[0], worth / worth.sum(), rtol=1e-12)
    assert np.isnan(found[1:]).all()


def test_the_latest_order_from_before_the_test_is_held():
    prices = table()
    task = Portfolio.of(prices, window=5, horizon=20)
    given = np.array([[0.5, 0.5, 0.0, 0.0], [0.4, 0.0, 0.6, 0.0]])
    own = Own("weights", prices.dates[[10, 50]], given)
    found = place("mine", own, prices, slice(100, 150), task, 1.0).decisions
    worth = np.array([0.4, 0, 0.6 * prices.values[100, 1] / prices.values[50, 1], 0])
    np.testing.assert_allclose(found[0], worth / worth.sum(), rtol=1e-12)


def test_cash_until_the_first_order_and_dates_between_rows():
    prices = table(every=7)  # Wednesdays
    source = pd.DataFrame({"date": ["2021-12-31", "2022-03-31"], "A": [1.0, 0.5], "B": [0, 0.5]})
    decisions, notes = placed(source, prices)
    given = np.flatnonzero(~np.isnan(decisions[:, 0]))
    rows = [str(prices.dates[FIRST + day])[:10] for day in given]
    assert rows == ["2022-01-05", "2022-04-06"]  # the Wednesdays after them
    assert notes == (
        "mine: 2 dates of its orders, from 2021-12-31 to 2022-03-31, are not among those of the "
        "prices; each order is decided at the next row.",
        "mine holds cash until its first order, of 2022-01-05.",
    )
    note = placed(weights([100], A=[0.9]), cap=0.5)[1][-1]
    assert "orders up to 0.9" in note
    assert "more than the cap of 0.5" in note


@pytest.mark.parametrize(
    "source",
    [
        pd.DataFrame({"date": DAYS[[110] * 2], "asset": ["A", "B"], "weight": [0.25, 0.75]}),
        pd.DataFrame({"Date": DAYS[[110]], "B": ["0.75"], "A": [0.25], "CASH": [0.0]}),
        pd.DataFrame({"A": [0.25], "B": [0.75]}, index=pd.DatetimeIndex(DAYS[[110]])),
        pd.DataFrame({"date": DAYS[[110, 111]], "A": [0.25, None], "B": [0.75, None]}),
        pd.DataFrame({"date": DAYS[[110]], "A": [0.2502], "B": [0.7506]}),  # rounded
        np.where(np.arange(ROWS)[:, None] == 110, [0.0, 0.25, 0.75, 0.0], np.nan).tolist(),
    ],
)
def test_forms_of_weights(source):
    own = read_own("mine", source, table())
    assert own.kind == "weights"
    np.testing.assert_array_equal(own.dates.astype("datetime64[D]").astype(str), [DAYS[110]])
    np.testing.assert_allclose(own.values, [[0, 0.25, 0.75, 0]], atol=1e-12)


def test_forms_of_returns():
    series = pd.Series(np.arange(ROWS) / 1e4, pd.DatetimeIndex(DAYS), name="return")
    for source in (series, series.to_numpy()):
        own = read_own("mine", source, table())
        assert own.kind == "returns"
        np.testing.assert_array_equal(own.values, series.to_numpy())
    # A series of returns is one whatever it is called, such as an asset's pct_change().
    for name in (None, "A", "fund"):
        moved = series.rename(name).where(np.arange(ROWS) > 0)
        own = read_own("mine", moved, table())
        assert own.kind == "returns"
        np.testing.assert_array_equal(own.values, series.to_numpy()[1:])
    index = (3000 * (1 + series).cumprod()).rename("SPX")
    assert read_own("mine", index, table()).kind == "levels"


HOURS = Prices(np.datetime64("2020-01-01T09:30", "s") + np.arange(ROWS) * np.timedelta64(1, "h"),
               ("A", "B", "C"), table().values)  # fmt: skip


@pytest.mark.parametrize(
    ("source", "prices", "message"),
    [
        (weights([100], A=[1.2]), None, r"long-only, so give weights of at least 0"),
        (weights([100], A=[0.6], cash=[0.6]), None, r"weights of .* sum to 1.2"),
        (
            weights([100], A=[60], B=[40]), None,
            "weights of mine on 2020-04-10 sum to 100 without cash, so they look like percentages",
        ),
        (weights([100], A=[-0.1], B=[0.5]), None, "weight of -0.1 on 2020-04-10.*long-only"),
        (weights([100, 100], A=[0.1, 0.2]), None, "row 1: 2020-04-10 appears twice"),
        (weights([100], A=[0.1], AB=[0.2]), None, r"no asset 'AB' \(did you mean"),
        (weights([100], A=["x"]), None, "row 0 .*column 'A': 'x' is not a number"),
        (weights([100], A=[0.1], B=[None]), None, "column 'B': it is missing; give a number"),
        (weights([159], A=[1.0]), None, "orders nothing up to 2020-06-06"),
        (weights([100], asset=["Z"], shares=[3]), None, "no asset 'Z'"),
        (weights([100], asset=["A"], shares=[3]), None, r"is worth 0.00; give the money that it"),
        (weights([99, 100], asset=["cash"] * 2, shares=[3, 3]), None, "paid in after the first"),
        (weights([99, 99], asset=["cash", "A"], shares=[10, 3]), None, "weight of .*long-only"),
        (
            weights([99, 99], asset=["cash", "A"], shares=[10, 3]), None,
            "of cash on 2020-04-09, because its orders cost more than the cash that is there",
        ),
        (
            weights([100, 100], asset=["cash", "C"], shares=[10, 3]), table(late=120),
            "C has no price yet",
        ),
        (weights([100], asset=["Z"], weight=[1]), None, "no asset 'Z'"),
        (weights([100, 100], asset=["A", "A"], weight=[1, 1]), None, "'A' appears twice"),
        (weights([100, 101], A=[1, 1]).assign(date="soon"), None, "row 0: .*write dates as"),
        (weights([100], C=[1.0]), table(late=120), "orders C on 2020-04-10, before its first"),
        (weights([2], A=[1.0]), HOURS, "is not a row of the prices; where a day has several"),
        (weights(np.arange(130), **{"return": 0.01}), None, "has no return on 2020-05-10.* 30 of"),
        (weights(np.arange(ROWS), **{"return": -1.5}), None, "returns are fractions"),
        (weights(np.arange(90), level=1.0), None, "no level on 2020-04-09 or in the week before"),
        (weights(np.arange(ROWS), level=-1.0), None, "'level' is not an index: .*negative"),
        (np.ones((ROWS, 7)), None, r"must be \(160, 4\) for weights, cash first, or \(160,\)"),
        ({"a": 1}, None, "Strategy 'mine'"),
        ("nothing.csv", None, "nothing.csv' cannot be read"),
    ],
)  # fmt: skip
def test_strategies_that_are_refused(source, prices, message):
    with pytest.raises(QfolioError, match=message):
        create(prices, strategies={"mine": source})


def test_an_order_of_a_delisted_asset_is_refused():
    """It would be carried out as cash."""
    prices, listed = table(), np.ones((ROWS, 3), bool)
    listed[150:, 1] = False
    prices = dataclasses.replace(prices, listed=listed)
    create(prices, strategies={"mine": weights([100, 149, 150], B=[0.5, 0.3, 0.0])})
    with pytest.raises(QfolioError, match="mine orders B on 2020-05-30, after its last price"):
        create(prices, strategies={"mine": weights([100, 150], B=[0.5, 0.5])})


def test_a_weight_may_be_below_zero_by_rounding():
    mine = np.full((ROWS, 4), np.nan)
    mine[100:, :] = [-2e-9, 0.25, 0.75 + 2e-9, 0.0]
    backtest = create(strategies={"mine": mine})
    entry = backtest.replay.own("strategy", backtest._own["mine"])
    assert entry.simulation.weights.min() == 0


@pytest.mark.parametrize(("every", "rows"), [(1, 1), (7, 7)])
def test_a_table_does_not_grow_beyond_its_index(every, rows):
    """Nor by a day; a level of a week lasts for one, and holidays before change nothing."""
    last = ROWS - 20
    level = pd.DataFrame({"date": DAYS, "level": table().values.mean(1)})
    known = level.iloc[: last + 1 : every].drop(index=[49, 91]).reset_index(drop=True)
    first = create(table().between(0, last + 1), benchmark=known)
    for count in (last + 1, last + rows):
        first.extended(table().between(0, count))
    said = f"benchmark has no level after {DAYS[last]}; start a new .* up to {DAYS[last + rows]}"
    with pytest.raises(QfolioError, match=said):
        first.extended(table().between(0, last + rows + 1))
    create(table().between(0, last + 1), benchmark=level.iloc[: last - 1])  # as on holidays
    ahead = create(table().between(0, last + 1), benchmark=level)
    assert len(ahead.extended(table()).dates) == ROWS - 100


@pytest.mark.parametrize(("every", "said"), [(1, False), (2, True), (5, True)])
def test_an_index_that_often_stands_still_is_named(every, said):
    """Its returns then come in lumps, and have little in common with those of the rows."""
    level = pd.DataFrame({"date": DAYS, "level": table().values.mean(1)})
    _, notes = placed(level.iloc[::every])
    assert any("and stands still on the others" in note for note in notes) == said


def test_a_return_on_a_day_between_rows_is_refused():
    prices = table(every=7)
    dates = [*prices.dates.astype("datetime64[D]").astype(str), "2022-03-31"]
    with pytest.raises(QfolioError, match="return on 2022-03-31, which is not a row"):
        placed(pd.DataFrame({"date": dates, "return": 0.001}), prices)


@pytest.mark.parametrize(
    ("name", "benchmark", "message"),
    [
        ("pathwise", None, "already has a strategy pathwise"),
        ("pathwise-together", None, "already"), ("momentum", None, "already"),
        ("equal-weight at 0.3", None, "already"), ("/b", None, "cannot be called '/b'"),
        ("pathwise/0", None, "already has a strategy pathwise/0"), ("_b", None, "cannot be called"),
        ("+carry", None, "cannot be called"), ("-1x", None, "cannot be called"),
        ("mine", "pathwise", "benchmark pathwise is an agent"),
        ("mine", "min", r"'min' is no baseline.*, and no file \(did you mean 'mine'\?\)"),
        ("A", None, "The table has an asset A; give your strategy of this name another one"),
    ],
)  # fmt: skip
def test_names_that_are_refused(name, benchmark, message):
    with pytest.raises(QfolioError, match=message):
        create(strategies={name: np.full((ROWS, 3), 0.3)}, benchmark=benchmark)


def test_orders_in_shares_hold_shares():
    """100 shares of A are bought, 40 sold and 50 of B bought; in between nothing is traded."""
    prices = table()
    a, b = prices.values[:, 0], prices.values[:, 1]
    orders = weights([20, 20, 110, 120], asset=["cash", "A", "A", "B"], shares=[8000, 100, -40, 50])
    backtest = create(strategies={"60/40 (old, house)": orders}, cost=0.0)
    entry = backtest.replay.own("strategy", backtest._own["60/40 (old, house)"])
    days_ordered = np.flatnonzero(~np.isnan(entry.decisions[0, :, 0])) + FIRST
    np.testing.assert_array_equal(days_ordered, [FIRST, 110, 120])
    cash = 8000 - 100 * a[20]
    expected = 100 * a[FIRST] / (cash + 100 * a[FIRST])
    assert entry.decisions[0, 0, 1] == pytest.approx(expected)
    cash += 40 * a[110] - 50 * b[120]
    total = cash + 60 * a[120] + 50 * b[120]
    weight = entry.decisions[0, 120 - FIRST]
    np.testing.assert_allclose(weight[:3], [cash / total, 60 * a[120] / total, 50 * b[120] / total])


def test_shares_of_a_delisted_asset_are_paid_out():
    prices, listed = table(), np.ones((ROWS, 3), bool)
    values = prices.values.copy()
    listed[100:, 0], values[100:, 0] = False, 0.7 * values[99, 0]
    prices = dataclasses.replace(prices, listed=listed, values=values)
    orders = weights([20, 20, 120], asset=["cash", "A", "B"], shares=[8000, 100, 50])
    backtest = create(prices, strategies={"mine": orders}, cost=0.0)
    entry = backtest.replay.own("strategy", backtest._own["mine"])
    cash = 8000 - 100 * (values[20, 0] - values[120, 0]) - 50 * values[120, 1]
    bought = 50 * values[120, 1]
    weight = entry.decisions[0, 120 - FIRST]
    np.testing.assert_allclose(weight, np.array([cash, 0, bought, 0]) / (cash + bought))
    sold = weights([20, 20, 120], asset=["cash", "A", "A"], shares=[8000, 100, -100])
    with pytest.raises(QfolioError, match=r"row 2 .*A has no price any more, and was paid out"):
        create(prices, strategies={"mine": sold})


def test_the_report_says_where_a_strategy_breaks_the_mandate():
    mine = np.full((ROWS, 3), np.nan)
    mine[[100, 120, 130]] = [[0.3, 0.3, 0.3], [0.6, 0.2, 0.1], [0.7, 0.2, 0.1]]
    fund = np.full(ROWS, 0.001)
    mandate = {"assets": {"cap": 0.5}, "trading": {"turnover": 0.5}}
    backtest = create(mandate=mandate, strategies={"mine": mine, "fund": fund}, benchmark="A")
    _, notes = backtest.replay.others({}, backtest._own, "A")
    (said,) = (note for note in notes if note.startswith("mine breaks"))
    assert "in 3 of its 3 orders, which are carried out as they are" in said
    assert "a weight is above its cap (2, by up to 0.2)" in said
    assert "turnover is too high (2, by up to 0.4)" in said
    assert any("fund has returns only" in note for note in notes)
    assert not any(note.startswith("A ") and "mandate" in note for note in notes)
    calm = np.full((ROWS, 3), 0.15)
    backtest = create(mandate=mandate, strategies={"calm": calm})
    notes = backtest.replay.others({}, backtest._own, "equal-weight")[1]
    assert any(note.startswith("calm keeps the mandate in all of its 60 orders") for note in notes)


def test_the_turnover_of_a_year_counts_anew_in_the_next():
    """Rows are three days apart, so that row 122 is the first of 2021; 0.9 is bought and sold."""
    mine = np.full((ROWS, 3), np.nan)
    mine[[100, 140]] = [[0.3, 0.3, 0.3], [0.0, 0.0, 0.0]]
    mandate = {"trading": {"turnover_a_year": 1.2}}
    backtest = create(table(every=3), mandate=mandate, strategies={"mine": mine})
    (said,) = backtest.replay.others({}, backtest._own, "equal-weight")[1][-1:]
    assert said == "mine keeps the mandate in all of its 2 orders."


def test_a_strategy_breaks_limits_that_depend_on_what_it_held_and_traded_before():
    mine = np.full((ROWS, 3), np.nan)
    mine[[100, 120, 140]] = [[0.3, 0.3, 0.3], [0.0, 0.5, 0.4], [0.31, 0.29, 0.3]]
    trading = {"turnover_a_year": 1.7, "smallest_trade": 0.05}
    mandate = {"trading": trading, "risk": {"volatility": 9.0}}
    backtest = create(mandate=mandate, strategies={"mine": mine})
    (said,) = backtest.replay.others({}, backtest._own, "equal-weight")[1][-1:]
    assert "breaks the mandate, apart from limits of risk, in 1 of its 3 orders" in said
    assert "turnover of the year is too high (1, by up to 0.4" in said
    mine[140] = [0.02, 0.5, 0.4]
    backtest = create(mandate=mandate, strategies={"mine": mine})
    (said,) = backtest.replay.others({}, backtest._own, "equal-weight")[1][-1:]
    assert "a trade is too small (1, by up to 0.0" in said
    mine[140] = np.nan
    backtest = create(mandate=mandate, strategies={"mine": mine})
    (said,) = backtest.replay.others({}, backtest._own, "equal-weight")[1][-1:]
    assert said == "mine keeps the mandate, apart from limits of risk, in all of its 2 orders."


@pytest.mark.parametrize("time", ["16:00", "16:00-05:00"])
def test_levels_and_returns_of_the_close_belong_to_their_day(time):
    prices = table()
    dates = [f"{day} {time}" for day in DAYS]
    level, _ = placed(pd.DataFrame({"date": dates, "level": prices.values[:, 0]}), prices)
    rows = np.arange(FIRST, LAST + 1) + 1
    np.testing.assert_allclose(level, prices.values[rows + 1, 0] / prices.values[rows, 0] - 1)
    twice = [f"{DAYS[120]} 10:00{time[5:]}", *dates]
    with pytest.raises(QfolioError, match=f"several returns on {DAYS[120]}, of which .* one row"):
        placed(pd.DataFrame({"date": sorted(twice), "return": 0.001}), prices)


def test_an_order_with_a_time_zone_is_not_known_before_its_time():
    hours = np.datetime64("2020-01-01T00") + np.arange(ROWS) * np.timedelta64(1, "h")
    prices = price_table(random_walk(ROWS), dates=hours.astype("datetime64[s]"))
    mine = pd.DataFrame({"date": [f"{hours[100]}:00-05:00", f"{hours[130]}:00-05:00"], "A": 0.5})
    np.testing.assert_array_equal(read_own("mine", mine, prices).dates, hours[[105, 135]])


def test_benchmarks_by_name():
    mine = np.full((ROWS, 3), 0.3)
    assert create().config.benchmark == "equal-weight"
    assert create(strategies={"mine": mine}, benchmark="mine").config.benchmark == "mine"
    other = create(benchmark="risk-budgeting").config
    assert (other.benchmark, other.baselines) == (
        "risk-budgeting", ["equal-weight", "risk-budgeting"],
    )  # fmt: skip
    held = create(benchmark="B")
    assert isinstance(held._own["B"].decisions, np.ndarray)
    np.testing.assert_allclose(held._own["B"].decisions[0], [0, 0, 1, 0])
    assert np.isnan(held._own["B"].decisions[1:]).all()
    index = table().values
    priced = Prices(table().dates, ("^GSPC", "=B", "C"), index)
    assert create(priced, benchmark="^GSPC").config.benchmark == "^GSPC"
    with pytest.raises(QfolioError, match="cannot be called '=B'"):  # a formula in returns.csv
        create(priced, benchmark="=B")
    framed = create(benchmark=weights([0], A=[1.0]))
    assert framed.config.benchmark == "benchmark"
    assert isinstance(read_own("x", mine, table()), Own)


def test_orders_in_shares_need_share_prices():
    orders = weights([20, 20], asset=["cash", "A"], shares=[8000, 100])
    cumulated = dataclasses.replace(table(), levels=True)
    with pytest.raises(QfolioError, match="Strategy 'house': orders in shares need share prices"):
        read_own("house", orders, cumulated)
