"""Returns become prices with the same returns, and are told from prices."""

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices.table import Prices, describe, load

from tables import findings, random_walk

ROWS = 80
DAYS = pd.bdate_range("2020-01-01", periods=ROWS)
NAN = np.nan


def prices(seed: int = 0) -> pd.DataFrame:
    return pd.DataFrame(random_walk(ROWS, seed=seed), index=DAYS, columns=list("ABC"))


def test_returns_of_prices_give_the_prices_back():
    """In the row before the first return the price is 100."""
    table = prices()
    expected = 100 * table.to_numpy() / table.to_numpy()[0]
    back = load(table.pct_change(), returns="fraction")
    assert len(back) == ROWS
    np.testing.assert_allclose(back.values, expected, rtol=1e-12)
    percent = load(100 * table.pct_change(), returns="percent")
    np.testing.assert_allclose(percent.values, expected, rtol=1e-12)
    (note,) = findings(table.pct_change(), "note", returns="fraction")
    assert note.message == "prices are cumulated from returns and start at 100"


def test_the_first_return_is_lost_without_the_row_before_it():
    table = prices()
    rates = table.pct_change().iloc[1:]
    back = load(rates, returns="fraction")
    assert len(back) == ROWS - 1
    assert (back.values[0] == 100).all()
    np.testing.assert_allclose(back.relatives, 1 + rates.to_numpy()[1:], rtol=1e-12)
    (note,) = findings(rates, "note", returns="fraction")
    assert "the first row's returns are not used" in note.message


def test_every_form_of_table(tmp_path):
    rates = prices().pct_change().iloc[1:].rename_axis("date")
    expected = load(rates, returns="fraction")
    long = rates.reset_index().melt("date", var_name="asset", value_name="price")
    np.testing.assert_array_equal(load(long, returns="fraction").values, expected.values)
    newest_first = rates.iloc[::-1]
    np.testing.assert_array_equal(load(newest_first, returns="fraction").values, expected.values)
    rates.to_csv(tmp_path / "r.csv")
    assert load(tmp_path / "r.csv", returns="fraction").digest == expected.digest


def test_late_assets_and_gaps():
    rates = prices().pct_change()
    rates.iloc[:20, 1] = NAN
    rates.iloc[40, 2] = NAN
    with pytest.raises(QfolioError, match="'C': the price is missing"):
        load(rates, returns="fraction", late="join")
    table = load(rates, returns="fraction", late="join", missing="forward-fill")
    assert table.first_rows.tolist() == [0, 19, 0]
    assert table.values[19, 1] == 100
    np.testing.assert_allclose(table.relatives[19:, 1], 1 + rates["B"].to_numpy()[20:], rtol=1e-12)
    assert table.relatives[39, 2] == 1  # the last price stands
    np.testing.assert_allclose(table.relatives[40, 2], 1 + rates["C"].iloc[41], rtol=1e-12)


@pytest.mark.parametrize(
    ("cell", "unit", "message"),
    [
        (-1.0, "fraction", "row 7 (2020-01-10), column 'B': the return is −100% or less"),
        (-1.5, "fraction", "column 'B': the return is −100% or less. Check the unit"),
        (-100.0, "percent", "column 'B': the return is −100% or less"),
        (np.inf, "fraction", "column 'B': the return is infinite"),
        (1e7, "fraction", "the price goes from"),
    ],
)
def test_returns_that_cannot_be(cell: float, unit: str, message: str):
    rates = prices().pct_change() * (100 if unit == "percent" else 1)
    rates.iloc[7, 1] = cell
    with pytest.raises(QfolioError) as raised:
        load(rates, returns=unit)
    assert message in str(raised.value)


def test_an_asset_that_lost_everything_stays_in_the_table():
    """To drop it would be survivorship."""
    lost, rates = prices(), prices().pct_change()
    lost.iloc[7:, 1], rates.iloc[7, 1] = 0.0, -1.0
    for table, unit in ((lost, None), (rates, "fraction")):
        with pytest.raises(QfolioError, match="empty its cells from there on and choose ended='c"):
            load(table, returns=unit)
        table.iloc[7:, 1] = np.nan
        found = load(table, returns=unit, ended="cash-out", delisting_haircut=1)
        assert found.values[7, 1] < 1e-6


def test_a_unit_that_is_unlikely():
    rates = prices().pct_change()
    assert findings(rates, "warning", returns="fraction") == []
    assert findings(100 * rates, "warning", returns="percent") == []
    (warning,) = findings(rates, "warning", returns="percent")
    assert (warning.message[:19], warning.advice) == (
        "the usual return is", "Check the unit: perhaps it is fraction."
    )  # fmt: skip
    with pytest.raises(QfolioError, match="−100% or less"):
        load(100 * rates, returns="fraction")
    with pytest.raises(QfolioError, match="choose from percent, fraction, relative"):
        load(rates, returns="log")


def test_percentages_near_1_of_a_fund_that_never_loses():
    rng = np.random.default_rng(0)
    months = pd.date_range("2015-01-31", periods=60, freq="ME")
    table = pd.DataFrame(rng.uniform(0.75, 1.25, (60, 1)), index=months, columns=["CDI"])
    assert "price relatives" in str(findings(table, "warning", returns="percent"))
    back = load(table, returns="percent")
    np.testing.assert_allclose(back.relatives[:, 0], 1 + table["CDI"].to_numpy()[1:] / 100)


def test_relatives_are_told_from_prices():
    """As prices they would revert to 1, and be bought below it at a profit."""
    table = prices()
    relatives = table / table.shift(1)
    for unit in (None, "percent", "fraction"):
        (error,) = findings(relatives.iloc[1:], "error", returns=unit)
        assert error.message.startswith("the numbers look like price relatives, new price over old")
        assert error.advice.endswith("hoose returns='relative' (--returns).")
    (warning,) = findings(1 + 0.2 * (relatives.iloc[1:] - 1), "warning")  # or pegged coins
    assert warning.advice == "If so, choose returns='relative' (--returns)."
    back = load(relatives, returns="relative")
    np.testing.assert_allclose(back.values, 100 * table / table.iloc[0], rtol=1e-12)
    with pytest.raises(QfolioError, match="−100% or less"):
        load(relatives.mask(relatives == relatives.iloc[5, 1], 0.0), returns="relative")
    (warning, *_) = findings(1 + 40 * (relatives - 1), "warning", returns="relative")
    assert "taken as relative" in warning.message


@pytest.mark.parametrize(("level", "unit", "kind"), [
    (100.0, "percent", "error"), (100.0, "fraction", "error"), (100.0, "relative", "error"),
    (1.0, "percent", "warning"), (1.0, "fraction", "error"),
])  # fmt: skip
def test_prices_are_told_from_returns(level: float, unit: str, kind: str):
    table = prices() / prices().iloc[0] * level
    (found, *_) = findings(table, kind, returns=unit)
    assert found.message.startswith("the numbers look like prices, not returns: none is a loss")
    assert found.advice == "If they are prices, leave out returns (--returns)."
    few = findings(table[:15], returns=unit)  # which may be a rally
    assert not any("look like prices" in each.message for each in few)
    rising = abs(table.pct_change()).iloc[1:]  # of funds that are valued smoothly
    assert not findings(10 * rising, "error", returns="percent")


def test_prices_near_one_are_prices():
    """Exchange rates wander across 1 rarely, and dollars on a blockchain stay at it."""
    rng, days = np.random.default_rng(3), prices().index
    rates = np.exp(rng.normal(0, 0.005, (len(days), 3)).cumsum(axis=0))
    for values in (rates, rates[:15], 1 + rng.normal(0, 3e-4, (len(days), 3))):
        assert not findings(pd.DataFrame(values, days[: len(values)], list("ABC")), "error")


def test_returns_are_told_from_prices():
    rates = prices().pct_change().iloc[1:]
    for table in (rates, 100 * rates):
        (error,) = findings(table, "error")
        assert error.message.startswith("the numbers look like returns: ")
        assert error.advice == (
            "Give prices, or choose returns='percent' or 'fraction' (--returns)."
        )
    table = prices()
    table.iloc[5, 1] = -1
    (error,) = findings(table, "error")
    assert error.message == "the price is negative"


# Columns of the whole market.


@pytest.mark.parametrize("name", ["return", "Returns", "RET"])
@pytest.mark.parametrize("assets", [["A", "B", "C"], [700, 5, 9988]])
def test_a_long_table_may_call_its_values_returns(name: str, assets: list):
    rates = prices().pct_change().iloc[1:]
    table = rates.set_axis(assets, axis=1).rename_axis("date").reset_index()
    table = table.melt("date", var_name="ticker", value_name=name)
    back = load(table, returns="fraction")
    assert back.assets == tuple(map(str, assets))
    np.testing.assert_allclose(back.relatives, 1 + rates.to_numpy()[1:], rtol=1e-12)
    table[name] = abs(table[name])  # not even then are they prices
    (error,) = findings(table, "error")
    assert str(error) == f"column {name!r}: holds returns, but no column is called price or close"
    assert "returns='percent' or 'fraction' (--returns)" in error.advice
    closes = table.assign(close=prices().to_numpy()[1:].T.ravel())
    np.testing.assert_allclose(load(closes).values, prices().to_numpy()[1:])
    assert load(closes, returns="fraction").values.max() < 1000  # not of the closes


def test_a_column_of_the_market():
    table = prices()
    table.insert(1, "rate", np.linspace(0.01, 0.05, ROWS))
    loaded = load(table, columns=("rate",))
    assert (loaded.assets, loaded.market_names) == (("A", "B", "C"), ("rate",))
    np.testing.assert_array_equal(loaded.market[:, 0], table["rate"])
    assert loaded.feature_names == ()
    assert describe(loaded)["columns"] == ["rate"]
    part = loaded.select(["B"]).between(10, 20)
    np.testing.assert_array_equal(part.market, loaded.market[10:20])
    other = load(table.assign(rate=0.02), columns="rate")
    bare = load(table.drop(columns="rate"))
    assert len({loaded.digest, other.digest, bare.digest}) == 3
    both = load(table.assign(beta=2.0), columns=("rate",), features=("beta",))
    assert (both.feature_names, both.market_names) == (("beta",), ("rate",))
    np.testing.assert_array_equal(both.features[..., 0], np.full((ROWS, 3), 2.0))


def test_a_column_of_the_market_in_a_long_table():
    table = prices().rename_axis("date").reset_index().melt("date", var_name="asset")
    table = table.rename(columns={"value": "price"})
    table["rate"] = table.groupby("date")["price"].transform("size") * 0.01
    late = table.drop(table.index[(table["asset"] == "B") & (table["date"] < DAYS[5])])
    late["rate"] = 0.03
    np.testing.assert_array_equal(
        load(late, columns=("rate",), late="join").market, np.full((ROWS, 1), 0.03)
    )
    table.loc[7, "rate"] = 0.9
    with pytest.raises(QfolioError, match=r"2020-01-10, column 'rate': has several numbers on one"):
        load(table, columns=("rate",))


def test_columns_of_the_market_must_be_finite_and_named_once():
    table = prices()
    table["rate"] = [0.01, NAN, *[0.02] * (ROWS - 2)]
    with pytest.raises(QfolioError, match=r"row 1 .*'rate': the feature is missing"):
        load(table, columns=("rate",))
    filled = load(table, columns=("rate",), missing="forward-fill")
    assert filled.market[:3, 0].tolist() == [0.01, 0.01, 0.02]
    with pytest.raises(QfolioError, match="named twice"):
        load(table, columns=("rate",), features=("rate",))
    with pytest.raises(QfolioError, match="there is no column 'rates'"):
        load(table, columns=("rates",))
    with pytest.raises(QfolioError, match=r"write --columns rates=FILE"):
        load(table, columns=("rates",))
    with pytest.raises(QfolioError, match=r"no column 'volume'.* The columns are [^;]*\.$"):
        load(table, features=("volume",))
    values = prices().to_numpy()
    with pytest.raises(QfolioError, match="do not fit"):
        Prices(DAYS.to_numpy(), ("A", "B", "C"), values, market=values, market_names=("r",))


def test_columns_that_costs_use_load_by_asset():
    """Volume, spread and borrow fee in a long table are features by name."""
    table = prices().rename_axis("date").reset_index().melt("date", var_name="asset")
    names = ("volume", "spread", "borrow_fee")
    for k, name in enumerate(names):
        table[name] = k + np.arange(len(table)) / 1000
    loaded = load(table, features=names)
    assert loaded.feature_names == names
    np.testing.assert_array_equal(loaded.features[:, 1, 2], 2 + np.arange(ROWS, 2 * ROWS) / 1000)
