"""Whether a later table tells the history that the backtest has seen."""

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.desk.history import revisions
from qfolio.portfolio.prices.table import Prices

from tables import days, price_table, random_walk

KNOWN = random_walk(300, 3)
LATER = random_walk(330, 3)
LATER[:300] = KNOWN


def found(later, known=KNOWN, **more):
    return revisions(price_table(known), price_table(later, **more))


def dividend(values, row, share=0.02):
    """The prices before a row, adjusted for a dividend of this share."""
    adjusted = values.copy()
    adjusted[:row, 1] *= 1 - share
    return adjusted


@pytest.mark.parametrize(
    "later",
    [
        LATER, LATER * [0.25, 0.97, 1.0], LATER[100:], LATER[[*range(0, 290, 7), 299]],
        LATER.round(2), LATER.astype(np.float32), dividend(dividend(LATER, 50), 150),
        (LATER / 300).round(2),  # cents of a price near 0.17
        LATER * np.exp(random_walk(330, 3, seed=5, volatility=1e-3).round(9) / 5e4),
    ],
)  # fmt: skip
def test_the_same_history_is_no_news(later):
    rows = np.arange(330)
    if len(later) < 100:
        rows = np.array([*range(0, 290, 7), 299])
    elif len(later) < 300:
        rows = rows[100:]
    assert found(later, dates=days(330)[rows]) == []


def test_a_history_whose_prices_were_rounded_before_is_the_same():
    assert found(LATER / 300, (KNOWN / 300).round(2)) == []


@pytest.mark.parametrize("order", [[1, 0, 2], [1, 2, 0]])
def test_columns_that_were_exchanged_are_refused(order):
    names = ", ".join(name for j, name in zip(order, "ABC", strict=True) if "ABC"[j] != name)
    with pytest.raises(QfolioError, match=f"other returns than the backtest's for {names}, on mo"):
        found(LATER[:, order])


def test_an_asset_that_moves_much_like_another_is_refused_in_its_place():
    """Their correlation is 0.95."""
    common = random_walk(300, 1, seed=1, volatility=0.01)
    own = random_walk(300, 2, seed=2, volatility=0.0023)
    pair = common * own
    with pytest.raises(QfolioError, match="for A, B, on most"):
        found(pair[:, [1, 0]], pair)


def test_dates_that_are_one_row_off_are_refused():
    with pytest.raises(QfolioError, match=r"for A, B, C, on most .* each row its own date"):
        found(LATER[1:], dates=days(329))


def test_a_few_rows_in_common_do_not_tell_assets_apart():
    assert found(LATER[285:, [1, 0, 2]], dates=days(330)[285:]) == []
    assert found(LATER[:5], dates=days(5, "2030-01-01")) == []


def test_single_returns_that_differ_are_named_with_the_first_date():
    split, wrong = LATER.copy(), LATER.copy()
    split[200:, 1] /= 4
    wrong[100, 0] *= 1.3
    wrong[150:, 2] *= 1.06
    (one,) = found(split)
    assert str(one).startswith("2020-07-19, column 'B': the return is −7")
    assert str(one).endswith("% in the backtest's table")
    assert one.severity == "warning"
    first, second = found(wrong)
    assert str(first).startswith("2020-04-10, column 'A': the return is +")
    assert str(first).endswith(" in the backtest's table (the first of 2 that differ)")
    assert (second.column, second.date) == ("C", "2020-05-30")


def test_of_many_assets_five_are_named():
    known = random_walk(100, 8)
    later = known.copy()
    later[50] *= 2
    assert len(found(later, known)) == 6
    assert found(later, known)[-1].count == 3


def test_rows_without_a_price_are_not_compared():
    """C starts late in both; A has ended in the later table, at half its price."""
    late = KNOWN.copy()
    late[:280, 2] = np.nan
    listed = np.ones((330, 3), bool)
    listed[250:, 0] = False
    later = LATER.copy()
    later[:290, 2] = np.nan
    later[250:, 0] = later[249, 0] / 2
    ended = Prices(days(330), tuple("ABC"), later, listed=listed)
    assert revisions(price_table(late), ended) == []
