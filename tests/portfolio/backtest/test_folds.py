import time
from itertools import pairwise

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.folds import (
    latest,
    overdue,
    parse_length,
    require_fold,
    spell,
    spell_all,
    walk_forward,
)

DAYS = np.arange("2000-01-01", "2010-01-01", dtype="datetime64[D]")


@pytest.mark.parametrize("lag", [0, 1, 3])
@pytest.mark.parametrize("expanding", [False, True])
def test_returns_follow_each_other_and_training_ends_before_the_first_decision(lag, expanding):
    folds = walk_forward(DAYS, "5y", "1y", lag, expanding)
    assert [fold.name for fold in folds] == [f"{year}-01-01" for year in range(2005, 2010)]
    for fold in folds:
        # The last reward in training is known when the first decision is made.
        assert fold.train.stop - 1 == fold.decisions.start
        first_return = fold.decisions.start + lag + 1
        assert str(DAYS[first_return]) == fold.name
        assert (fold.train.start == 0) == (expanding or fold is folds[0])
    for fold, following in pairwise(folds):
        assert fold.decisions.stop == following.decisions.start
    # The last decision earns the last row of the table.
    assert folds[-1].decisions.stop - 1 + lag + 1 == len(DAYS) - 1


def test_rolling_training_keeps_its_length():
    folds = walk_forward(DAYS, "500d", "100d", 1)
    assert {fold.train.stop - fold.train.start for fold in folds[1:]} == {501}
    assert {fold.days for fold in folds[:-1]} == {100}


def test_calendar_lengths():
    leap = np.array(["2000-02-29", "2000-03-31", "2001-02-28", "2001-03-01"], "datetime64[D]")
    folds = walk_forward(leap, "1y", "1y", 0)
    assert folds[0].name == "2001-02-28"
    assert latest("x", DAYS, "1m").train == slice(len(DAYS) - 32, len(DAYS))
    assert latest("x", DAYS, "10d").train == slice(len(DAYS) - 11, len(DAYS))
    assert latest("x", DAYS, "1m", expanding=True).train == slice(0, len(DAYS))


@pytest.mark.parametrize(("months", "rows"), [(1, 12), (3, 4)])
def test_a_year_of_last_trading_days_has_all_its_months(months, rows):
    following = np.datetime64("1983-02") + np.arange(0, 480, months).astype("m8[M]")
    dates = np.busday_offset(following.astype("M8[D]"), -1, roll="forward")
    folds = walk_forward(dates, "5y", "1y", 1, expanding=False)
    lengths = [fold.days for fold in folds]
    assert lengths == [rows] * 35
    assert {fold.train.stop - fold.train.start for fold in folds[1:]} == {5 * rows + 1}


@pytest.mark.parametrize("test", ["1m", "3m", "1y", "2y"])
@pytest.mark.parametrize("months", [1, 3, 12])
@pytest.mark.parametrize("offset", [-1, 0, 14])  # the last day of trading, the first, the 15th
def test_a_whole_fold_of_months_is_one_whatever_their_length(offset, months, test):
    """Walking forward, the next fold begins right after it."""
    following = np.datetime64("1983-02") + np.arange(0, 80 * months, months).astype("m8[M]")
    later = np.timedelta64(max(offset, 0), "D")
    dates = np.busday_offset(following.astype("M8[D]") + later, min(offset, 0), "forward")
    for first in range(12):
        some = dates[first:]
        fold = walk_forward(some, "3y", test, 0)[0]
        end = fold.decisions.stop + 1  # the row after its last return
        require_fold(some[:end], "3y", test, 0)
        if fold.days > 1:
            with pytest.raises(QfolioError, match="fewer than train=3y and one fold of test="):
                require_fold(some[: end - 1], "3y", test, 0)


@pytest.mark.parametrize(
    ("learned", "test", "last", "due"),
    [
        ("2024-01-31", "1y", "2025-01-30", False),
        ("2024-01-31", "1y", "2025-01-31", True),
        ("2024-01-31", "5d", "2024-02-04", False),
        ("2024-01-31", "5d", "2024-02-05", True),
        ("2019-12-31", "1y", "2020-12-30", False),  # before the table begins
    ],
)
def test_a_policy_is_overdue_after_a_whole_test(learned, test, last, due):
    end = np.datetime64(last) + np.timedelta64(1, "D")
    dates = np.arange("2020-01-01", end, dtype="datetime64[D]")
    assert overdue(np.datetime64(learned), test, dates) == due


def test_months_are_due_though_their_last_trading_days_come_early():
    """November's is the 28th, less than a month after the 31st of October."""
    dates = np.array(["2025-08-29", "2025-09-30", "2025-10-31", "2025-11-28"], "datetime64[D]")
    assert overdue(dates[-2], "1m", dates)
    assert not overdue(dates[-1], "1m", dates)


def test_folds_within_a_day_have_names_of_their_own():
    hours = np.arange("2020-01-01T00", "2020-02-01T00", dtype="datetime64[h]")
    folds = walk_forward(hours, "300d", "9d", 1)
    assert len({fold.name for fold in folds}) == len(folds) > 40
    assert folds[0].name == "2020-01-13-120000"


def test_an_asset_is_tradable_once_the_last_stretch_covers_it():
    values = np.ones((len(DAYS), 2))
    values[400:, 1] = 2.0
    values[:400, 1] = np.nan
    for expanding in (False, True):
        folds = walk_forward(DAYS, "365d", "100d", 1, expanding)
        starts = [fold.recent.start for fold in folds]
        traded = [bool(fold.tradable(values)[1]) for fold in folds]
        assert traded == [start >= 400 for start in starts]
        assert any(traded)
        assert not all(traded)


@pytest.mark.parametrize("length", ["", "y", "0y", "-1y", "5 years", "1e3d", "٣y"])
def test_lengths_that_are_none(length):
    with pytest.raises(QfolioError, match="like 5y"):
        parse_length(length)


def test_rows_of_a_length_may_be_minutes():
    assert parse_length("120000d") == (120_000, "d")


@pytest.mark.parametrize("length", ["10y", "999999999y", "999999999w", "999999999d"])
def test_a_table_that_is_too_short(length):
    with pytest.raises(QfolioError, match="nothing to test"):
        walk_forward(DAYS, length, "1y", 1)


def test_all_dates_of_a_long_table_are_spelled_at_once() -> None:
    """One by one, each would look at the whole table: minutes for 100,000 rows."""
    minutes = np.datetime64("2020-01-01T09:30") + np.arange(100_000, dtype="m8[m]")
    begun = time.process_time()
    texts = spell_all(minutes, minutes)
    assert time.process_time() - begun < 5
    assert texts[:2] == ["2020-01-01 09:30:00", "2020-01-01 09:31:00"]
    assert texts[-1] == spell(minutes[-1], minutes)
    assert spell_all(minutes[:1], minutes[::1440]) == ["2020-01-01"]


def test_training_is_longer_than_the_lag():
    for train, lag in (("3d", 3), ("1d", 0)):
        with pytest.raises(QfolioError, match=f"fewer than two rows .* with a lag of {lag};"):
            walk_forward(DAYS, train, "1y", lag)
