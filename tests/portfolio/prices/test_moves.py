"""A jump is called a split only where it is one, and a price that goes back is called wrong."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from qfolio.portfolio.prices.findings import Finding

from tables import findings

ROWS, AT = 300, 200
DAYS = pd.bdate_range("2020-01-01", periods=ROWS)
SPLIT = "perhaps a split that was not adjusted"


def market(assets: int = 4, seed: int = 3) -> np.ndarray:
    """Prices that move by 1% a day; the second asset does not move into row AT."""
    moves = np.random.default_rng(seed).normal(0, 0.01, (ROWS, assets))
    moves[AT, 1] = 0
    return 50 * np.exp(np.cumsum(moves, axis=0))


def found(values: np.ndarray) -> list[Finding]:
    names = [f"A{j}" for j in range(values.shape[1])]
    frame = pd.DataFrame(values, index=DAYS, columns=names)
    return [f for f in findings(frame) if "one asset" not in f.message]


@pytest.mark.parametrize(
    ("factor", "ratio"), [(0.5, "1/2"), (2.0, "2"), (1 / 3, "1/3"), (1.5, "3/2"), (2 / 3, "2/3"),
                          (0.4, "2/5"), (10.0, "10"), (0.1, "1/10"), (0.01, "1/100"),
                          (0.502, "1/2"), (0.498, "1/2"), (0.505, "1/2"), (0.33, "1/3")],
)  # fmt: skip
@pytest.mark.parametrize("assets", [2, 4])
def test_splits(factor: float, ratio: str, assets: int):
    values = market(assets)
    assert found(values) == []
    values[AT:, 1] *= factor
    (split,) = found(values)
    assert (split.severity, split.row, split.column) == ("warning", AT, "A1")
    assert split.date == str(DAYS[AT])[:10]
    assert split.message.endswith(f"close to {ratio}: {SPLIT}")


def test_a_split_of_the_only_asset_and_one_in_the_last_row():
    values = market()
    values[AT:, 1] *= 0.5
    assert SPLIT in found(values[:, 1:2])[0].message
    names = list("ABCD")
    said = findings(pd.DataFrame(values[: AT + 1], index=DAYS[: AT + 1], columns=names))
    assert [f.row for f in said if SPLIT in f.message] == [AT]


def crash(values: np.ndarray) -> None:
    """The market halves, and half of the assets by exactly one half."""
    values[AT:] *= np.array([0.52, 0.5, 0.47, 0.5])


def flash_crash(values: np.ndarray) -> None:
    values[AT] *= 0.5


def doubling(values: np.ndarray) -> None:
    """A takeover, not a split."""
    values[AT:, 1] *= 1.97


def bad_news(values: np.ndarray) -> None:
    """A fall by far more or less than a usual day beside a split."""
    values[AT:, 1] *= 0.55
    values[AT + 50 :, 2] *= 0.45


def slow_return(values: np.ndarray) -> None:
    """A squeeze that fades over many rows is a price that was paid."""
    values[AT : AT + 40, 1] *= np.exp(np.linspace(1.0, 0, 40))


def penny_stock(values: np.ndarray) -> None:
    """Prices of a few cents, of which the next one up is half as much again."""
    cents = np.random.default_rng(0).integers(-1, 2, ROWS).cumsum()
    values[:, 1] = np.round(0.01 * (2 + np.abs(cents) % 6), 2)


def thin_penny_stock(values: np.ndarray) -> None:
    """The same after years at a higher price, which make its usual move small."""
    values[:, 1] = np.round(np.concatenate([np.linspace(9, 8, AT), np.full(ROWS - AT, 0.03)]), 2)
    values[AT + 20 :, 1] = 0.06


@pytest.mark.parametrize(
    "change", [crash, flash_crash, doubling, bad_news, slow_return, penny_stock, thin_penny_stock]
)
def test_jumps_that_are_no_splits(change: Callable[[np.ndarray], None]):
    values = market()
    change(values)
    assert [
        f.message for f in found(values) if f.severity == "warning" and "times" in f.message
    ] == []


def test_other_jumps_are_counted_in_a_note():
    values = market()
    values[AT:, 1] *= 1.97
    values[100:, 2] *= 0.7
    (note,) = found(values)
    assert (note.severity, note.row, note.column) == ("note", AT, "A1")
    assert note.message.startswith("2 large moves that neither other assets nor a split explain")
    assert "is 1.97 times the one before" in note.message


@pytest.mark.parametrize(
    ("factor", "rows", "said"),
    [
        (10.0, 1, "is 10 times the one before and goes back in the next row"),
        (0.1, 1, "is 0.1 times the one before and goes back in the next row"),
        (100.0, 2, "is 100 times the one before and goes back 2 rows later"),
        (2.0, 2, "is 2 times the one before and goes back 2 rows later"),
        (0.55, 3, "is 0.55 times the one before and goes back 3 rows later"),
    ],
)
def test_bad_ticks(factor: float, rows: int, said: str):
    values = market()
    values[AT : AT + rows, 1] *= factor
    (tick,) = found(values)  # the way back is no finding of its own
    assert (tick.severity, tick.row, tick.column) == ("warning", AT, "A1")
    assert tick.message.startswith(f"the price {said}: perhaps a wrong price")
    misplaced = tick.message.endswith("price, a digit or the decimal mark misplaced")
    assert misplaced == (factor in (10.0, 0.1, 100.0))
    assert "empty the cell and choose missing='forward-fill'" in tick.advice


def test_a_lost_zero():
    """105.30 becomes 15.30, which is no power of ten."""
    values = market()
    values[AT, 1] = values[AT - 1, 1] * 15.3 / 105.3
    (tick,) = found(values)
    assert "goes back in the next row" in tick.message


@pytest.mark.parametrize(
    ("factor", "ratio"),
    [(1.034 / 4, "1/4"), (0.95 / 3, "1/3"), (1.03 / 2, None), (0.981 / 2, "1/2"), (1.0131e2, "100"),
     (9.949, "10"), (0.0103, "1/100"), (3.1, "3"), (0.102, "1/10"), (2.04, None), (0.69, None)],
)  # fmt: skip
def test_a_split_on_a_day_on_which_the_price_also_moved(factor: float, ratio: str | None):
    """The further a ratio is from usual moves, the further the price may be from it."""
    values = market()
    values[AT:, 1] *= factor
    (move,) = found(values)
    assert (move.severity, move.row, move.column) == ("warning" if ratio else "note", AT, "A1")
    assert not ratio or move.message.endswith(f"close to {ratio}: {SPLIT}")
    assert ("pence to pounds" in move.advice) == (ratio in ("10", "100", "1/10", "1/100"))
    assert not ratio or move.advice.endswith("if the price did move like this, leave it.")


@pytest.mark.parametrize("factor", [17.0, 35.0, 250.0])
def test_a_rise_that_nothing_explains(factor: float):
    values = market()
    values[AT:, 1] *= factor
    (move,) = found(values)
    assert (move.severity, move.row, move.column) == ("warning", AT, "A1")
    assert "which neither other assets nor a usual split explain: perhaps a wrong" in move.message


@pytest.mark.parametrize("factor", [1.97, 0.7, 0.22, 0.55])
def test_a_large_move_in_the_last_month_is_about_to_be_traded(factor: float):
    values = market()
    values[AT:, 1] *= factor
    (note,) = found(values)
    assert note.severity == "note"
    for last in (1, 21, 22):
        names = list("ABCD")
        table = pd.DataFrame(values[: AT + last], index=DAYS[: AT + last], columns=names)
        (move,) = findings(table)
        assert move.severity == ("note" if last == 22 else "warning")
        assert (move.row, move.date) == (AT, str(DAYS[AT])[:10])


def test_of_other_jumps_five_are_named_and_all_are_in_the_cells():
    values = market(12)
    for j in range(7):
        before, now = values[20 * j + 19 : 20 * j + 21, j]
        values[20 * (j + 1) :, j] *= (0.72 - 0.005 * j) * before / now
    (note,) = found(values)
    assert note.message.startswith("7 large moves")
    assert "the largest: the price on" in note.message
    dates = [str(DAYS[20 * (j + 1)])[:10] for j in range(7)]
    for j in (5, 4, 3, 2):
        assert f"'A{j}' on {dates[j]} ({0.72 - 0.005 * j:.4g})" in note.message
    assert note.message.endswith(") and 2 more")
    assert note.count == 7
    assert [cell["column"] for cell in note.cells] == [f"A{j}" for j in (6, 5, 4, 3, 2, 1, 0)]
    assert [cell["date"] for cell in note.cells] == dates[::-1]
    assert [cell["row"] for cell in note.cells] == [20 * (j + 1) for j in (6, 5, 4, 3, 2, 1, 0)]


def test_a_tick_in_a_crash_and_a_split_after_a_tick():
    values = market()
    values[AT] *= 0.8
    values[AT, 1] = values[AT - 1, 1] * 10
    values[AT + 10 :, 2] *= 0.5 * values[AT + 9, 2] / values[AT + 10, 2]
    tick, split = found(values)
    assert (tick.row, tick.column, "goes back" in tick.message) == (AT, "A1", True)
    assert (split.row, split.column, SPLIT in split.message) == (AT + 10, "A2", True)


def test_the_default_table_has_no_bad_ticks_and_one_ratio_of_a_split():
    """Through the crises of 2000 and 2008; a third of a price is a doubtful move in any case."""
    (split,) = map(str, findings(severity="warning"))
    assert split.startswith("row 69 (1990-04-10), column 'RRC': the price is 0.3332 times")


@pytest.mark.parametrize(
    ("factor", "rows", "said"),
    [(10, 1, "prices that may be wrong"), (0.5, ROWS, "moves that may be splits")],
)
def test_of_many_the_latest_are_named_and_the_others_counted(factor: float, rows: int, said: str):
    """The count has a date, so that allocate and follow show it if any counted one is new."""
    values = market(12)
    for j in range(12):
        start = 20 * (j + 1)
        factor_now = factor * values[start - 1, j] / values[start, j]
        values[start : start + rows, j] *= factor_now
    *named, more = found(values)
    assert [finding.column for finding in named] == [f"A{j}" for j in range(7, 12)]
    assert more.message == f"and 7 more {said}, the latest on this date"
    assert (more.date, more.count) == (str(DAYS[140])[:10], 7)
    assert [cell["column"] for cell in more.cells] == [f"A{j}" for j in range(7)]
    assert more.cells[-1]["date"] == more.date


def test_a_folder_has_no_rows_of_its_own(tmp_path: Path):
    values = market(4)
    for j in range(2):
        values[50 * (j + 1) :, j] *= 0.7
    for j in range(4):
        frame = pd.DataFrame({"close": values[:, j]}, index=DAYS).rename_axis("date")
        frame.to_csv(tmp_path / f"a{j}.csv")
    (note,) = findings(tmp_path)
    assert note.count == 2
    assert [cell["row"] for cell in note.cells] == [None, None]
    assert note.row is None
