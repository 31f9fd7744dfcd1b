"""What is held now, from files as brokers export them."""

from pathlib import Path

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.desk.holdings import cashed_out, read_holdings

from tables import price_table

ASSETS = ("AAA", "BBB", "NA")


def write(folder: Path, text: str) -> Path:
    path = folder / "holdings.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "asset,shares\nAAA,100.5\ncash,7\n",
        "Symbol,Quantity\nAAA,100.5\n\nCash,7\n",
        "Account,Ticker,Description,Qty,Price\nx,AAA,Triple A,100.5,$3\nx,CASH,,$7,\n",
        'Symbol;Units\nAAA;"100,5"\nBBB;0\nCash;7\n',
    ],
)
def test_headers_of_brokers(tmp_path: Path, text: str):
    shares, cash = read_holdings(write(tmp_path, text), ASSETS, None)
    assert shares.tolist() == [100.5, 0, 0]
    assert cash == 7


def test_names_and_money_that_are_given_otherwise(tmp_path: Path):
    shares, cash = read_holdings(write(tmp_path, "asset,shares\nNA,2\n"), ASSETS, 5.0)
    assert (shares.tolist(), cash) == ([0, 0, 2], 5)
    shares, cash = read_holdings(None, ASSETS, 5.0)
    assert (shares.tolist(), cash) == ([0, 0, 0], 5)
    with pytest.raises(QfolioError, match="--capital is nan"):
        read_holdings(None, ASSETS, float("nan"))


@pytest.mark.parametrize("text", [None, "asset,shares\nNA,2\n"])
def test_capital_becomes_a_float(tmp_path: Path, text: str | None):
    path = None if text is None else write(tmp_path, text)
    _, cash = read_holdings(path, ASSETS, 10_000)
    assert (type(cash), cash) == (float, 10_000)


def test_shorts_and_loans_where_they_are_allowed(tmp_path: Path):
    path = write(tmp_path, "asset,shares\nAAA,-1.5\nBBB,4\ncash,-7\n")
    shares, cash = read_holdings(path, ASSETS, None, debts=True)
    assert (shares.tolist(), cash) == ([-1.5, 4, 0], -7)
    with pytest.raises(QfolioError, match="has -inf shares; give a number"):
        read_holdings(write(tmp_path, "asset,shares\nAAA,-inf\n"), ASSETS, None, debts=True)


def test_an_overdraft_is_read_although_shorts_are_not_allowed(tmp_path: Path):
    _, cash = read_holdings(write(tmp_path, "asset,shares\nAAA,1\ncash,-7\n"), ASSETS, None)
    assert cash == -7


@pytest.mark.parametrize("name", ["BRK-B", "BRK.B", "BRK/B", "BRK B"])
def test_classes_of_shares_may_be_spelled_as_a_broker_does(tmp_path: Path, name: str):
    path = write(tmp_path, f"asset,shares\n{name},3\n")
    assert read_holdings(path, ("AAA", "BRK-B"), None)[0].tolist() == [0, 3]
    if name not in (both := ("BRK-B", "BRK.B")):
        with pytest.raises(QfolioError, match="the backtest does not know"):
            read_holdings(path, both, None)
    path = write(tmp_path, "asset,shares\nBRK-B,3\nBRK B,1\n")
    with pytest.raises(QfolioError, match="line 3: 'BRK-B' appears twice"):
        read_holdings(path, ("AAA", "BRK-B"), None)


def test_all_digits_of_shares_that_are_cashed_out_are_shown():
    listed = np.array([[True, True], [True, False]])
    prices = price_table(np.ones((2, 2)), listed=listed)
    _, cash, said = cashed_out(np.array([0.0, 1_234_567.5]), 0.5, prices)
    assert cash == 1_234_568
    assert said == ["B is delisted; 1,234,567.5 shares count as 1,234,567.50 in cash."]


def test_an_asset_without_any_price_yet_is_not_cashed_out():
    listed, values = np.array([[True, False, False], [False, True, False]]), np.ones((2, 3))
    values[0, 1], values[:, 2] = np.nan, np.nan
    prices = price_table(values, listed=listed)
    shares, cash, said = cashed_out(np.array([2.0, 3.0, 4.0]), 5.0, prices)
    assert shares.tolist() == [0, 3, 4]
    assert cash == 5 + 2
    assert len(said) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("asset,shares\nBBB,1\nAAA,1,000\n", "there are 3 fields, but 2 column names"),
        ("asset,shares\nAAA,1,000\n", "row 2: there are 3 fields, but 2 column names"),
        ('asset,shares\nAAA,"1,000"\n', "line 2: '1,000' may mean 1000 or 1.000"),
        ("asset\tshares\nAAA\t1.500\n", "'1.500' may mean 1500 or 1.500"),
        ("asset,shares\nAAA,1_000\n", "line 2: '1_000' is not a number"),
        ("asset,shares\nAAA,１２\n", "line 2: '１２' is not a number"),
        ("asset,shares\nAAA,$5\n", "line 2: '$5' is not a number"),
        ("asset,shares\nAAA,x\n", "line 2: 'x' is not a number"),
        ("asset,shares\nAAA,True\n", "line 2: 'True' is not a number"),
        ("asset,shares\nAAA,\n", "line 2: there is no number of shares of 'AAA'"),
        ("asset,shares\nAAA,nan\n", "line 2: there is no number of shares of 'AAA'"),
        ("asset,shares\nBBB,1\nAAA\n", "line 3: there is no number of shares of 'AAA'"),
        ("asset,shares\nAAA,-1\n", "line 2: 'AAA' has -1 shares; give 0 or more"),
        ("asset,shares\nAAA,inf\n", "line 2: 'AAA' has inf shares; give 0 or more"),
        ("asset,shares\nAAA,1\nAAA,2\n", "line 3: 'AAA' appears twice; add the two numbers up"),
        ("asset,shares\ncash,1\nCash,2\n", "line 3: 'cash' appears twice"),
        (
            "asset,shares\nAAB,1\n",
            "line 2: the backtest does not know 'AAB' (did you mean 'AAA'?).",
        ),
        ("asset,shares\n,1\n", "line 2: the asset has no name"),
        ("asset,shares,shares\nAAA,1,2\n", "'shares' and 'shares' could both be the shares"),
        ("Symbol,Name,Qty\nAAA,Triple,2\n", "'Symbol' and 'Name' could both be the asset"),
        ("asset,shares\n", "holdings.csv lists no holdings; leave it out if all is cash."),
        ("asset,shares\n,\n", "holdings.csv lists no holdings"),
        ("AAA,1\n", "needs a first line with the columns asset"),
        ("", "'holdings.csv' is empty; a table has a header and rows below it."),
    ],
)
def test_holdings_that_are_refused(tmp_path: Path, text: str, message: str):
    with pytest.raises(QfolioError) as raised:
        read_holdings(write(tmp_path, text), ASSETS, None)
    assert message in str(raised.value)
