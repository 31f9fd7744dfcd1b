import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices.table import load

from tables import findings

DAYS = [f"2020-01-0{d}" for d in range(1, 9)]


def table(path):
    rows = [f"{day},{100 + i},{50 - i}" for i, day in enumerate(DAYS)]
    path.write_text("\n".join(["date,A,B", *rows]))
    return path


def test_a_number_holds_from_its_date_until_the_next(tmp_path):
    prices = table(tmp_path / "prices.csv")
    rate = tmp_path / "bills.csv"
    rate.write_text("date,rate\n2020-01-05,0.03\n2019-12-31,0.01\n2020-01-07,0.02\n")
    loaded = load(prices, columns=[f"bills={rate}"])
    assert loaded.market_names == ("bills",)
    assert loaded.market[:, 0].tolist() == [0.01] * 4 + [0.03] * 2 + [0.02] * 2
    assert loaded.assets == ("A", "B")


def test_the_dates_may_come_last(tmp_path):
    rate = tmp_path / "bills.csv"
    for text in (
        "rate,date\n0.01,2020-01-01\n", "other,bills,date\n7,0.01,2020-01-01\n",
        "day,bills,time\n2020-01-01,0.01,16:00\n", ",bills,timestamp\n7,0.01,2020-01-01\n",
    ):  # fmt: skip
        rate.write_text(text)
        loaded = load(table(tmp_path / "prices.csv"), columns=[f"bills={rate}"])
        assert (loaded.market == 0.01).all()


def test_later_numbers_change_no_earlier_row(tmp_path):
    prices, rate = table(tmp_path / "prices.csv"), tmp_path / "bills.csv"
    found = []
    for last in (0.02, 0.9):
        rate.write_text(f"date,rate\n2019-12-31,0.01\n2020-01-06,{last}\n")
        found.append(load(prices, columns=[f"bills={rate}"]).market[:, 0])
    assert np.flatnonzero(found[0] != found[1]).tolist() == [5, 6, 7]


def test_a_folder_of_prices_takes_a_series_once(tmp_path):
    folder = tmp_path / "prices"
    folder.mkdir()
    for name in "AB":
        rows = [f"{day},{100 + i}" for i, day in enumerate(DAYS)]
        (folder / f"{name}.csv").write_text("\n".join(["date,close", *rows]))
    rate = tmp_path / "bills.csv"
    rate.write_text("date,other,bills\n2020-01-01,7,0.01\n")
    loaded = load(folder, columns=[f"bills={rate}"])
    assert loaded.assets == ("A", "B")
    assert (loaded.market == 0.01).all()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("date,rate\n2020-01-02,0.01\n", "begins on 2020-01-02, after the prices"),
        ("date,rate\n2020-01-01,high\n", "column 'rate'"),
        ("date,rate\n2020-01-01,0.1\n2020-01-01,0.2\n", "appears twice"),
        ("date,one,two\n2020-01-01,0.1,0.2\n", "call a column 'bills'"),
    ],
)
def test_what_is_wrong_with_a_series_is_said(tmp_path, text, said):
    rate = tmp_path / "bills.csv"
    rate.write_text(text)
    with pytest.raises(QfolioError, match=said):
        load(table(tmp_path / "prices.csv"), columns=[f"bills={rate}"])


@pytest.mark.parametrize(
    ("months", "said"),
    [
        (["2020-03", "2020-04", "2020-05"], []),  # about two months ago
        (["2019-10", "2019-11", "2019-12", "2020-01"], ["2020-06-29"]),
        (["2019-10"], []),  # one number for all rows
    ],
)
def test_a_series_that_has_long_ended_is_named(tmp_path, months, said):
    """On days up to 2020-06-29."""
    prices = tmp_path / "prices.csv"
    days = np.datetime64("2020-03-01") + np.arange(121)
    rows = [f"{day},{100 + i % 7},{50 + i % 3}" for i, day in enumerate(days)]
    prices.write_text("\n".join(["date,A,B", *rows]))
    rate = tmp_path / "bills.csv"
    rate.write_text("\n".join(["date,rate", *(f"{month}-01,0.01" for month in months)]))
    found = [each for each in findings(prices, "warning", columns=[f"bills={rate}"])
             if "bills" in each.message]  # fmt: skip
    assert [each.date for each in found] == said
    if said:
        assert found[0].message == "'bills' is still that of 2020-01-01, the last in 'bills.csv'"
