"""What goes in comes out, and what is wrong is named by row and column."""

import builtins
import pickle
from datetime import date
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices.findings import Finding
from qfolio.portfolio.prices.table import Prices, describe, load

from tables import findings

DAYS = ["2020-01-02", "2020-01-03", "2020-01-06", "2020-01-07", "2020-01-08"]
A = [10.0, 10.5, 10.25, 10.75, 11.0]
B = [20.0, 19.5, 20.25, 20.5, 19.75]


def frame(**columns: Any) -> pd.DataFrame:
    return pd.DataFrame(columns or {"A": A, "B": B}, index=pd.to_datetime(DAYS))


def csv(folder: Path, text: str | bytes, name: str = "prices.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def wide(**cells: str) -> str:
    """A sound CSV, in which cells such as A4 (column A, row 4 of a spreadsheet) are replaced."""
    rows = [["Date", "A", "B"]]
    rows += [[day, str(a), str(b)] for day, a, b in zip(DAYS, A, B, strict=True)]
    for place, text in cells.items():
        rows[int(place[1:]) - 1]["DAB".index(place[0])] = text
    return "\n".join(",".join(row) for row in rows) + "\n"


def errors(source: Any, **options: Any) -> list[Finding]:
    return findings(source, "error", **options)


def warnings(source: Any, **options: Any) -> list[Finding]:
    return findings(source, "warning", **options)


# What is read.


def test_every_way_in_gives_the_same_prices(tmp_path: Path):
    table = frame()
    expected = load(table)
    assert expected.assets == ("A", "B")
    np.testing.assert_array_equal(expected.values, np.column_stack([A, B]))
    assert expected.dates.dtype == "datetime64[s]"
    assert [str(day)[:10] for day in expected.dates] == DAYS

    indexed = table.rename_axis("Date")
    long = indexed.reset_index().melt("Date", var_name="Ticker", value_name="Adj Close")
    indexed.to_parquet(tmp_path / "wide.parquet")
    table.to_parquet(tmp_path / "unnamed.parquet")
    long.to_parquet(tmp_path / "long.pq")
    long.to_csv(tmp_path / "numbered.csv")  # with a column of row numbers
    sources = {
        "csv": csv(tmp_path, wide()),
        "path as text": str(csv(tmp_path, wide())),
        "column": indexed.reset_index(),
        "text index": pd.DataFrame({"A": A, "B": B}, index=DAYS),
        "days": pd.DataFrame({"when": [date.fromisoformat(d) for d in DAYS], "A": A, "B": B}),
        "decimals": frame(A=[Decimal(str(a)) for a in A], B=pd.array(B, dtype="Float64")),
        "texts": frame(A=[str(a) for a in A], B=B),
        "arrow": pa.Table.from_pandas(indexed),
        "parquet": tmp_path / "wide.parquet",
        "parquet, unnamed index": tmp_path / "unnamed.parquet",
        "long": long,
        "long, shuffled": long.iloc[[0, 5, 3, 9, 1, 8, 2, 4, 7, 6]],
        "long, levels": long.set_index(["Date", "Ticker"]),
        "long arrow": pa.Table.from_pandas(long, preserve_index=False),
        "long parquet": tmp_path / "long.pq",
        "long csv": tmp_path / "numbered.csv",
    }
    for name, source in sources.items():
        assert load(source).digest == expected.digest, name
        assert not errors(source), name
    assert load(expected) is expected


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + wide(),
        wide().encode("utf-16"),
        wide().replace("\n", "\r\n"),
        wide().replace(",", ";"),
        wide().replace(",", ";").replace(".", ","),
        wide().replace(",", "\t").replace(".", ","),
        wide().replace(",", ", "),
        "\n" + wide() + "\n,,\n\n",
        wide().replace("\n", ",\n"),
        wide(B2='"20.0"'),
        wide().replace("-", ""),
        wide().replace("-", "/"),
        wide(D2="2020-01-02 00:00:00+09:00", D3="2020-01-03T00:00:00+09:00",
             D4="2020-01-06T00:00:00+0900", D5="2020-01-07T00:00+09:00",
             D6="2020-01-08T00:00:00.000+09:00"),
    ],
    ids=["mark", "utf-16", "windows", "semicolon", "european", "tabs", "spaces", "blank lines",
         "last comma", "quoted", "digits", "slashes", "zones"],
)  # fmt: skip
def test_dialects_of_csv(tmp_path: Path, text: str | bytes):
    assert load(csv(tmp_path, text)).digest == load(frame()).digest


@pytest.mark.parametrize("pattern", ["%d/%m/%Y", "%m/%d/%Y", "%d.%m.%Y"])
def test_the_day_may_stand_first_where_the_column_shows_it(tmp_path: Path, pattern: str):
    days = pd.date_range("2020-01-10", periods=5)
    text = "date,A\n" + "".join(f"{day.strftime(pattern)},{k + 1}\n" for k, day in enumerate(days))
    np.testing.assert_array_equal(load(csv(tmp_path, text)).dates, days.to_numpy())
    early = text.replace("2020", "2020").splitlines()[:1] + [
        f"{d.strftime(pattern)},{k + 1}"
        for k, d in enumerate(pd.date_range("2020-01-01", periods=5))
    ]
    path = csv(tmp_path, "\n".join(early))
    if "." in pattern:  # as in monthly rows, of which each is the first of its month
        assert load(path).dates[-1] == np.datetime64("2020-01-05")
        return
    found = errors(path)
    assert len(found) == 5
    assert (found[0].row, found[0].column) == (2, "date")
    assert "no other row shows which number is the day" in found[0].message


@pytest.mark.parametrize(
    "pattern", ["%d-%b-%Y", "%d %B %Y", "%b %d, %Y", "%B %d %Y", "%d-%b-%Y 16:30"]
)
def test_months_may_have_names(tmp_path: Path, pattern: str):
    days = pd.date_range("2020-01-10", periods=12, freq="MS")
    text = "date;A\n" + "".join(f"{day.strftime(pattern)};{k + 1}\n" for k, day in enumerate(days))
    read = load(csv(tmp_path, text.upper())).dates.astype("datetime64[D]")
    np.testing.assert_array_equal(read, days.to_numpy("datetime64[D]"))
    for wrong in ("01-Foo-2020", "Ja 02, 2020", "31-Feb-2020", "1-Mayday-2020"):
        (found,) = errors(csv(tmp_path, text.replace(days[3].strftime(pattern), wrong)))
        assert found.row == 5


def test_an_hour_that_comes_twice_may_be_that_of_a_clock(tmp_path: Path):
    hours = ["2023-10-29 01:00", "2023-10-29 02:00", "2023-10-29 02:00", "2023-10-29 03:00"]
    (found,) = errors(csv(tmp_path, "date,A\n" + "".join(f"{hour},1\n" for hour in hours)))
    assert "write times in UTC if the clocks were set back" in found.advice
    (found,) = errors(csv(tmp_path, "date,A\n" + "".join(f"2023-10-{d},1\n" for d in (1, 2, 2, 3))))
    assert found.advice == "Remove one of the two rows."


def test_zones_name_a_day_or_become_utc():
    zoned = frame()
    zoned.index = zoned.index.tz_localize("Asia/Tokyo")
    assert load(zoned).digest == load(frame()).digest
    assert load(pa.Table.from_pandas(zoned.rename_axis("date"))).digest == load(frame()).digest
    download = zoned.copy()  # before the close of the last day
    download.index = [*zoned.index[:-1], zoned.index[-1].replace(hour=8, minute=30)]
    days = load(download).dates
    assert days.astype("datetime64[D]").astype(str).tolist() == DAYS
    assert str(days[-1]) == "2020-01-08T08:30:00"
    hourly = pd.date_range("2020-10-25", periods=5, freq="h", tz="Europe/Berlin")  # 2 a.m. twice
    prices = load(pd.DataFrame({"A": A}, index=hourly))
    assert str(prices.dates[0]) == "2020-10-24T22:00:00"
    assert (np.diff(prices.dates) == np.timedelta64(1, "h")).all()


def test_names_that_look_like_something_else(tmp_path: Path):
    text = "date,ticker,close\n" + "".join(
        f"{day},{name},{a}\n"
        for day, a in zip(DAYS, A, strict=True)
        for name in ("NA", "TRUE", "0700", "null", "<script>alert(1)</script>")
    )
    names = ("NA", "TRUE", "0700", "null", "<script>alert(1)</script>")
    assert load(csv(tmp_path, text)).assets == names
    numbered = frame(NAME=A, VALUE=B).rename_axis("date").reset_index()
    assert load(numbered).assets == ("NAME", "VALUE")  # wide: two assets of these names
    ids = pd.DataFrame({"date": DAYS * 2, "asset": [10001] * 5 + [10002] * 5, "price": A + B})
    assert load(ids).assets == ("10001", "10002")
    assert load(ids.rename(columns={"asset": "tic", "price": "close"})).assets == ("10001", "10002")


def test_adjusted_prices_come_before_plain_ones():
    long = pd.DataFrame({"date": DAYS, "symbol": "A", "Open": B, "Close": B, "adj_close": A})
    np.testing.assert_array_equal(load(long).values[:, 0], A)


def test_numbers_are_read_to_the_last_digit(tmp_path: Path):
    values = np.exp(np.random.default_rng(0).normal(size=500).cumsum() * 0.1)
    days = pd.date_range("2000-01-01", periods=500).strftime("%Y-%m-%d")
    text = "date,A\n" + "".join(f"{d},{v!r}\n" for d, v in zip(days, values.tolist(), strict=True))
    np.testing.assert_array_equal(load(csv(tmp_path, text)).values[:, 0], values)
    text = text.replace(",", ";").replace(".", ",")
    np.testing.assert_array_equal(load(csv(tmp_path, text)).values[:, 0], values)


def test_the_default_table_says_that_it_holds_survivors():
    prices = load()
    facts = describe(prices)
    assert (facts["rows"], facts["assets"]) == (8313, 20)
    assert (facts["first"], facts["last"]) == ("1990-01-02", "2022-12-28")
    assert facts["periods_per_year"] == 252
    assert "survivors" in facts["note"]
    assert "skfolio" in facts["source"]
    assert not errors(None)


# What is wrong is named.


@pytest.mark.parametrize(
    ("cells", "row", "column", "message"),
    [
        ({"A4": ""}, 4, "A", "the price is missing"),
        ({"A4": "n/a"}, 4, "A", "the price is missing"),
        ({"B3": "0"}, 3, "B", "the price is zero"),
        ({"B3": "-5"}, 3, "B", "the price is negative"),
        ({"A6": "inf"}, 6, "A", "the price is infinite"),
        ({"A6": "1e999"}, 6, "A", "the price is infinite"),
        ({"A2": "abc"}, 2, "A", "the price: 'abc' is not a number"),
        ({"A2": "True"}, 2, "A", "the price: 'True' is not a number"),
        ({"A2": "0x10"}, 2, "A", "the price: '0x10' is not a number"),
        ({"A2": "$"}, 2, "A", "the price: '$' is not a number"),
        ({"A2": "$5€"}, 2, "A", "the price: '$5€' is not a number"),
        ({"A2": '"$1,234"'}, 2, "A", "the price: '$1,234' may mean 1234 or 1.234"),
        ({"A2": "1_0"}, 2, "A", "the price: '1_0' is not a number"),
        ({"A2": '"1.234,5"'}, 2, "A", "the price: '1.234,5' has a decimal comma, other numbers"),
        ({"A2": '"1,234"'}, 2, "A", "the price: '1,234' may mean 1234 or 1.234"),
        ({"A2": '"10,5"'}, 2, "A", "the price: '10,5' has a decimal comma, other numbers have p"),
        ({"D5": ""}, 5, "Date", "the date is missing"),
        ({"D5": "soon"}, 5, "Date", "'soon' is not a date that can be read"),
        ({"D5": "01/07/20"}, 5, "Date", "'01/07/20' may have a year of two digits"),
        ({"D5": "2020-02-30"}, 5, "Date", "'2020-02-30' is not a date of the calendar"),
        ({"D5": "43837"}, 5, "Date", "'43837' is not a date that can be read"),
        ({"D5": "1578355200"}, 5, "Date", "'1578355200' is not a date that can be read"),
        ({"D5": "9999-01-01"}, 5, "Date", "'9999-01-01' lies outside the years 1678 to 2261"),
        ({"D5": "2020-01-07T16:00+01:00"}, 2, "Date", "'2020-01-02' has no time zone"),
        ({"D5": "2020-01-03"}, 5, "Date", "the date 2020-01-03 is already in row 3"),
        ({"D5": "2020-01-04"}, 5, "Date", "the date 2020-01-04 comes after a later one"),
        ({"A3": "1e9"}, 3, "A", "the price goes from 10 to 1e+09 in one row"),
    ],
)
def test_faults_are_named_by_row_and_column(
    tmp_path: Path, cells: dict[str, str], row: int, column: str, message: str
):
    path = csv(tmp_path, wide(**cells))
    found = errors(path)
    assert found, "nothing found"
    assert (found[0].row, found[0].column) == (row, column)
    assert found[0].message.startswith(message)
    assert f"row {row}" in str(found[0])
    with pytest.raises(QfolioError) as raised:
        load(path)
    assert str(raised.value).startswith(f"'prices.csv': row {row}")
    assert message in str(raised.value)
    assert found[0].advice in str(raised.value)


def test_a_fault_in_a_long_table_is_named_by_its_own_row(tmp_path: Path):
    def long(cell: str, more: str = "") -> Path:
        body = "".join(f"{d},A,{a}\n{d},B,{b}\n" for d, a, b in zip(DAYS, A, B, strict=True))
        return csv(tmp_path, "date,asset,price\n" + body.replace("20.25", cell) + more)

    (finding,) = errors(long("-1"))
    assert str(finding) == "row 7 (2020-01-06), column 'price': the price of 'B' is negative"
    (finding,) = errors(long(""))
    assert str(finding) == "row 7 (2020-01-06), column 'price': the price of 'B' is missing"
    (finding,) = errors(long("20.25", "2020-01-06,B,5\n"))
    assert (finding.row, finding.column) == (12, "asset")
    assert finding.message == "'B' on 2020-01-06 is already in row 7"
    (finding,) = errors(long("20.25", "2020-01-09,B,19\n"))  # A has no row on this day
    assert finding.message == "'A': there are no prices after 2020-01-08"
    (finding,) = errors(long("20.25", "2020-01-08,,19\n"))
    assert (finding.row, finding.column, finding.message) == (12, "asset", "the asset has no name")


def test_rows_of_a_data_frame_are_counted_from_zero():
    (finding,) = errors(frame(A=A, B=[20.0, 19.5, np.nan, 20.5, 19.75]))
    assert str(finding) == "row 2 (2020-01-06), column 'B': the price is missing"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("\n\n ", "is empty"),
        (b"\x89PNG\r\n\x1a\n\0\0", "is not UTF-8 text"),
        ("Sociét\xe9,A\n".encode("latin-1"), "is not UTF-8 text"),
        ("date\n2020-01-02\n", "only one column"),
        ("date,A,B\n", "the table has 0 rows; at least 3 are needed"),
        ("date,A\n2020-01-02,1\n", "the table has 1 row; at least 3 are needed"),
        (wide(B1="A"), "column 'A': the columns 2 and 3 have the same name"),
        (wide(B1=""), "column 3 has no name"),
        (wide(A4="1,2"), "row 4: there are 4 fields, but 3 column names"),
        (wide(A2="1,2"), "row 2: there are 4 fields, but 3 column names"),
        (wide().split("\n", 1)[1], "row 1: the first line holds values instead of column names"),
        ("1577836800000,7.1,7.2,7,7.1\n" * 3, "row 1: the first line holds values instead of"),
        (wide(A1="open", B1="high").replace("\n", ",1,1,1\n").replace("1,1,1", "low,close,v", 1),
         "'open', 'high', 'low', 'close' are columns of one asset, but there is also 'v'"),
        ("ticker,px\nA,1\nA,2\nA,3\n", "there is no column of dates"),
        ("day,ticker,px\n2020-01-02,A,1\n2020-01-03,A,2\n2020-01-06,A,3\n",
         "column 'ticker': holds names of assets, but no column is called price or close"),
        ("Datum,Fonds,Wert\n2020-01-02,A,1\n2020-01-02,B,2\n2020-01-03,A,1\n2020-01-03,B,2\n",
         "column 'Fonds': holds names, and dates repeat, as in a table with a row for each date"),
        ("day,A,B\n2020-01-02,'1,5',x\n2020-01-02,'1,6',y\n2020-01-03,'1,7',z\n".replace("'", '"'),
         "column 'B': holds names, and dates repeat"),
        (wide().replace("10", "x").replace("11", "x"), "column 'A': there are no numbers: 'x.0'"),
        ("date,A\n2020-01-03,1\n2020-01-02,2\n2020-01-02,3\n2020-01-01,3\n",
         "row 3, column 'date': the date 2020-01-02 is already in row 4"),
    ],
)  # fmt: skip
def test_tables_that_cannot_be_prices(tmp_path: Path, text: str | bytes, message: str):
    with pytest.raises(QfolioError) as raised:
        load(csv(tmp_path, text))
    assert message in str(raised.value)


def test_sources_that_are_no_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Bomb:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "executed",))

    sources: list[tuple[Any, str]] = [
        (csv(tmp_path, pickle.dumps(Bomb()), "p.pkl"), "export it as CSV"),
        (csv(tmp_path, pickle.dumps(Bomb()), "p.csv"), "is not UTF-8 text"),
        (csv(tmp_path, pickle.dumps(Bomb()), "p.parquet"), "is damaged or not a Parquet file"),
        (csv(tmp_path, "", "p.xlsx"), "export it as CSV"),
        (tmp_path, "'p.csv' is not UTF-8 text"),  # of a folder's tables the first
        (tmp_path / "none.csv", "No such file or directory"),
        (tmp_path / ("x" * 999 + ".csv"), "cannot be read"),
        ("a\0.csv", "cannot be read"),
        (42, "not as int"),
        (np.ones((5, 2)), "not as ndarray"),
        (pd.DataFrame(), "there is no column of dates"),
        (pd.DataFrame({"A": A, "B": B}), "there is no column of dates"),
        (pd.concat({"US": frame(), "EU": frame()}, axis=1), "neither level names a kind of price"),
        (pd.concat({"x": pd.concat({"y": frame()}, axis=1)}, axis=1), "names on 3 levels"),
        (frame().set_axis(["A", "A"], axis=1), "the columns 2 and 3 have the same name"),
    ]
    for source, message in sources:
        with pytest.raises(QfolioError) as raised:
            load(source)
        assert message in str(raised.value)
        assert "\n" not in str(raised.value)
    assert not (tmp_path / "executed").exists()

    original = builtins.__import__

    def without_pyarrow(name: str, *rest: Any) -> Any:
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_pyarrow)
    with pytest.raises(QfolioError, match=r'pip install "qfolio\[parquet\]"'):
        load(tmp_path / "p.parquet")


def test_parquet_with_repeated_names(tmp_path: Path):
    table = pa.table([pa.array(DAYS), pa.array(A), pa.array(B)], names=["date", "A", "A"])
    pq.write_table(table, tmp_path / "p.parquet")
    with pytest.raises(QfolioError, match="columns 2 and 3 have the same name"):
        load(tmp_path / "p.parquet")


def test_many_faults_are_counted_not_listed():
    table = pd.DataFrame(-np.ones((200, 60)), index=pd.date_range("2020-01-01", periods=200))
    found = errors(table)
    assert len(found) == 6
    assert sum(finding.count for finding in found) == 12_000
    assert "11,995 more prices" in str(found[-1])
    with pytest.raises(QfolioError, match=r"; and 11,998 more\. Give prices, not returns\."):
        load(table)


def test_unknown_choices_and_columns():
    with pytest.raises(QfolioError, match="missing is 'backward-fill'; did you mean forward-fill"):
        load(frame(), missing="backward-fill")
    with pytest.raises(QfolioError, match="late is 'never'"):
        findings(frame(), late="never")
    with pytest.raises(QfolioError, match=r"no column 'volumes' \(did you mean 'volume'"):
        load(frame(A=A, volume=B), features=("volumes",))
    with pytest.raises(QfolioError, match="no column 'day'"):
        load(frame(), date="day")
    with pytest.raises(QfolioError, match="there is no asset 'C'"):
        load(frame()).select(["C"])


# Gaps.


def test_forward_fill_takes_the_last_known_price():
    nan = np.nan
    table = frame(A=[10.0, nan, nan, 10.75, 11.0], B=[20.0, 19.5, 20.25, 20.5, nan])
    filled = load(table, missing="forward-fill").values
    np.testing.assert_array_equal(filled[:, 0], [10, 10, 10, 10.75, 11])
    np.testing.assert_array_equal(filled[:, 1], [20, 19.5, 20.25, 20.5, 20.5])
    note, last, *_ = warnings(table, missing="forward-fill")
    assert note.message.startswith("filled forward: 3 missing prices; the longest gap is of 'A'")
    assert note.date == last.date == "2020-01-08"
    assert last.message == "the last row has no price of 'B', and takes an earlier one"
    (note, *others) = warnings(table[["A"]], missing="forward-fill")
    assert note.date == "2020-01-06"  # the latest that was filled
    assert not any("the last row" in other.message for other in others)
    with pytest.raises(QfolioError, match="the price is missing"):
        load(table)


def test_forward_fill_never_looks_ahead():
    """Later prices may change in every way: what comes before stays as it was."""
    rng = np.random.default_rng(1)
    for _ in range(30):
        values = rng.uniform(1, 2, (20, 4))
        values[rng.random(values.shape) < 0.3] = np.nan
        values[[0, -1]] = 1.5
        days = pd.date_range("2020-01-01", periods=20)
        cut = int(rng.integers(3, 19))
        changed = values.copy()
        changed[cut:-1] = np.where(rng.random((19 - cut, 4)) < 0.5, np.nan, 1.7)
        before, after = (
            load(pd.DataFrame(v, index=days, columns=list("ABCD")), missing="forward-fill")
            for v in (values, changed)
        )
        known, still = (table.dates < days[cut].to_datetime64() for table in (before, after))
        np.testing.assert_array_equal(before.values[known], after.values[still])


def test_rows_without_any_number_are_left_out():
    """Calendars and exports write holidays, and a day that is not over, as empty rows."""
    table = frame(A=A, B=[20.0, 20.5, 20.25, 20.5, 19.75])
    table.iloc[[1, 4], :] = np.nan
    assert str(warnings(table)[0]) == (
        "2020-01-08: left out: 2 rows without any number, from 2020-01-03 to this date"
    )
    prices = load(table)
    np.testing.assert_array_equal(prices.dates, table.index[[0, 2, 3]].to_numpy())
    np.testing.assert_array_equal(prices.values[:, 1], [20.0, 20.25, 20.5])
    newest_first = load(table[::-1])
    np.testing.assert_array_equal(newest_first.values, prices.values)
    table.iloc[1, 1] = 20.5
    with pytest.raises(QfolioError, match=r"2020-01-03.*column 'A': the price is missing"):
        load(table)


def test_assets_with_gaps_are_dropped_on_demand():
    table = frame(A=A, B=[20.0, np.nan, 20.25, 20.5, 19.75], C=[np.nan] * 5)
    prices = load(table, missing="drop-asset")
    assert prices.assets == ("A",)
    assert "left out, because prices are missing: 'B', 'C' (2 assets)" in str(
        warnings(table, missing="drop-asset")[0]
    )
    with pytest.raises(QfolioError, match="column 'C': there are no prices at all"):
        load(table, missing="forward-fill")
    with pytest.raises(QfolioError, match="no asset is left"):
        load(table[["B", "C"]], missing="drop-asset")


@pytest.mark.parametrize("late", ["error", "drop-asset", "join", "trim"])
def test_an_asset_that_is_dropped_does_not_say_where_the_table_starts(late):
    nan = np.nan
    table = frame(
        A=[*A[:3], nan, A[4]], B=[nan, nan, *B[2:]], C=[nan, nan, *B[2:]], rate=[nan, nan, 1, 1, 1]
    )
    prices = load(table, missing="drop-asset", late=late, features=("rate",))
    assert prices.assets == ("B", "C")
    assert len(prices) == len(A) - 2


@pytest.mark.parametrize("name", ["cash", "Cash", "CASH", "<CASH>"])
def test_no_asset_may_be_called_cash(name: str):
    """Weights and holdings have money under this name."""
    table = frame(A=A, **{name: B})
    long = table.rename_axis("date").reset_index().melt("date", var_name="asset")
    for source, advice in ((table, "its column"), (long, "Rename or remove it")):
        with pytest.raises(QfolioError, match=f"the asset '{name}' has the name of the money"):
            load(source)
        assert advice in errors(source)[0].advice
    assert load(frame(A=A, cashmere=B)).assets == ("A", "cashmere")
    assert load(table, features=(name,)).assets == ("A",)


def test_late_assets_need_a_choice():
    nan = np.nan
    table = frame(A=A, B=[nan, nan, *B[2:]])
    with pytest.raises(QfolioError, match="'B': the first price is on 2020-01-06, the table"):
        load(table)
    with pytest.raises(QfolioError, match="'B': the first price"):
        load(table, missing="forward-fill")  # no fill can make it up
    assert load(table, late="drop-asset").assets == ("A",)
    trimmed = load(table, late="trim")
    assert len(trimmed) == 3
    np.testing.assert_array_equal(trimmed.values, np.column_stack([A[2:], B[2:]]))
    joined = load(table, late="join")
    np.testing.assert_array_equal(joined.values[:, 1], [nan, nan, *B[2:]])
    np.testing.assert_array_equal(joined.first_rows, [0, 2])
    np.testing.assert_allclose(joined.relatives[:, 1], [nan, nan, B[3] / B[2], B[4] / B[3]])
    assert describe(joined)["late_assets"] == 1
    with pytest.raises(QfolioError, match="there are no prices after 2020-01-06"):
        load(frame(A=A, B=[*B[:3], nan, nan]), late="join")  # an early end is a gap
    with pytest.raises(QfolioError, match="the table keeps 2 rows"):
        load(frame(A=A, B=[nan, nan, nan, *B[3:]]), late="trim")


def test_rows_before_all_prices_are_left_out():
    table = frame(A=[np.nan, *A[1:]], B=[np.nan, *B[1:]])
    assert len(load(table)) == 4
    assert warnings(table)[0].message == "left out at the start: 1 row without prices"


# Features.


def test_features_of_the_market_and_of_assets():
    rate = [0.1, 0.2, 0.3, 0.4, 0.5]
    market = load(frame(A=A, rate=rate, B=B), features=("rate",))
    assert market.assets == ("A", "B")
    assert market.feature_names == ("rate",)
    np.testing.assert_array_equal(market.features[:, :, 0], np.column_stack([rate, rate]))

    long = frame().rename_axis("date").reset_index().melt("date", var_name="asset")
    long["volume"] = np.arange(10.0)
    long["beta"] = 1.0
    prices = load(long, features=["beta", "volume"])
    np.testing.assert_array_equal(prices.features[:, :, 0], np.ones((5, 2)))
    np.testing.assert_array_equal(prices.features[:, 1, 1], np.arange(5.0, 10))
    part = prices.select(["B"]).between(1, 3)
    assert part.features[:, 0, 1].tolist() == [6, 7]
    assert part.values[:, 0].tolist() == B[1:3]


def test_features_must_be_finite():
    nan = np.nan
    table = frame(A=A, rate=[nan, 1.0, nan, 2.0, np.inf])
    found = errors(table, features=("rate",))
    assert [(f.row, f.message) for f in found] == [
        (4, "the feature is infinite"), (0, "the feature is missing"), (2, "the feature is missing")
    ]  # fmt: skip
    table = frame(A=A, rate=[1.0, nan, nan, 2.0, nan])
    filled = load(table, features=("rate",), missing="forward-fill")
    np.testing.assert_array_equal(filled.features[:, 0, 0], [1, 1, 1, 2, 2])
    with pytest.raises(QfolioError, match="the feature is missing"):
        load(table, features=("rate",), missing="drop-asset")  # the market cannot be dropped
    table = frame(A=A, rate=[nan, 1.0, 1.0, 1.0, 1.0])
    with pytest.raises(QfolioError, match="the feature is missing"):
        load(table, features=("rate",), missing="forward-fill")  # nothing known before


# What looks odd.


def test_wild_assets_have_no_splits():
    """A move of −50% is nothing special where every move is as large."""
    values = np.where(np.arange(300) % 2, 1.0, 2.0)[:, None]
    table = pd.DataFrame(values, index=pd.bdate_range("2020-01-01", periods=300), columns=["A"])
    assert [f.message for f in warnings(table)] == ["there is only one asset, 'A'"]


def test_holes_in_the_calendar():
    days = pd.bdate_range("2020-01-01", periods=200).delete(range(100, 110))
    table = pd.DataFrame({"A": range(1, 191), "B": range(191, 1, -1)}, index=days)
    (found,) = warnings(table)
    assert found.row == 100
    assert "15 days earlier" in found.message
    assert [f.message for f in warnings(table[:40])] == [
        "the table has only 40 rows, too few to learn from"
    ]


# The container.


def test_prices_keep_their_rules():
    days = np.array(DAYS, dtype="datetime64[D]")
    values = np.column_stack([A, B])
    prices = Prices(days, ("A", "B"), values)
    assert prices.features.shape == (5, 2, 0)
    np.testing.assert_allclose(prices.relatives[:2, 0], [1.05, 10.25 / 10.5])
    with pytest.raises(ValueError, match="read-only"):
        prices.values[0, 0] = 1
    values[0, 0] = 99  # the caller's array is the caller's
    assert prices.values[0, 0] == 10
    bad = values.copy()
    bad[3, 0] = np.nan
    for broken, said in (
        (lambda: Prices(days[::-1], ("A", "B"), values), "dates must increase"),
        (lambda: Prices(days, ("A", "A"), values), "must not repeat"),
        (lambda: Prices(days, ("A",), values), "do not fit 5 dates, 1 assets"),
        (lambda: Prices(days, ("A", "B"), -values), "prices must be finite and positive"),
        (lambda: Prices(days, ("A", "B"), bad), "prices must be finite and positive"),
        (
            lambda: Prices(days, ("A", "B"), values, np.full((5, 2, 1), np.nan), ("f",)),
            "features must be finite",
        ),
    ):
        with pytest.raises(QfolioError, match=said):
            broken()


def test_the_digest_tells_content_apart():
    prices = load(frame())
    others = [
        load(frame(A=A, C=B)),
        load(frame(B=B, A=A)),
        load(frame(A=A, B=[*B[:-1], B[-1] + 1e-12])),
        prices.between(1, None),
        load(frame(A=A, B=B, f=A), features=("f",)),
    ]
    assert len({prices.digest, *(p.digest for p in others)}) == 6
    assert load(prices.to_frame()).digest == prices.digest


# Hostile tables.

CELLS: list[Any] = [
    1.0, 2.5, 1e308, 1e-308, 5e-324, 0.0, -1.0, np.nan, np.inf, -np.inf, None, "", "1", "1,5", "x",
    "1e400", True, Decimal("1.5"), Decimal("sNaN"), 10**400, 2**70, 1j, b"1", [1], {}, (1, 2),
    np.datetime64("2020-01-01"), pd.NaT, pd.NA, pd.Timestamp("2020-01-01", tz="UTC"),
    date(2020, 1, 1), "\n", "\u202e", "<script>alert(1)</script>", "[red]", "=1+1", "٣",
]  # fmt: skip
NAMES: list[Any] = [
    "A", "B", "A", "", None, 0, "<img src=x onerror=alert(1)>", "date", "Date", "price", "close",
    "asset", "name", "a\nb", "[red]", "\ud800", "Unnamed: 0", "index", np.nan, "volume",
]  # fmt: skip


def hostile_frame(rng: np.random.Generator) -> pd.DataFrame:
    """A small table, most of it sound, with a few things that are not."""
    rows, columns = int(rng.choice([0, 2, 3, 5, 8])), int(rng.integers(0, 6))
    days = list(pd.date_range("2020-01-01", periods=rows))
    data: list[list[Any]] = [days, *rng.uniform(1, 2, (columns, rows)).tolist()]
    names: list[Any] = ["date", *"ABCDE"[:columns]]
    for _ in range(int(rng.choice([0, 1, 1, 3]))):
        j = int(rng.integers(len(data)))
        if rng.random() < 0.3:
            names[j] = NAMES[rng.integers(len(NAMES))]
        elif rows:
            data[j][int(rng.integers(rows))] = CELLS[rng.integers(len(CELLS))]
    series = {k: pd.Series(cells, dtype=None if rng.random() < 0.5 else object)
              for k, cells in enumerate(data)}  # fmt: skip
    table = pd.DataFrame(series)
    if columns and rng.random() < 0.3:
        table = table.melt(0, var_name="asset")
        other = NAMES[rng.integers(len(NAMES))]
        labels = [other if rng.random() < 0.02 else f"asset {k}" for k in table["asset"]]
        table["asset"] = pd.Series(labels, dtype=object)
        return table.rename(columns={0: "date"}).sample(frac=1, random_state=int(rng.integers(99)))
    return table.set_axis(pd.Index(names, dtype=object), axis=1)


def hostile_text(rng: np.random.Generator) -> bytes:
    """A CSV with some bytes changed, or no CSV at all."""
    if rng.random() < 0.2:
        return rng.integers(0, 256, int(rng.integers(0, 200)), dtype=np.uint8).tobytes()
    text = bytearray(wide().encode())
    alphabet = b"0123456789,;.-\"'\n\r\t xeE+/\xff\x00"
    for _ in range(int(rng.integers(1, 4))):
        place = int(rng.integers(len(text)))
        text[place : place + int(rng.integers(0, 3))] = bytes(
            rng.choice(list(alphabet), int(rng.integers(0, 3))).tolist()
        )
    return bytes(text)


def failures(source: Any, **options: Any) -> list[Any]:
    try:
        return errors(source, **options)
    except QfolioError as error:
        return [error]


def outcome(source: Any, **options: Any) -> Prices | None:
    """Prices whose rules hold, or None after a clear error; anything else fails the test."""
    try:
        prices = load(source, **options)
    except QfolioError as error:
        message = str(error)
        assert 10 < len(message) < 1000
        assert message.isprintable(), message
        assert "Traceback" not in message
        assert "object at 0x" not in message
        assert failures(source, **options)
        return None
    assert not failures(source, **options)
    joined = options.get("late") == "join"
    assert joined or np.isfinite(prices.values).all()
    relatives = prices.relatives[~np.isnan(prices.relatives)]
    assert (np.isfinite(relatives) & (relatives > 0)).all()
    assert (np.diff(prices.dates) > np.timedelta64(0, "s")).all()
    assert len(set(prices.assets)) == prices.values.shape[1] > 0
    assert all(isinstance(name, str) and name for name in prices.assets)
    assert len(prices.digest) == 16
    return prices


def survive(seed: int, tables: int, folder: Path) -> int:
    rng = np.random.default_rng(seed)
    read = 0
    path = folder / "hostile.csv"
    for _ in range(tables):
        options = {
            "missing": str(rng.choice(["error", "drop-asset", "forward-fill"])),
            "late": str(rng.choice(["error", "drop-asset", "trim", "join"])),
        }
        if changed := rng.random() < 0.2:
            options["returns"] = str(rng.choice(["percent", "fraction"]))
            options["columns"] = str(rng.choice(["A", "B", "asset"]))
        if rng.random() < 0.5:
            path.write_bytes(hostile_text(rng))
            read += outcome(path, **options) is not None
            continue
        table = hostile_frame(rng)
        prices = outcome(table, **options)
        if prices is None:
            continue
        read += 1
        names = [str(name).strip() for name in table.columns]
        if (
            not changed
            and options["missing"] != "forward-fill"
            and set(prices.assets) <= set(names)
        ):
            for j, name in enumerate(prices.assets):
                given = [float(c) for c in table.iloc[:, names.index(name)] if usable(c)]
                kept = prices.values[:, j]
                assert kept[~np.isnan(kept)].tolist() == given[-len(kept) :]
    return read


def usable(cell: Any) -> bool:
    """True where a number stands."""
    text = str(cell).strip().lower()
    return isinstance(cell, float | int | Decimal | str) and text not in ("", "nan", "snan")


def test_hostile_tables(tmp_path: Path):
    assert survive(seed=0, tables=700, folder=tmp_path) > 80  # so both ends are reached


@pytest.mark.slow
def test_more_hostile_tables(tmp_path: Path):
    assert survive(seed=1, tables=2_500, folder=tmp_path) > 300


def test_five_thousand_columns(tmp_path: Path):
    rng = np.random.default_rng(0)
    values = rng.uniform(1, 2, (4, 5000))
    days = pd.date_range("2020-01-01", periods=4)
    table = pd.DataFrame(values, index=days, columns=[f"asset {j}" for j in range(5000)])
    np.testing.assert_array_equal(load(table).values, values)
    table.to_csv(tmp_path / "p.csv")
    np.testing.assert_array_equal(load(tmp_path / "p.csv").values, values)
    table.iloc[2] = -1.0
    with pytest.raises(QfolioError, match="4,998 more"):
        load(table)


def test_a_long_table_that_is_nearly_empty_takes_no_memory():
    count = 20_000
    days = pd.date_range("1900-01-01", periods=count)
    table = pd.DataFrame({"date": days, "asset": [f"a{k}" for k in range(count)], "price": 1.0})
    with pytest.raises(QfolioError, match="nearly all are missing"):
        load(table)
