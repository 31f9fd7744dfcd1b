"""A rate that was left among the assets is named, and what is only illiquid is not."""

import numpy as np
import pandas as pd
import pytest

from tables import findings, random_walk

ROWS = 500
DAYS = pd.bdate_range("2020-01-01", periods=ROWS, name="date")


def market(**more: object) -> pd.DataFrame:
    return pd.DataFrame(random_walk(ROWS, 4), DAYS, list("ABCD")).assign(**more)


def rates(table: pd.DataFrame) -> list[str]:
    return [str(f) for f in findings(table, "warning") if "rate" in f.message]


@pytest.mark.parametrize(
    "name",
    ["rate", "Cash_Rate", "10y yield", "IRX", "^IRX", "TNX", "VIX", "VIX Index", "T-Bill",
     "risk_free", "riskfree", "T-Bills", "FEDFUNDS"],
)  # fmt: skip
def test_names_of_rates(name: str):
    (warning,) = findings(market(**{name: random_walk(ROWS, 1, 7)[:, 0]}))
    assert warning.severity == "warning"
    assert warning.message == f"'{name}' has the name of a rate or an index, which cannot be bought"
    assert f"choose columns=['{name}'] (--columns '{name}')" in warning.advice


@pytest.mark.parametrize(
    "name",
    [
        "Corporate",
        "Pirates",
        "Vixen",
        "US High Yield",
        "Floating Rate Notes",
        "RF",
        "CASHX",
        "High Dividend Yield",
    ],
)
def test_names_of_assets(name: str):
    assert findings(market(**{name: random_walk(ROWS, 1, 7)[:, 0]})) == []


def test_rf_is_a_rate_where_it_is_less_than_one():
    assert rates(market(RF=random_walk(ROWS, 1, 7)[:, 0] / 5000)) == [
        "'RF' has the name of a rate or an index, which cannot be bought"
    ]


def test_an_asset_that_almost_never_changes():
    steps = np.where(np.arange(ROWS) < 300, 0.01, 0.04)
    table = market(policy=steps)
    assert rates(table) == [
        "'policy' changes on only 1 of 500 rows: perhaps it is a rate, not a price"
    ]
    assert len(findings(table)) == 1  # neither delisted nor a price that stands still
    long = table.reset_index().melt("date", var_name="asset", value_name="price")
    (warning,) = findings(long, "warning")
    assert warning.advice == "If so, leave out its rows; otherwise it is traded."


def test_a_rate_that_never_changes_has_one_warning():
    (warning,) = findings(market(rate=0.02))
    assert "has the name of a rate" in warning.message


def test_many_are_counted():
    curve = random_walk(ROWS, 7, 7).T
    said = [f.message for f in findings(market(**{f"{k}y yield": curve[k] for k in range(7)}))]
    assert len(said) == 6
    assert said[-1] == "and 2 more assets that may be rates"


def test_what_is_valued_rarely_is_an_asset():
    """Funds that are valued once a month or a quarter, and tables in which all assets are such."""
    rows = np.arange(ROWS)
    for every in (21, 63):
        fund = market()["B"].where(rows % every == 0).ffill()
        assert rates(market(fund=fund)) == []
    table = market()
    assert rates(table[rows % 100 == 0].reindex(DAYS, method="ffill")) == []
    assert rates(table[:90].assign(policy=np.where(rows[:90] < 50, 1.0, 2.0))) == []
