"""A backtest's own strategies and its benchmark, followed without any training."""

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.baselines.equal_weight import BuyAndHold, EqualWeight
from qfolio.portfolio.backtest.folder import BacktestFolder
from qfolio.portfolio.backtest.folds import spell_all
from qfolio.portfolio.backtest.own import Own
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.consistency import Promise, band, evidence
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.follow import SEED, follow
from qfolio.portfolio.desk.live import mark
from qfolio.portfolio.desk.standing import Standing
from qfolio.portfolio.desk.untrained import Ordered, Rule
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.task import Portfolio

from tables import days, price_table, random_walk
from tiny import PATHWISE

# As in PPO's preset.
ACTIVE = {**PATHWISE.task, "anchor": "equal-weight", "active": True, "tracking_aversion": 10.0}
AGENTS = {"pathwise": PATHWISE._replace(task=ACTIVE)}
NAMES = ("cash", "A", "B", "C")
DAYS = days(160).astype(str)


def table():
    return price_table(random_walk(160, drift=3e-4))


WEIGHTS = pd.DataFrame({"date": DAYS[[40, 110, 130]], "A": [0.6, 0.2, 0.5], "B": [0.4, 0.7, 0.1]})
SHARES = pd.DataFrame(
    {"date": DAYS[[40, 40, 120]], "asset": ["cash", "A", "B"], "shares": [1000.0, 5.0, 3.0]}
)
RETURNS = pd.DataFrame({"date": DAYS, "return": np.full(160, 1e-3)})
INDEX = pd.DataFrame({"date": DAYS, "level": np.exp(np.arange(160) * 1e-3)})


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Of a backtest that is not trained; its benchmark is an asset.

    Agents fill orders over two rows; strategies of one's own are filled at once.
    """
    out = tmp_path_factory.mktemp("rule") / "run"
    Backtest.create(
        table(), AGENTS, out=out, train="100d", test="60d", seeds=1, baselines=["momentum"], lag=0,
        strategies={"60/40": WEIGHTS, "traded": SHARES, "fund": RETURNS, "index": INDEX},
        benchmark="C", mandate={"assets": {"cap": 0.55}, "trading": {"fill": 2}},
    )  # fmt: skip
    return Desk.open(out)


def ordered(desk, name, rows):
    weights = desk.followed(name).weights(table().between(0, rows))
    return [weights[each] for each in NAMES]


def test_the_latest_weights_up_to_the_last_row_are_ordered(desk):
    for rows, expected in (
        (41, [0, 0.6, 0.4, 0]), (110, [0, 0.6, 0.4, 0]), (111, [0.1, 0.2, 0.7, 0]),
        (160, [0.4, 0.5, 0.1, 0]),
    ):  # fmt: skip
        assert ordered(desk, "60/40", rows) == pytest.approx(expected)
    with pytest.raises(QfolioError, match="60/40 has no order up to 2020-02-09; its first is of"):
        ordered(desk, "60/40", 40)


def test_orders_in_shares_count_at_the_prices_of_their_day(desk):
    close = table().values[120]
    worth = np.array([1000 - 5 * table().values[40, 0] - 3 * close[1], 5 * close[0], 3 * close[1]])
    assert ordered(desk, "traded", 160)[:3] == pytest.approx(worth / worth.sum())


def test_an_asset_as_benchmark_gets_everything(desk):
    assert ordered(desk, "C", 160) == [0, 0, 0, 1]
    (held, broken) = desk.followed("C").notes(table())
    assert held == "C is bought with all the money, and held."
    assert broken == (
        "The weights break the mandate (a weight is above its cap by 0.45), and are carried out "
        "all the same, as in the backtest."
    )
    assert desk.followed("60/40").notes(table()) == [
        "These are the weights of 60/40 of 2020-05-10, its latest up to 2020-06-08 in the "
        "backtest's copy, which ends on 2020-05-10."
    ]


def test_an_order_that_trades_too_much_or_too_little_is_named(tmp_path):
    """The latest order is half in A and a tenth in B; the year allows a turnover of 0.5."""
    Backtest.create(
        table(), AGENTS, out=tmp_path / "run", train="100d", test="60d", seeds=1,
        strategies={"60/40": WEIGHTS},
        mandate={"trading": {"turnover": 0.5, "turnover_a_year": 0.5, "smallest_trade": 0.01}},
    )  # fmt: skip
    strategy = Desk.open(tmp_path / "run").followed("60/40")
    assert isinstance(strategy, Ordered)

    def said(held, spent=0.0):
        _, *broken = strategy.notes(table(), np.array(held), spent=spent)
        return " ".join(broken).removesuffix(
            "), and are carried out all the same, as in the backtest."
        )

    assert said([0.4, 0.5, 0.1, 0.0], spent=0.5) == ""
    assert said([1.0, 0.0, 0.0, 0.0]) == (
        "The weights break the mandate (turnover is too high by 0.1, turnover of the year is too "
        "high by 0.1"
    )
    assert said([0.6, 0.3, 0.1, 0.0], spent=0.4) == (
        "The weights break the mandate (turnover of the year is too high by 0.1"
    )
    assert said([0.396, 0.504, 0.1, 0.0]) == (
        "The weights break the mandate (a trade is too small by 0.006"
    )


@pytest.mark.parametrize(("name", "kind"), [("fund", "returns"), ("index", "levels")])
def test_a_strategy_without_weights_is_refused(desk, name, kind):
    with pytest.raises(QfolioError, match=f"knows only the {kind} of {name}, not its weights"):
        desk.followed(name)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("equal-weigh", "did you mean equal-weight?"), ("60-40", "did you mean 60/40?"),
        ("pathwis", "did you mean pathwise?"),
        ("x", "choose from pathwise, equal-weight, momentum, 60/40, traded, fund, index, C."),
    ],
)  # fmt: skip
def test_an_unknown_name_gets_the_near_ones(desk, name, said):
    with pytest.raises(QfolioError) as error:
        desk.followed(name)
    assert str(error.value) == f"The backtest has no agent, baseline or strategy '{name}'; {said}"


@pytest.mark.parametrize("name", ["momentum", "60/40", "C"])
def test_prices_of_another_frequency_are_refused(desk, name):
    """Their returns would be compared with those of the backtest's days."""
    months = np.arange("2020-01", "2022-01", dtype="datetime64[M]").astype("datetime64[D]")
    prices = Prices(months, NAMES[1:], np.ones((len(months), 3)))
    with pytest.raises(QfolioError, match="about 12 rows a year, and the backtest has 365; give"):
        desk.followed(name).weights(prices)


def test_an_asset_without_a_price_is_refused(desk):
    values = table().values.copy()
    values[:, 2] = np.nan
    prices = Prices(table().dates, NAMES[1:], values)
    with pytest.raises(QfolioError, match="C orders C, which has no price on 2020-06-08"):
        desk.followed("C").weights(prices)


def test_the_ledger_of_a_strategy_is_followed_and_reproduced(desk):
    run, start = desk.run, table().between(0, 131)
    assert Standing.of(desk.folder, "60/40", desk.kind("60/40")).kind == "strategy"
    known = desk.followed("60/40")
    allocation = Allocation.of(known, start, np.zeros(3), 1000.0)
    record, _ = desk.record("60/40", allocation, start, False)
    assert record.policy is None
    assert desk.reproduce(record.date)[1].weights == pytest.approx([0.4, 0.5, 0.1, 0])
    entries, _ = run.replay.others(run.baselines, run._own, "C")
    returns = {name: entries[name].simulation.returns[0] for name in ("60/40", "C")}
    BacktestFolder(desk.folder).write_returns(spell_all(run.dates, run.dates), returns)
    found = follow(desk)
    # Its last order is of this day; after the cost of the trade, it goes on as in the backtest.
    assert len(found.live.returns) == 160 - 131
    np.testing.assert_allclose(found.live.returns[1:], returns["60/40"][132 - 160 :], atol=1e-12)
    assert "60/40 learns nothing, so there is nothing to train." in found.sentences()
    # Evidence is half against its own returns, and half against those over the benchmark.
    rng, lead = np.random.default_rng(SEED), returns["60/40"] - returns["C"]
    band(returns["60/40"], 29, rng)
    own, over = (Promise.of(each, rng, promises=2) for each in (returns["60/40"], lead))
    wanted = evidence(own, found.live.returns) + evidence(
        over, found.live.returns - found.reference
    )
    np.testing.assert_allclose(found.evidence, wanted / 2)
    assert not any("fills orders" in x for x in desk.terms(known, start, allocation, 0.0))
    rule = desk.followed("momentum")
    assert any("over 2 rows" in x for x in desk.terms(rule, start, allocation, 0.0))


@pytest.mark.parametrize(("fill", "pending"), [(1, [121]), (3, [121, 122, 123])])
def test_orders_that_the_lag_leaves_unfilled_are_named(tmp_path, fill, pending):
    """The last part of an order of row 119 is filled at the close of row 120 + fill."""
    out = tmp_path / "run"
    Backtest.create(
        table(), AGENTS, out=out, train="100d", test="50d", seeds=1, lag=2,
        mandate={"trading": {"fill": fill}},
    )  # fmt: skip
    desk, shares = Desk.open(out), np.zeros(3)
    rule = desk.followed("equal-weight")
    said = {}
    for rows in range(120, 126):
        known = table().between(0, rows)
        allocation = Allocation.of(rule, known, shares, 1000.0)
        said[rows] = " ".join(desk.terms(rule, known, allocation, 0.0))
        if rows == 120:
            desk.record("equal-weight", allocation, known, False)
    unfilled = "lag of 2 rows, the orders of 2020-04-29 are not filled yet"
    assert [rows for rows, text in said.items() if unfilled in text] == pending


def test_the_turnover_of_a_year_is_that_of_all_parts_of_its_orders(tmp_path):
    """An allocation within the band leaves the parts that remain; the year allows 1.5."""
    Backtest.create(
        table(), AGENTS, out=tmp_path / "run", train="100d", test="60d", seeds=1, baselines=[],
        calendar="drift:0.3", mandate={"trading": {"turnover_a_year": 1.5, "fill": 3}},
    )  # fmt: skip
    desk, prices = Desk.open(tmp_path / "run"), table()
    rule, start = desk.followed("equal-weight"), prices.between(0, 131)
    first = Allocation.of(rule, start, np.zeros(3), 1000.0)
    desk.record("equal-weight", first, start, False)
    after = prices.between(0, 132)
    second = Allocation.of(rule, after, first.trades, first.cash_after, spent=first.turnover)
    assert not second.trades.any()
    desk.record("equal-weight", second, after, False)
    for rows, parts in ((132, 1), (133, 2), (134, 3), (150, 3)):
        spent = desk.spent(rule, prices.between(0, rows))
        assert spent == pytest.approx(first.turnover * parts / 3)
    # A table that begins later does not say which parts were filled.
    assert desk.spent(rule, prices.between(140, None)) == pytest.approx(first.turnover)
    for spent, left in ((0.0, 1.0), (1.0, 0.5), (1.5, 0.0)):
        assert 1 - rule.weights(prices, spent=spent)["cash"] == pytest.approx(left, abs=1e-6)
    dates = spell_all(desk.run.dates, desk.run.dates)
    tested = np.random.default_rng(0).normal(0, 0.01, len(dates))
    BacktestFolder(desk.folder).write_returns(dates, {"equal-weight": tested})
    live = mark(desk.ledger.current(), prices, rule.costs, 1, [3, 3], band=0.3)
    np.testing.assert_array_equal(follow(desk).live.returns, live.returns)


def test_a_margin_call_reduces_what_a_baseline_would_keep():
    """The margin calls above 1 / 0.58 = 1.72 times the wealth; the baseline orders nothing."""
    prices = table()
    mandate = {
        "assets": {"cap": 2.0}, "cash": {"min": -1.0}, "exposure": {"gross": 1.7, "margin": 0.58}
    }  # fmt: skip
    task = Portfolio.of(prices, mandate=mandate, window=10)
    rule = Rule(
        "buy-and-hold", BuyAndHold(), prices.assets, task, train="100d", expanding=True, cap=1.0
    )
    for each, gross in ((0.6, 1.7), (0.55, 1.65)):
        held = {"cash": 1 - 3 * each, "A": each, "B": each, "C": each}
        assert 1 - rule.weights(prices, held)["cash"] == pytest.approx(gross)


def test_what_a_baseline_keeps_of_a_delisted_asset_is_cash():
    listed = np.ones((160, 3), bool)
    listed[150:, 2] = False
    prices = price_table(table().values, listed=listed)
    task = Portfolio.of(prices, window=10)
    rule = Rule(
        "buy-and-hold", BuyAndHold(), prices.assets, task, train="100d", expanding=True, cap=1.0
    )
    found = rule.weights(prices, {"cash": 0.1, "A": 0.5, "C": 0.4})
    assert found == pytest.approx({"cash": 0.5, "A": 0.5, "B": 0, "C": 0})


def test_what_an_order_holds_of_a_delisted_asset_is_cash():
    listed = np.ones((160, 3), bool)
    listed[150:, 2] = False
    prices = price_table(table().values, listed=listed)
    own = Own("weights", prices.dates[[140]], np.array([[0.1, 0.5, 0.0, 0.4]]))
    strategy = Ordered("mine", own, prices.assets, Portfolio.of(prices, window=10), 1.0)
    assert strategy.weights(prices) == pytest.approx({"cash": 0.5, "A": 0.5, "B": 0, "C": 0})


def test_a_baseline_keeps_what_is_within_the_band_of_the_calendar():
    prices = table()
    task = Portfolio.of(prices, calendar="drift:0.05", window=10)
    rule = Rule(
        "equal-weight", EqualWeight(), prices.assets, task, train="100d", expanding=True, cap=1.0
    )
    near = {"cash": 0.0, "A": 0.38, "B": 0.32, "C": 0.3}
    assert rule.weights(prices, near) == near
    far = {"cash": 0.0, "A": 0.4, "B": 0.3, "C": 0.3}
    assert rule.weights(prices, far)["A"] == pytest.approx(1 / 3)


def test_a_baseline_trades_what_is_left_of_the_turnover_of_the_year():
    prices = table()
    mandate = {"trading": {"turnover_a_year": 0.5}}
    task = Portfolio.of(prices, mandate=mandate, window=10)
    rule = Rule(
        "equal-weight", EqualWeight(), prices.assets, task, train="100d", expanding=True, cap=1.0
    )
    for spent, bought in ((0.0, 0.5), (0.2, 0.3), (0.7, 0.0)):
        assert 1 - rule.weights(prices, spent=spent)["cash"] == pytest.approx(bought, abs=1e-6)


def test_prices_that_begin_later_than_a_baseline_looks_back_are_named(desk):
    """Momentum looks back a year, and the backtest's prices have 160 days."""
    prices = table().between(30, 160)
    said = {}
    for name in ("momentum", "equal-weight"):
        rule = desk.followed(name)
        allocation = Allocation.of(rule, prices, np.zeros(3), 1000.0)
        said[name] = " ".join(desk.terms(rule, prices, allocation, 0.0))
    assert "begin on 2020-01-31, but momentum looks back to 2020-01-01; give" in said["momentum"]
    assert "looks back" not in said["equal-weight"]


def test_prices_from_which_an_asset_does_not_seem_late_are_named(tmp_path):
    """C has prices in all of a table that begins late, but not in the training window."""
    values = table().values.copy()
    values[:90, 2] = np.nan
    prices = price_table(values)
    Backtest.create(
        prices, AGENTS, out=tmp_path / "run", train="100d", test="50d", seeds=1,
        baselines=["momentum"],
    )  # fmt: skip
    desk = Desk.open(tmp_path / "run")
    for name in ("equal-weight", "momentum"):
        rule, said = desk.followed(name), []
        for known in (prices, prices.between(95, None)):
            allocation = Allocation.of(rule, known, np.zeros(3), 1000.0)
            said.append(" ".join(desk.terms(rule, known, allocation, 0.0)))
        assert "looks back" not in said[0]
        assert f"begin on 2020-04-05, but {name} looks back to 20" in said[1]


def test_a_late_asset_is_named_where_another_was_delisted(tmp_path):
    """OLMAR looks back on a week, but holds only assets with prices in all of the window."""
    values = random_walk(160, 4)
    values[:90, 2], values[120:, 3] = np.nan, np.nan
    frame = pd.DataFrame(values, pd.DatetimeIndex(days(160), name="date"), list("ABCD"))
    prices = load(frame, late="join", ended="cash-out")
    Backtest.create(
        prices, AGENTS, out=tmp_path / "run", train="100d", test="50d", seeds=1,
        baselines=["olmar"],
    )  # fmt: skip
    desk = Desk.open(tmp_path / "run")
    for name, named in (("olmar", True), ("equal-weight", False)):
        rule, known = desk.followed(name), prices.between(95, None)
        said = desk.terms(rule, known, Allocation.of(rule, known, np.zeros(4), 1000.0), 0.0)
        assert any("but olmar looks back to 20" in each for each in said) == named
