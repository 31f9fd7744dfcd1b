"""How many rows a year has, from the dates alone."""

import numpy as np
import pandas as pd
import pytest

from qfolio.portfolio.prices.frequency import alike, periods_per_year


@pytest.mark.parametrize(
    ("frequency", "expected"),
    [("B", 252), ("D", 365), ("W", 52), ("ME", 12), ("QE", 4), ("YE", 1), ("2D", 182.625)],
)
def test_days_and_longer(frequency: str, expected: float):
    assert periods_per_year(days(pd.date_range("2001-01-01", periods=40, freq=frequency))) == (
        expected
    )


def test_bars_of_sessions():
    """From 9:30 to 16:00 there are 79 closes, five minutes apart; one session has no nights."""
    session = pd.date_range("2024-03-04 09:30", "2024-03-04 16:00", freq="5min")
    assert periods_per_year(days(session)) == 79 * 252
    week = np.concatenate([days(session + pd.Timedelta(days=k)) for k in range(5)])
    assert periods_per_year(week) == 79 * 252
    half_day = np.concatenate([week, days(session[:43] + pd.Timedelta(days=7))])
    assert periods_per_year(half_day) == 79 * 252


def test_bars_around_the_clock():
    assert periods_per_year(days(pd.date_range("2024-03-04", periods=24 * 14, freq="h"))) == (
        24 * 365
    )


@pytest.mark.parametrize(
    ("week", "expected"),
    [
        ("Sun Mon Tue Wed Thu", 252),  # Riyadh, and Tel Aviv until 2025
        ("Sat Sun Mon Tue Wed", 252),  # Tehran
        ("Mon Tue Wed Thu Fri Sat", 313),  # New York until 1952
        ("Sun Mon Tue Wed Thu Fri Sat", 365),
    ],
)
def test_weeks_that_include_a_day_of_the_weekend(week: str, expected: float):
    dates = pd.bdate_range("2001-01-01", periods=2000, freq="C", weekmask=week)
    assert periods_per_year(days(dates)) == expected
    bars = np.concatenate([days(dates + pd.Timedelta(hours=k)) for k in (10, 11, 12)])
    assert periods_per_year(np.sort(bars)) == 3 * expected


def days(index: pd.DatetimeIndex) -> np.ndarray:
    return index.to_numpy("datetime64[s]")


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (252, 252, True), (252, 365, True), (283, 252, True), (252, 52, False), (52, 12, False),
        (12, 4, False), (365, 730, False), (252, 98_280, False),
        (98_280, 504, True),  # a part of a day has as many bars as it is long
    ],
)  # fmt: skip
def test_frequencies_that_are_alike(one, other, same):
    assert alike(one, other) is alike(other, one) is same
