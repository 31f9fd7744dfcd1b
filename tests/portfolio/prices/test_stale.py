"""A price that stands still is named where its asset usually moves, and only there."""

import numpy as np
import pandas as pd

from tables import findings, random_walk

ROWS, ASSETS = 500, 6
DAYS = pd.bdate_range("2020-01-01", periods=ROWS)


def market(days: pd.DatetimeIndex = DAYS, seed: int = 0) -> pd.DataFrame:
    return pd.DataFrame(random_walk(len(days), ASSETS, seed), days, list("ABCDEF"))


def test_a_price_that_is_carried_forward_to_the_end():
    table = market()
    assert findings(table) == []
    table.iloc[400:, 1] = table.iloc[399, 1]
    (warning,) = findings(table)
    assert (warning.severity, warning.row, warning.column) == ("warning", ROWS - 1, "B")
    assert warning.date == str(DAYS[-1])[:10]  # also news for allocate, whatever the backtest saw
    assert f"since {str(DAYS[399])[:10]} (100 rows)" in warning.message
    assert "perhaps the asset was delisted" in warning.message
    assert "ended='cash-out' (--ended)" in warning.advice
    table.iloc[400:, 1] = np.nan
    assert "100 rows" in findings(table, missing="forward-fill")[-1].message
    assert findings(table, "warning", ended="cash-out") == []


def test_in_a_long_table_the_asset_is_named():
    table = market()
    table.iloc[400:, 1] = table.iloc[399, 1]
    long = (
        table.rename_axis("date").reset_index().melt("date", var_name="asset", value_name="price")
    )
    (warning,) = findings(long)
    assert warning.message.startswith("the price of 'B' has been")


def test_many_are_counted_and_the_count_is_news():
    table = market()
    table.iloc[450:] = np.where(np.arange(ASSETS) < 5, table.iloc[449], table.iloc[450:])
    table["G"] = table["A"] * 1.5
    *named, more = findings(table, "warning")[:6]
    assert [warning.column for warning in named] == list("ABCDE")
    assert (more.count, more.date) == (1, str(DAYS[-1])[:10])
    assert more.message == "and 1 more price unchanged for long up to the last row"


def test_spells_before_the_end_are_counted_in_a_note():
    table = market()
    table.iloc[:60, 0] = table.iloc[60, 0]  # filled backward
    table.iloc[200:231, 2] = table.iloc[199, 2]
    (note,) = findings(table)
    assert note.severity == "note"
    assert note.message == (
        "2 long spells of an unchanged price; the longest: 'A' from 2020-01-01 "
        f"to {str(DAYS[60])[:10]} (60 rows)"
    )


def test_a_price_that_is_quoted_once_a_week_changes():
    table = market()
    table.loc[table.index.day_of_week != 4, "B"] = np.nan
    assert not [each for each in findings(table) if "never changes" in each.message]


def test_a_price_that_never_changes():
    table = market()
    table["C"] = 20.0
    (warning,) = findings(table)
    assert (warning.severity, warning.message) == ("warning", "the price of 'C' never changes")
    table.iloc[:, :] = 20.0
    assert findings(table, "warning")[-1].message == "and 1 more price that never change"


def thinned(table: pd.DataFrame, chance: float, rng: np.random.Generator) -> pd.DataFrame:
    """The table of illiquid assets, which keep their price with this chance."""
    return table.where(rng.random(table.shape) > chance).ffill().bfill()


def test_what_is_usual_for_an_asset_is_no_finding():
    """Illiquid stocks, funds that are valued monthly, pegs; minutes, weeks and months."""
    rng = np.random.default_rng(0)
    assert findings(thinned(market(), 0.6, rng), "warning") == []
    assert findings(thinned(market(), 0.9, rng), "warning") == []
    table = market()
    table["B"] = table["B"].where(np.arange(ROWS) % 21 == 0).ffill()
    table["C"] = table["C"].round(-1)  # few large ticks
    assert findings(table) == []
    for days in (
        pd.date_range("2020-01-01", periods=ROWS, freq="min"),
        pd.date_range("2000-01-01", periods=ROWS, freq="W"),
        pd.date_range("1980-01-31", periods=ROWS, freq="ME"),
    ):
        assert findings(thinned(market(days), 0.4, rng)) == []
    assert findings(thinned(market(), 0.9, rng)[["A"]], "note") == []


def test_rows_on_which_nothing_moves_are_counted_in_a_note():
    days = pd.date_range("2020-01-01", periods=ROWS)
    open_days = days.day_of_week < 5
    table = market(days).where(np.repeat(open_days[:, None], ASSETS, 1)).ffill()
    (note,) = findings(table)
    idle = int((~open_days).sum())
    assert note.message == (
        f"on {idle} rows ({idle / (ROWS - 1):.1%}) no price moves, first on 2020-01-04: perhaps "
        "holidays, filled with the prices before"
    )
    table.iloc[100:130] = table.iloc[99]  # closed for a month: not a spell of any asset
    assert [finding.severity for finding in findings(table)] == ["note"]
    few = market()
    few.iloc[[50, 100, 150]] = few.iloc[[49, 99, 149]]
    assert findings(few) == []


def test_the_default_table_holds_prices_that_stood_still():
    """Range Resources in its first two years; no asset stands still at the end."""
    (note,) = [str(finding) for finding in findings() if "unchanged" in finding.message]
    assert "8 long spells" in note
    assert "'RRC' from 1990-01-02 to 1990-04-09 (68 rows)" in note
