"""Every command that reads prices reads returns and columns of the market, too."""

import html
import json
import os
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from qfolio.commands.backtesting import Options
from qfolio.core.errors import QfolioError
from qfolio.experiments.presets import preset
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.prices.table import load

from shell import TINY_BACKTEST, qfolio
from tables import write_table

NAMES = ["A", "B", "C"]


@pytest.fixture
def table(tmp_path):
    """A file of returns in percent, beside a cash rate."""
    rates = np.random.default_rng(0).normal(0.01, 1, (260, 3)).round(4)
    frame = pd.DataFrame(rates, pd.date_range("2020-01-01", periods=260), NAMES)
    frame["rate"] = np.linspace(0.01, 0.03, 260)
    path = tmp_path / "returns.csv"
    frame.rename_axis("date").to_csv(path)
    return path


def test_the_check_of_returns(monkeypatch, capsys, table):
    assert qfolio(monkeypatch, "prices", table, "--columns", "rate") == 2
    assert "look like returns" in (printed := " ".join(capsys.readouterr().out.split()))
    assert "returns='percent' or 'fraction' (--returns)" in printed
    given = ["--returns", "percent", "--columns", "rate"]
    assert qfolio(monkeypatch, "prices", table, *given) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "260 rows of 3 assets" in printed
    assert "start at 100" in printed
    assert "Columns of the market: rate." in printed


def test_a_backtest_keeps_what_it_computed(tmp_path, table):
    """The folder has the cumulated prices and the column of the market."""
    prices = Options(returns="percent", columns=("rate",)).load(table)
    assert prices.digest == load(table, returns="percent", columns=("rate",)).digest
    assert (prices.values[0] == 100).all()
    agents = {"tilts": preset("fast", "portfolio", "tilts")}
    Backtest.create(prices, agents, train="100d", test="50d", seeds=2, out=tmp_path / "run")
    kept = Backtest.open(tmp_path / "run").prices
    assert kept.digest == prices.digest
    assert kept.market_names == ("rate",)
    np.testing.assert_array_equal(kept.market[:, 0], np.linspace(0.01, 0.03, 260))


def test_a_backtest_says_what_is_implausible_in_its_table(tmp_path, capsys):
    moves = np.random.default_rng(0).normal(0, 0.01, (260, 3))
    moves[200, 1] = np.log(0.5)
    prices = pd.DataFrame(np.exp(moves.cumsum(0)), pd.date_range("2020-01-01", periods=260), NAMES)
    path = tmp_path / "prices.csv"
    prices.rename_axis("date").to_csv(path)
    doubts = Options().load(path).note
    assert "row 202 (2020-07-19), column 'B': the price" in doubts  # on the report's page
    printed = " ".join(capsys.readouterr().out.split())
    assert "Warning: prices.csv, row 202 (2020-07-19), column 'B': the price" in printed
    assert "close to 1/2: perhaps a split that was not adjusted" in printed
    prices["C"] = np.nan
    prices.rename_axis("date").to_csv(path)
    with pytest.raises(QfolioError, match="column 'C': there are no prices at all"):
        Options().load(path)
    assert not capsys.readouterr().out


def test_a_backtest_repeats_a_change_of_unit_and_says_which_column_does_nothing(
    tmp_path, monkeypatch, capsys
):
    """A backtest on pence after pounds has absurd returns, and must not look like a sound one."""
    path = write_table(tmp_path / "prices.csv", names=("A", "B", "C"))
    frame = pd.read_csv(path, index_col="date")
    frame.iloc[200:, 1] *= 101.3 * frame.iloc[199, 1] / frame.iloc[200, 1]
    frame.assign(rate=np.linspace(0.01, 0.03, 260)).to_csv(path)
    status = qfolio(
        monkeypatch, "backtest", path, *TINY_BACKTEST, "--columns", "rate",
        "--out", tmp_path / "run",
    )  # fmt: skip
    assert status == 0
    printed = " ".join(capsys.readouterr().out.split())
    said = "column 'B': the price is 101.3 times the one before"
    assert f"Warning: prices.csv, row 202 (2020-07-19), {said}" in printed
    assert "close to 100: perhaps a split that was not adjusted" in printed
    assert "No cost reads the column 'rate'; if it is the rate that cash earns, add" in printed
    page = html.unescape((tmp_path / "run/report.html").read_text(encoding="utf-8"))
    assert said in page


def test_json_has_all_large_moves(tmp_path, monkeypatch, capsys):
    path = write_table(tmp_path / "prices.csv", names=("A", "B", "C"))
    frame = pd.read_csv(path, index_col="date")
    for row in range(20, 220, 20):
        frame.iloc[row:, row // 20 % 3] *= 0.7
    frame.to_csv(path)
    assert qfolio(monkeypatch, "prices", path, "--json") == 0
    found = json.loads(capsys.readouterr().out)["findings"]
    (moves,) = [each for each in found if "large moves" in each["message"]]
    assert (moves["count"], len(moves["cells"])) == (10, 10)
    assert sorted(cell["row"] for cell in moves["cells"]) == list(range(22, 222, 20))


def test_costs_read_a_column_of_the_market(table):
    prices = Options(returns="percent", columns=("rate",)).load(table)
    known = Conditions.of(prices, Itemized(cash_rate="column:rate")).values["rate"]
    np.testing.assert_array_equal(known, prices.market)


def test_output_may_have_an_encoding_that_lacks_a_letter(tmp_path):
    frame = pd.DataFrame({"A": [1.0, 2.0, 3.0]}, pd.date_range("2020-01-01", periods=3))
    frame.rename_axis("date").to_csv(tmp_path / "é.csv")
    done = subprocess.run(
        [sys.executable, "-m", "qfolio", "prices", "é.csv"], cwd=tmp_path, capture_output=True,
        text=True, check=False, env=os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "1"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert "?.csv: 3 rows of 1 asset" in done.stdout
