"""Downloads as people have them: yfinance, Stooq, brokers; closes become prices, and it is said."""

import itertools
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.prices.table import load

from tables import findings

DAYS = pd.date_range("2024-01-02", periods=5, name="Date")
KINDS = ["Close", "High", "Low", "Open", "Volume"]
TICKERS = ["AAPL", "OPEN"]  # the latter is the name of a company, too


def download(kinds: list[str] = KINDS, tickers: list[str] = TICKERS) -> pd.DataFrame:
    """What yfinance.download returns: each cell tells its column and row."""
    columns = pd.MultiIndex.from_product([kinds, tickers], names=["Price", "Ticker"])
    values = 10.0 * (1 + np.arange(len(columns))) + 0.125 * np.arange(5)[:, None]
    return pd.DataFrame(values, index=DAYS, columns=columns)


def as_csv(folder: Path, frame: pd.DataFrame, **options: bool) -> Path:
    path = folder / "prices.csv"
    frame.to_csv(path, **options)
    return path


def as_parquet(folder: Path, frame: pd.DataFrame) -> Path:
    path = folder / "prices.parquet"
    frame.to_parquet(path)
    return path


def notes_on(path: Path) -> list[str]:
    return [str(finding) for finding in findings(path, "note")]


def test_yfinance_in_every_shape(tmp_path: Path):
    frame = download()
    nameless = frame.copy()
    nameless.index.name, nameless.columns.names = None, [None, None]
    by_ticker = frame.swaplevel(axis=1).sort_index(axis=1)
    sources = {
        "frame": lambda: frame,
        "by ticker": lambda: by_ticker,
        "reset": lambda: frame.reset_index(),
        "csv": lambda: as_csv(tmp_path, frame),
        "csv by ticker": lambda: as_csv(tmp_path, by_ticker),
        "csv without names": lambda: as_csv(tmp_path, nameless),
        "csv, reset": lambda: as_csv(tmp_path, frame.reset_index(), index=False),
        "csv, reset, numbered": lambda: as_csv(tmp_path, frame.reset_index()),
        "csv, pairs as text": lambda: as_csv(
            tmp_path, frame.set_axis(frame.columns.to_flat_index(), axis=1)
        ),
        "parquet": lambda: as_parquet(tmp_path, frame),
        "parquet, reset": lambda: as_parquet(tmp_path, frame.reset_index()),
        "long": lambda: frame.stack(level=1, future_stack=True),
    }
    for name, source in sources.items():
        prices = load(source())
        assert prices.assets == ("AAPL", "OPEN"), name
        np.testing.assert_array_equal(prices.values, frame["Close"].to_numpy(), name)
        np.testing.assert_array_equal(prices.dates, DAYS.to_numpy("datetime64[s]"), name)


def test_adjusted_closes_come_first_and_volumes_may_be_features(tmp_path: Path):
    frame = download(["Adj Close", *KINDS])
    path = as_csv(tmp_path, frame)
    prices = load(path, features=("Volume",))
    np.testing.assert_array_equal(prices.values, frame["Adj Close"].to_numpy())
    np.testing.assert_array_equal(prices.features[:, :, 0], frame["Volume"].to_numpy())
    (note,) = notes_on(path)
    assert note.startswith("prices are those of 'Adj Close AAPL', 'Adj Close OPEN'; left out: ")


def test_rows_of_a_header_on_three_lines_are_counted_from_the_top(tmp_path: Path):
    frame = download()
    frame.loc["2024-01-03", ("Close", "OPEN")] = -1
    with pytest.raises(QfolioError, match=r"row 5 \(2024-01-03\), column 'Close OPEN': .* negativ"):
        load(as_csv(tmp_path, frame))


def test_two_levels_that_name_no_close():
    with pytest.raises(QfolioError, match="there is no close of 'AAPL'"):
        load(download(["High", "Low"]))
    with pytest.raises(QfolioError, match=r"no 'Volume' of 'OPEN'\. Add its column"):
        load(download().drop(columns=[("Volume", "OPEN")]), features=("Volume",))
    frame = download()
    frame[("rate", "")] = 1.0
    with pytest.raises(QfolioError, match="one above 'rate'"):
        load(frame)


def columns(text: str, folder: Path) -> Path:
    """A table of three rows with these columns; values are 1, 2, … from left to right."""
    names = text.split(",")
    rows = [
        f"2024-01-0{day}," + ",".join(str(k + day / 8) for k in range(1, len(names)))
        for day in (2, 3, 4)
    ]
    path = folder / "prices.csv"
    path.write_text("\n".join([text, *rows]))
    return path


@pytest.mark.parametrize(
    ("header", "assets", "note"),
    [
        ("Date,Open,High,Low,Close,Volume", {"Close": 4}, "'Open', 'High', 'Low', 'Volume'"),
        ("Date,Open,High,Low,Close,Adj Close,Volume", {"Adj Close": 5}, "'Close', 'Volume'"),
        ("Date,Price,Open,High,Low,Vol.,Change %", {"Price": 1}, "'Change %'"),
        ("date,close,volume", {"close": 1}, "'volume'"),
        ("Date,Close,Adj Close", {"Adj Close": 2}, "'Close'"),
        ("Date,Close/Last,Volume,Open,High,Low", {"Close/Last": 1}, "'Volume', 'Open', 'High', "),
        ("date,close,volume,adjClose,adjHigh,divCash", {"adjClose": 3}, "'close', 'volume', 'adjH"),
        ("Date,AAPL,AAPL_Volume,MSFT,MSFT Volume", {"AAPL": 1, "MSFT": 3}, "'AAPL_Volume'"),
        ("Date,AAPL_Close,AAPL_Volume,MSFT_Close", {"AAPL": 1, "MSFT": 3}, "'AAPL_Volume'"),
        ("Date,Close_A,Volume_A,Close_B,Volume_B", {"A": 1, "B": 3}, "'Volume_A', 'Volume_B'"),
        ("Date,A.Open,A.High,A.Low,A.Close,A.Volume,A.Adjusted", {"A": 6}, "'A.Close'"),
        ("Date,AAPL,MSFT,Volume", {"AAPL": 1, "MSFT": 2}, "hold no prices: 'Volume'"),
        # These are assets, whatever their names:
        ("Date,LOW,OPEN,AAPL", {"LOW": 1, "OPEN": 2, "AAPL": 3}, None),
        ("Date,A_Close,B_Close", {"A_Close": 1, "B_Close": 2}, None),
        ("Date,Small High,Small Low,Min Vol", {"Small High": 1, "Small Low": 2, "Min Vol": 3},
         None),
    ],
)  # fmt: skip
def test_columns_of_bars(tmp_path: Path, header: str, assets: dict[str, int], note: str | None):
    path = columns(header, tmp_path)
    prices = load(path)
    assert dict(zip(prices.assets, prices.values[0] - 2 / 8, strict=True)) == assets
    notes = notes_on(path)
    assert len(notes) == (note is not None)
    assert note is None or note in notes[0]


def test_a_column_that_may_be_a_feature_beside_bars(tmp_path: Path):
    path = columns("Date,Open,High,Low,Close,rsi", tmp_path)
    with pytest.raises(QfolioError, match="but there is also 'rsi'"):
        load(path)
    assert load(path, features=("rsi",)).assets == ("Close",)


def test_bars_without_a_close(tmp_path: Path):
    with pytest.raises(QfolioError, match="there is no close of these bars"):
        load(columns("Date,High,Low,Open", tmp_path))
    with pytest.raises(QfolioError, match="there is no close of 'A'"):
        load(columns("Date,A_High,A_Low,A_Open,B", tmp_path))


def test_a_header_whose_cells_were_merged(tmp_path: Path):
    path = tmp_path / "prices.csv"
    path.write_text(",Close,,Volume,\nDate,A,B,A,B\n" + "".join(f"{d:%F},1,2,3,4\n" for d in DAYS))
    prices = load(path)
    assert (prices.assets, prices.values[0].tolist()) == (("A", "B"), [1, 2])


def test_two_columns_that_could_both_be_the_price(tmp_path: Path):
    with pytest.raises(QfolioError, match="'A Close' and 'A' could both be the price"):
        load(columns("Date,A,A Close,A Volume", tmp_path))


def test_a_long_table_of_one_numbered_asset(tmp_path: Path):
    path = tmp_path / "prices.csv"
    path.write_text("date,ticker,close\n2024-01-02,700,1\n2024-01-03,700,2\n2024-01-04,700,3\n")
    assert load(path).assets == ("700",)


def test_newest_first(tmp_path: Path):
    path = tmp_path / "prices.csv"
    rows = ["2024-01-05,4", "2024-01-04,", "2024-01-03,2", "2024-01-02,1"]
    path.write_text("\n".join(["date,A", *rows]))
    assert notes_on(path) == [
        "column 'date': the newest row comes first; the rows are read in reverse order"
    ]
    filled = load(path, missing="forward-fill")  # with the price of the day before
    np.testing.assert_array_equal(filled.values[:, 0], [1, 2, 2, 4])
    with pytest.raises(QfolioError, match=r"row 3 \(2024-01-04\), column 'A': the price is missin"):
        load(path)


def test_percent_signs_are_of_returns(tmp_path: Path):
    path = tmp_path / "returns.csv"
    days = ("2024-01-31", "2024-02-29", "2024-03-31")
    for cells, sign in ((("1.5%", "-2 %", "+0.5%"), ","), (("1,5 %", "-2%", "0,5"), ";")):
        path.write_text(f"date{sign}A\n" + "".join(f"{d}{sign}{c}\n" for d, c in zip(days, cells)))  # noqa: B905
        np.testing.assert_allclose(load(path, returns="percent").values[:, 0], [100, 98, 98.49])
        for unit in (None, "fraction", "relative"):
            with pytest.raises(QfolioError, match=r"'1.5 ?%' has a percent sign; .*'percent'"):
                load(path, returns=unit)


def test_currency_signs(tmp_path: Path):
    path = tmp_path / "prices.csv"
    days = ("2024-01-02", "2024-01-03", "2024-01-04")
    for cells in (("$185.00", "186", "$ 187.5"), ("185€", "186 €", "187.5 €")):
        path.write_text("date,A\n" + "".join(f"{d},{c}\n" for d, c in zip(days, cells)))  # noqa: B905
        np.testing.assert_array_equal(load(path).values[:, 0], [185, 186, 187.5])
    path.write_text("date;A\n" + "".join(f"{d};{k},25 €\n" for k, d in enumerate(days, 1)))
    np.testing.assert_array_equal(load(path).values[:, 0], [1.25, 2.25, 3.25])
    path.write_text("date,A,B\n" + "".join(f"{d},$1,€2\n" for d in days))
    with pytest.raises(QfolioError, match=r"several currencies: \$ and €\. Convert all"):
        load(path)
    rows = [f"{d},{asset},1,{code}\n" for d in days for asset, code in ("AX", "BY")]
    path.write_text("date,asset,price,Currency\n" + "".join(rows))
    (warning,) = [f for f in findings(path, "warning") if f.column]
    assert str(warning) == "column 'Currency': there are several currencies: X and Y"
    path.write_text("date,A\n" + "".join(f"{d},-$1\n" for d in days))
    with pytest.raises(QfolioError, match="is negative"):
        load(path)


def test_rows_that_are_longer_than_the_header(tmp_path: Path):
    """pandas takes the first row's width for that of all, and cuts the others silently."""
    path = tmp_path / "prices.csv"
    path.write_text("date,A\n2024-01-02,1,\n2024-01-03,1,000\n2024-01-04,2,\n")
    with pytest.raises(QfolioError, match="row 3: there are 3 fields, but 2 column names"):
        load(path)


def test_a_feature_that_is_the_column_of_dates():
    with pytest.raises(QfolioError, match="'Date' holds dates or row numbers, not a feature"):
        load(pd.DataFrame({"A": range(1, 6)}, index=DAYS), features=("Date",))


def test_headers_that_look_like_two_lines(tmp_path: Path):
    """A first row of words is a fault, not a header, where no line names a kind of price."""
    path = tmp_path / "prices.csv"
    for first, second in itertools.product(("date,A,B", "date,Close,B"), ("soon,1,2", "soon,,")):
        path.write_text(f"{first}\n{second}\n2024-01-03,1,2\n2024-01-04,1,2\n")
        with pytest.raises(QfolioError, match="row 2, column 'date': 'soon' is not a date"):
            load(path)
