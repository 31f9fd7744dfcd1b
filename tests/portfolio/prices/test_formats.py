"""Exports as programs write them: read to the last digit, or refused with what to do."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices.table import Prices, inspect, load

from tables import findings

DAYS = pd.bdate_range("2024-01-29", periods=4)
ISO = [f"{day:%Y-%m-%d}" for day in DAYS]


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "prices.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(path: Path) -> str:
    with pytest.raises(QfolioError) as raised:
        load(path)
    return str(raised.value)


def attempt(path: Path, **options: Any) -> Prices | str:
    """The prices, or why they are refused; any other error is the caller's."""
    try:
        return load(path, **options)
    except QfolioError as error:
        return str(error)


def notes(path: Path) -> list[str]:
    return [str(finding) for finding in findings(path, "note")]


# Whole tables: a random one in each format.

Cells = list[list[str]]
Writer = Callable[[pd.DatetimeIndex, list[str], Cells], str | bytes]
STOOQ = "<TICKER>,<PER>,<DATE>,<TIME>,<OPEN>,<HIGH>,<LOW>,<CLOSE>,<VOL>,<OPENINT>"


def rows(first: list[str], cells: Cells, mark: str = ",") -> str:
    return "".join(mark.join([day, *row]) + "\n" for day, row in zip(first, cells, strict=True))


def head(label: str, names: list[str], mark: str = ",") -> str:
    return mark.join([label, *names]) + "\n"


def comma(cells: Cells) -> Cells:
    """European: 1.234,50."""
    swap = str.maketrans(",.", ".,")
    return [[cell.translate(swap) for cell in row] for row in cells]


def plain(cells: Cells) -> Cells:
    return [[cell.replace(",", "") for cell in row] for row in cells]


def stooq(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
    lines = [
        f"{name}.US,D,{day:%Y%m%d},000000,9,9,9,{row[j]},100,0"
        for j, name in enumerate(names)
        for day, row in zip(days, plain(cells), strict=True)
    ]
    return "\n".join([STOOQ, *lines])


def bloomberg(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
    blanks = "," * len(names)
    above = f"Start Date,01/13/2024{blanks}\nEnd Date,12/31/2024{blanks}\n,{blanks}\n"
    titles = head("", [f"{name} US Equity" for name in names])
    titles += head("Dates", ["PX_LAST"] * len(names))
    return above + titles + rows([f"{day:%m/%d/%Y}" for day in days], plain(cells))


def security(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
    titles = head("Security", [f"{name} US Equity" for name in names])
    titles += "Start Date,1/2/2024\nPeriod,D\nCurrency,USD\n\n"
    titles += head("Date", ["Last Price"] * len(names))
    return titles + rows([f"{day:%Y-%m-%d}" for day in days], plain(cells))


def european(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
    return head("Datum", names, ";") + rows([f"{d:%d.%m.%Y}" for d in days], comma(cells), ";")


def excel(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> bytes:
    """Excel's declared separator, serial dates, and Unicode text."""
    serial = [str((day - pd.Timestamp("1899-12-30")).days) for day in days]
    text = "sep=;\n" + head("Date", names, ";") + rows(serial, comma(plain(cells)), ";")
    return text.replace("\n", "\r\n").encode("utf-16")


def american(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
    quoted = [[f'"{cell}"' for cell in row] for row in cells]
    return head("Date", names) + rows([f"{day:%m/%d/%Y}" for day in days], quoted)


def unix(factor: int) -> Writer:
    def write(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
        seconds = [str(int(day.timestamp()) * factor) for day in days]
        return head("timestamp", names) + rows(seconds, plain(cells))

    return write


def turned(days: pd.DatetimeIndex, names: list[str], cells: Cells) -> str:
    columns = [list(column) for column in zip(*plain(cells), strict=True)]
    return head("Ticker", [f"{day:%Y-%m-%d}" for day in days]) + rows(names, columns)


WRITERS: dict[str, Writer] = {
    "stooq": stooq, "bloomberg": bloomberg, "security": security, "european": european,
    "excel": excel, "american": american, "unix": unix(1), "milliseconds": unix(1000),
    "turned": turned,
}  # fmt: skip


def sample(rng: np.random.Generator) -> tuple[pd.DatetimeIndex, list[str], Cells]:
    """Dates, names and cells such as 1,234.50; a column has its own size and decimals."""
    count, assets = int(rng.integers(3, 9)), int(rng.integers(1, 5))
    days = pd.bdate_range("2024-01-10", periods=count) + pd.Timedelta(days=7 * rng.integers(500))
    columns = []
    for _ in range(assets):
        sizes = 10 ** rng.uniform(-1, 6) * rng.uniform(0.8, 1.2, count)
        decimals = int(rng.choice([0, 1, 2, 2, 3, 4]))
        columns.append([f"{max(size, 1):,.{decimals}f}" for size in sizes])
    return days, [f"A{j}" for j in range(assets)], [list(row) for row in zip(*columns, strict=True)]


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_read_is_what_was_written(tmp_path: Path, name: str):
    """Random tables: exactly the numbers and dates that were written, or a refusal."""
    rng = np.random.default_rng(7)
    read = 0
    for _ in range(40):
        days, names, cells = sample(rng)
        path = write(tmp_path, WRITERS[name](days, names, cells))
        prices = attempt(path)
        if isinstance(prices, str):
            # A decimal mark or a group of thousands, or which number is the day.
            assert " may mean " in prices or "the day" in prices
            continue
        read += 1
        np.testing.assert_array_equal(prices.values, np.array(plain(cells), dtype=float))
        np.testing.assert_array_equal(prices.dates, days.to_numpy("datetime64[s]"))
        assert [asset.split(" ")[0].removesuffix(".US") for asset in prices.assets] == names
    assert read >= (10 if name in ("european", "american", "excel") else 25)


def mutated(rng: np.random.Generator, text: bytes) -> bytes:
    """The bytes with a few of them replaced, removed, or repeated elsewhere."""
    content = bytearray(text)
    alphabet = b"0123456789,;.-\"'\n\r\t xeE+/\xff\x00=%"
    for _ in range(int(rng.integers(1, 3))):
        place, length = int(rng.integers(len(content) + 1)), int(rng.integers(0, 12))
        fresh = bytes(rng.choice(list(alphabet), int(rng.integers(0, 4))).tolist())
        if rng.random() < 0.3:
            start = int(rng.integers(len(content) + 1))
            fresh = bytes(content[start : start + 30])
        content[place : place + length] = fresh
    return bytes(content)


def test_damaged_exports_are_read_or_refused(tmp_path: Path):
    """1,000 mutations of all formats; anything but a QfolioError fails the test."""
    rng = np.random.default_rng(11)
    read = 0
    for k in range(1000):
        writer = list(WRITERS.values())[k % len(WRITERS)]
        text = writer(*sample(rng))
        path = write(tmp_path, mutated(rng, text if isinstance(text, bytes) else text.encode()))
        prices = attempt(path, missing="forward-fill", late="join")
        assert isinstance(prices, Prices) or (len(prices) > 10 and "\n" not in prices)
        read += isinstance(prices, Prices)
    assert read > 50  # so both ends are reached


# Each of them.


def test_stooq_by_the_minute(tmp_path: Path):
    times = ["153000", "153500", "154000"]
    lines = [f"AAPL.US,5,20240131,{time},1,1,1,{k}.5,9,0" for k, time in enumerate(times, 1)]
    prices = load(write(tmp_path, "\n".join([STOOQ, *lines])))
    assert prices.assets == ("AAPL.US",)
    assert [str(day) for day in prices.dates] == [f"2024-01-31T15:{m}:00" for m in (30, 35, 40)]
    metatrader = "<DATE>\t<TIME>\t<OPEN>\t<HIGH>\t<LOW>\t<CLOSE>\t<TICKVOL>\n"
    metatrader = metatrader.replace("<TICKVOL>", "<VOL>")
    metatrader += "".join(f"2024.01.31\t{h}:30:00\t1\t1\t1\t2\t9\n" for h in (15, 16, 17))
    assert str(load(write(tmp_path, metatrader)).dates[1]) == "2024-01-31T16:30:00"


def test_a_security_of_bloomberg_with_several_fields(tmp_path: Path):
    text = "Security,AAPL US Equity\nStart Date,1/2/2024\n\nDate,PX_LAST,PX_VOLUME\n"
    text += rows(ISO, [["1.5", "100"], ["1.6", "#N/A N/A"], ["1.7", "90"], ["1.8", "80"]])
    path = write(tmp_path, text)
    assert load(path).assets == ("AAPL US Equity",)
    assert "left out: 'AAPL US Equity PX_VOLUME'" in notes(path)[0]
    prices = load(path, features=("PX_VOLUME",), missing="forward-fill")
    assert prices.features[:, 0, 0].tolist() == [100, 100, 90, 80]
    assert "row 6 (2024-01-30), column 'AAPL US Equity PX_LAST': the price is negative" in refusal(
        write(tmp_path, text.replace("1.6", "-1.6"))
    )


def test_bloomberg_with_a_column_of_dates_for_each_asset(tmp_path: Path):
    text = "Start Date,1/2/2024,,\n,AAPL US Equity,,MSFT US Equity\nDate,PX_LAST,Date,PX_LAST\n"
    text += "".join(f"{day},1,{day},2\n" for day in ISO)
    said = refusal(write(tmp_path, text.replace("\n,AAPL", "\nAAPL").replace(",,MSFT", ",,MSFT")))
    assert "Give one column of dates for all assets, or one file for each asset" in said


def test_numbers_in_groups_of_thousands(tmp_path: Path):
    text = "date;A;B\n" + rows(ISO, [["1.234,50", "7"]] * 3 + [["1.250", "8"]], ";")
    prices = load(write(tmp_path, text))
    assert prices.values[:, 0].tolist() == [1234.5, 1234.5, 1234.5, 1250]
    for group in ("'", "’", " ", "\u00a0", "\u202f"):
        text = "date;A\n" + rows(ISO, [[f"1{group}234{group}567,25"]] * 4, ";")
        assert load(write(tmp_path, text)).values[0, 0] == 1234567.25


def test_points_that_may_be_either(tmp_path: Path):
    """A column of 1.234 beside decimal commas, and a whole table of them."""
    cells = [["1.234", "12,5"]] * 4
    said = refusal(write(tmp_path, "date;A;B\n" + rows(ISO, cells, ";")))
    assert "column 'A': there are no numbers: '1.234' may mean 1234 or 1.234" in said
    assert "write its numbers as 1234.5" in said
    cells = [["1.234", "900"], ["1.250", "905"], ["1.270", "903"], ["1.290", "901"]]
    for mark in ";\t|":
        said = refusal(write(tmp_path, f"date{mark}A{mark}B\n" + rows(ISO, cells, mark)))
        assert "'1.234' may mean 1234 or 1.234, and no other number tells which" in said
        assert "leave such points out if they mark thousands" in said
        assert "separate the columns by commas if they mark decimals" in said
        whole = f"date{mark}A{mark}B\n" + rows(ISO, cells, mark).replace(".", "")
        assert load(write(tmp_path, whole)).values[0].tolist() == [1234, 900]
    text = "date,A,B\n" + rows(ISO, cells)
    assert load(write(tmp_path, text)).values[0].tolist() == [1.234, 900]
    cells[0][1] = "900.5"
    text = "date;A;B\n" + rows(ISO, cells, ";")
    assert load(write(tmp_path, text)).values[0].tolist() == [1.234, 900.5]


@pytest.mark.parametrize("first", ["sep=;", '"sep=;"', "SEP=;", "sep=;;"])
def test_a_declared_separator(tmp_path: Path, first: str):
    text = f"{first}\r\ndate;A\r\n" + rows(ISO, [["1,5"], ["2,5"], ["-1"], ["2"]], ";")
    assert "row 5 (2024-01-31), column 'A': the price is negative" in refusal(write(tmp_path, text))


@pytest.mark.parametrize(
    ("cells", "name", "first"),
    [
        (["45320", "45321", "45322", "45323"], "Excel's serial numbers", "2024-01-29T00:00:00"),
        (["45320.6875", "45321.6875", "45322.6875", "45323.6875"], "Excel's serial numbers",
         "2024-01-29T16:30:00"),
        (["1706545800", "1706632200", "1706718600", "1706805000"], "Unix seconds",
         "2024-01-29T16:30:00"),
        (["-86400000", "0", "1000000000", "1706805000"], None, ""),
        (["1706545800123", "1706632200123", "1706718600123", "1706805000123"],
         "Unix milliseconds", "2024-01-29T16:30:00"),
        (["1706545800", "1706632200", "1706718600000", "1706805000000"], None, ""),
        (["20240129", "20240130", "1706718600", "1706805000"], None, ""),
        (["19751", "19752", "19753", "19754"], None, ""),  # days since 1970, or of 1954 in Excel
        (["1", "2", "3", "4"], None, ""),
    ],
)  # fmt: skip
def test_dates_that_are_numbers(tmp_path: Path, cells: list[str], name: str | None, first: str):
    path = write(tmp_path, "Date,A\n" + rows(cells, [["1"], ["2"], ["3"], ["4"]]))
    if name is None:
        said = refusal(path)
        assert "is not a date that can be read" in said
        assert "Write dates as 2020-01-31" in said
        return
    assert str(load(path).dates[0]) == first
    assert notes(path) == [f"column 'Date': dates are read as {name}"]
    frame = pd.read_csv(path)  # as numbers
    assert load(frame).digest == load(path).digest
    # Without the name they may be prices.
    assert "Name it 'date'" in refusal(write(tmp_path, path.read_text().replace("Date", "X")))


def test_nanoseconds_of_a_data_frame():
    frame = pd.DataFrame({"date": DAYS.as_unit("ns").astype("int64"), "A": [1.0, 2, 3, 4]})
    np.testing.assert_array_equal(load(frame).dates, DAYS.to_numpy("datetime64[s]"))


def test_faults_of_a_turned_table_are_named_where_they_are(tmp_path: Path):
    def table(cells: Cells, days: list[str] = ISO) -> Path:
        return write(tmp_path, head("Ticker", days) + rows(["AAPL", "MSFT"], cells))

    said = refusal(table([["1", "2", "3", "4"], ["1", "2", "-3", "4"]]))
    assert "row 3 (2024-01-31), column '2024-01-31': the price is negative" in said
    said = refusal(table([["1", "2", "3", "4"], ["1", "", "x", "4"]]))
    assert "row 3 (2024-01-31), column '2024-01-31': the price: 'x' is not a number" in said
    said = refusal(table([["1", "2", "3", "4"]] * 2, [*ISO[:3], ISO[1]]))
    assert f"column '{ISO[1]}': the date {ISO[1]} is already in column '{ISO[1]}'" in said
    newest = table([["1", "2", "3", "4"]] * 2, ISO[::-1])
    assert load(newest).values[:, 0].tolist() == [4, 3, 2, 1]
    assert "the newest column comes first" in notes(newest)[0]
    named = head("Ticker,Name", ISO) + rows(["AAPL,Apple", "MSFT,Microsoft"], [["1"] * 4] * 2)
    assert "but also the column 'Name'; keep one column of assets" in refusal(
        write(tmp_path, named)
    )
    frame = pd.DataFrame([[1.0, 2, 3, 4]], index=["AAPL"], columns=DAYS)
    assert load(frame).values[:, 0].tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize(
    "above",
    [
        "Data of a vendor\n\n",
        "Prices, returns, volumes, and\nothers\n",
        "\na;b;c;d\n",
        "Title,,\n;;\nPrices,,\n",
    ],
)
@pytest.mark.parametrize(("mark", "point"), [(",", "."), (";", ","), ("\t", ".")])
def test_lines_above_the_table(tmp_path: Path, above: str, mark: str, point: str):
    cells = [["1.25", "2.5"], ["1.5", "2.75"], ["1.75", "3.5"]]
    lines = [mark.join(row).replace(".", point) for row in cells]
    body = f"date{mark}A{mark}B\n" + "".join(
        f"{day}{mark}{line}\n" for day, line in zip(ISO[:3], lines, strict=True)
    )
    path = write(tmp_path, above + body)
    np.testing.assert_array_equal(load(path).values, np.array(cells, float))
    count = above.count("\n") + 1
    assert f"the lines above row {count} are left out" in notes(path)
    wrong = write(tmp_path, above + body.replace(f"{ISO[1]}{mark}1", f"{ISO[1]}{mark}x"))
    assert f"row {count + 2} (" in refusal(wrong)


@pytest.mark.parametrize("blank", ["\n", ",,\n", "\n\n"])
def test_blank_lines_below_a_title(tmp_path: Path, blank: str):
    """They end the table only above other text, not below the names or among the rows."""
    some, more = rows(ISO[:2], [["1", "2"]] * 2), rows(ISO[2:], [["3", "4"]] * 2)
    path = write(tmp_path, f"Title\ndate,A,B\n{blank}{some}{blank}{more}{blank}Source: vendor\n")
    np.testing.assert_array_equal(load(path).values, [[1, 2], [1, 2], [3, 4], [3, 4]])
    assert ": 'Source: vendor' …" in notes(path)[0]


def test_lines_above_that_hide_the_names(tmp_path: Path):
    text = "Data of a vendor\n\ndate,A\nday,euro\n" + rows(ISO, [["1"]] * 4)
    assert "remove the lines above the names of the columns" in refusal(write(tmp_path, text))


FRENCH = """This file was created using the 202312 CRSP database, in percent.
It contains value- and equal-weighted returns for 3 industry portfolios.

Missing data are indicated by -99.99 or -999.

  Average Value Weighted Returns -- Monthly
      ,Agric,Food ,Soda
{}

  Average Equal Weighted Returns -- Monthly
      ,Agric,Food ,Soda
192607,   1.00,   1.00,   1.00
192608,   1.00,   1.00,   1.00

Copyright 2023
"""


def test_tables_of_kenneth_french(tmp_path: Path):
    """The first table of several below sentences, with months and marks of missing returns."""
    months = [f"{1926 + k // 12}{k % 12 + 1:02d}" for k in range(6, 30)]
    returns = [[1.0, -2.0, -999 if k < 3 else 0.5] for k in range(24)]
    returns[2][2] = -99.99
    lines = [f"{m}," + ",".join(f"{x:7.2f}" for x in row)
             for m, row in zip(months, returns, strict=True)]  # fmt: skip
    path = write(tmp_path, FRENCH.format("\n".join(lines)))
    prices, findings = inspect(path, returns="percent", late="join")
    assert prices is not None
    assert prices.assets == ("Agric", "Food", "Soda")
    assert prices.dates[[0, -1]].astype("datetime64[D]").astype(str).tolist() == [
        "1926-07-01", "1928-06-01",
    ]  # fmt: skip
    np.testing.assert_allclose(prices.relatives[3:], [[1.01, 0.98, 1.005]] * 20)
    assert prices.first_rows.tolist() == [0, 0, 2]
    said = [finding.message for finding in findings if finding.severity == "note"]
    assert said[0] == (
        "the lines above row 7 are left out, and so is what follows the blank row 32: "
        "'Average Equal Weighted Returns -- Monthly' …"
    )
    assert said[1].startswith("3 returns of −99.99 or −999 percent, which mark missing ones")


@pytest.mark.parametrize(
    "days",
    [
        [f"2001{k:02d}" for k in range(1, 12)],  # months of 2001 or days of January 2020
        [f"20{k:02d}01" for k in range(1, 13)] + ["210101"],  # years, or the first of each month
        [f"2001{k:02d}" for k in range(1, 14)],  # days, since there is no month 13
    ],
)
def test_six_digits_that_may_be_days(tmp_path: Path, days: list[str]):
    path = write(tmp_path, "date,A\n" + rows(days, [["1"]] * len(days)))
    assert "is not a date that can be read" in refusal(path)


# Folders.


def bars(folder: Path, name: str, closes: list[str], days: list[str] = ISO) -> None:
    """A file of one asset, as Stooq has it."""
    text = "Date,Open,High,Low,Close,Volume\n"
    text += rows(days, [["9", "9", "9", close, f"10{k}"] for k, close in enumerate(closes)])
    (folder / name).write_text(text)


def test_a_folder_of_one_file_an_asset(tmp_path: Path):
    bars(tmp_path, "aapl.us.csv", ["1", "2", "3", "4"])
    bars(tmp_path, "msft.us.csv", ["5", "6", "7", "8"])
    (tmp_path / "notes.md").write_text("not a table")
    prices = load(tmp_path, features=("Volume",))
    assert prices.assets == ("aapl.us", "msft.us")
    assert prices.source == tmp_path.name
    np.testing.assert_array_equal(prices.values, [[1, 5], [2, 6], [3, 7], [4, 8]])
    np.testing.assert_array_equal(prices.features[:, 1, 0], [100, 101, 102, 103])
    bars(tmp_path, "late.csv", ["2", "3", "4"], ISO[1:])
    assert "'late': the first price is on 2024-01-30, the table starts" in refusal(tmp_path)
    assert load(tmp_path, late="trim").assets == ("aapl.us", "late", "msft.us")
    bars(tmp_path, "late.csv", ["2", "3", "4"], [ISO[0], *ISO[2:]])
    assert "2024-01-30, column 'close': the price of 'late' is missing" in refusal(tmp_path)
    assert load(tmp_path, missing="forward-fill").values[1, 1] == 2


def test_gaps_of_a_folder_are_treated_in_the_joined_table(tmp_path: Path):
    bars(tmp_path, "a.csv", ["1", "2", "3", "4"])
    bars(tmp_path, "b.csv", ["5", "6", "7", ""])
    bars(tmp_path, "c.csv", ["8", "7", "8", "9"])
    assert "column 'close': 'b': there are no prices after 2024-01-31" in refusal(tmp_path)
    assert load(tmp_path, missing="drop-asset").assets == ("a", "c")
    filled = load(tmp_path, missing="forward-fill")
    assert filled.values[-1].tolist() == [4, 7, 9]
    assert "the last row has no price of 'b', and takes an earlier one" in filled.note
    ended = load(tmp_path, ended="cash-out")
    assert ended.listed is not None
    assert ended.listed[-1].tolist() == [True, False, True]
    bars(tmp_path, "b.csv", [""] * 4)
    assert "'b': there are no prices at all" in refusal(tmp_path)


def test_rows_without_any_number_in_a_folder_are_left_out(tmp_path: Path):
    for name, late in (("A", "2"), ("B", "")):
        text = f"date,{name}\n" + rows(ISO, [["1"], ["2"], [""], [late]])
        (tmp_path / f"{name}.csv").write_text(text)
    prices, found = inspect(tmp_path, missing="forward-fill")
    assert prices is not None
    assert prices.values[:, 1].tolist() == [1, 2, 2]
    said = "2024-01-31: left out: 1 row without any number; the latest has this date"
    assert said in [str(each) for each in found]


def test_a_folder_has_the_warnings_of_its_files(tmp_path: Path):
    bars(tmp_path, "a.csv", ["1", "2", "3", "4"])
    text = "date,ticker,close,currency\n" + rows(
        ISO, [["B", "1", "USD"], ["B", "2", "EUR"], ["B", "3", "USD"], ["B", "4", "USD"]]
    )
    (tmp_path / "b.csv").write_text(text)
    said = [str(each) for each in inspect(tmp_path)[1]]
    assert "column 'currency': in 'b.csv': there are several currencies: EUR and USD" in said
    assert sum("currencies" in each for each in said) == 1


def test_the_files_of_a_folder_have_one_currency(tmp_path: Path):
    for name, sign in (("a", "$"), ("b", "€")):
        bars(tmp_path, f"{name}.csv", [f"{sign}{price}" for price in (1, 2, 3, 4)])
    assert "prices are in several currencies: $ and €" in refusal(tmp_path)


def test_currency_codes_of_a_folder_are_compared(tmp_path: Path):
    for name, code in (("A", "USD"), ("B", "EUR")):
        text = "date,ticker,close,currency\n" + rows(ISO, [[name, p, code] for p in "1234"])
        (tmp_path / f"{name}.csv").write_text(text)
    said = [str(each) for each in inspect(tmp_path)[1]]
    assert "column 'currency': there are several currencies: EUR and USD" in said


def test_files_of_an_asset_may_overlap_where_one_of_them_is_empty(tmp_path: Path):
    for name, prices in (("old", ["1", "2", "", ""]), ("new", ["", "", "3", "4"])):
        (tmp_path / f"{name}.csv").write_text("date,A\n" + rows(ISO, [[p] for p in prices]))
    assert load(tmp_path).values[:, 0].tolist() == [1, 2, 3, 4]


def test_a_folder_of_returns(tmp_path: Path):
    for name in ("A", "B"):
        text = f"date,{name}\n" + rows(ISO, [["-0.5"], ["1.5"], ["-1.0"], ["2.0"]])
        (tmp_path / f"{name}.csv").write_text(text)
    prices = load(tmp_path, returns="percent")
    assert prices.assets == ("A", "B")
    np.testing.assert_allclose(prices.values[:, 0], 100 * np.cumprod([1, 1.015, 0.99, 1.02]))


def test_faults_in_a_folder(tmp_path: Path):
    assert "is a folder without tables" in refusal(tmp_path)
    bars(tmp_path, "a.csv", ["1", "2", "3", "4"])
    bars(tmp_path, "b.csv", ["1", "2", "-3", "4"])
    assert "'b.csv': row 4 (2024-01-31), column 'Close': the price is neg" in refusal(tmp_path)


def test_volumes_with_letters_are_no_names(tmp_path: Path):
    """Though a date stands in several rows, with a time beside it, or by mistake."""
    text = "Date,Time,Open,High,Low,Close,Volume\n" + "".join(
        f"2020-01-02,09:3{k},10,11,9,10.{k},1.{k}K\n" for k in range(6)
    )
    assert load(write(tmp_path, text)).values[:, 0].tolist() == [10, 10.1, 10.2, 10.3, 10.4, 10.5]
    text = "Date,Price,Vol.\n" + rows([*ISO, ISO[-1]], [[f"{k}.5", "1.2M"] for k in range(1, 6)])
    assert f"the date {ISO[-1]} is already in row 5" in refusal(write(tmp_path, text))


def test_a_fund_with_a_price_and_a_net_asset_value(tmp_path: Path):
    text = "date,ticker,close,nav\n" + rows(ISO, [["A", f"1{k}", f"2{k}"] for k in range(4)])
    assert load(write(tmp_path, text)).values[:, 0].tolist() == [10, 11, 12, 13]
    text = "date,ticker,nav\n" + rows(ISO, [["A", f"2{k}"] for k in range(4)])
    assert load(write(tmp_path, text)).values[:, 0].tolist() == [20, 21, 22, 23]


def test_the_first_of_two_tables_is_never_skipped(tmp_path: Path):
    one = "date,A,B\n" + rows(ISO, [["1", "2"]] * 4)
    for between, row in (("\nSecond table\n", 8), ("", 6), ("Total: 4\n", 7)):
        other = "date,A,B,C\n" + rows(ISO, [["3", "4", "5"]] * 4)
        said = refusal(write(tmp_path, one + between + other))
        assert f"row {row}: there are 4 fields, but 3 column names" in said


def test_rows_below_a_blank_line_are_no_other_table(tmp_path: Path):
    first, *others = [f"{day:%b %d, %Y}" for day in DAYS]
    text = f'Title\ndate,A,B\n"{first}",1,2\n\n' + "".join(f'"{d}",1,2\n' for d in others)
    assert len(load(write(tmp_path, text))) == 4
    for wrong in ("", "2024-06-31"):
        text = f"Title\ndate,A,B\n{rows(ISO, [['1', '2']] * 4)}\n{wrong},1,2\n"
        assert "date" in refusal(write(tmp_path, text))


def test_days_of_two_digit_years_are_no_months(tmp_path: Path):
    """The first trading days of 13 months: 200102 would be a month of 2001."""
    stamps = ["200102", "200203", "200302", "200401", "200501", "200601", "200701", "200803",
              "200901", "201001", "201102", "201201", "210104"]  # fmt: skip
    text = "date,A,B\n" + rows(stamps, [["1", "2"]] * len(stamps))
    assert "is not a date" in refusal(write(tmp_path, text))


def test_zones_in_small_letters(tmp_path: Path):
    stamps = [f"{day:%d-%b-%Y} 16:00 utc" for day in DAYS]
    table = load(write(tmp_path, "date,A\n" + rows(stamps, [["1"]] * 4)))
    assert str(table.dates[0]).startswith("2024-01-29T16:00")


def test_a_percent_sign_of_a_feature_is_no_return(tmp_path: Path):
    text = "date,A,B,yield\n" + rows(ISO, [["1", "2", "4.5%"]] * 4)
    with pytest.raises(QfolioError, match=r"'4\.5%' has a percent sign") as raised:
        load(write(tmp_path, text), features="yield")
    assert "--returns" not in str(raised.value)


def test_lines_that_are_left_out_are_named_wherever_a_table_is_read(tmp_path: Path):
    text = f"Title\ndate,A\n{rows(ISO, [['1']] * 4)}\nSource: vendor\n"
    series = write(tmp_path, text)
    table = pd.DataFrame({"A": [1.0, 2, 3, 4], "B": [1.0, 2, 3, 5]}, index=DAYS)
    notes = map(str, findings(table, "note", columns=f"A={series}"))
    assert any("the blank row 7: 'Source: vendor'" in each for each in notes)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in ("one", "two"):
        (folder / f"{name}.csv").write_text(text.replace("A", name))
    notes = map(str, findings(folder, "note"))
    assert sum("the blank row 7" in each for each in notes) == 2
