"""Which prices a desk reads, and what its allocations write."""

import shutil
from typing import Any

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.ledger import Ledger
from qfolio.portfolio.prices.table import load

from tables import days, random_walk, write_table
from tiny import PATHWISE


def test_prices_without_an_asset_delisted_before_they_begin_are_to_begin_earlier(tmp_path):
    values = random_walk(160, drift=3e-4)
    values[50:, 2] = np.nan
    frame = pd.DataFrame(values, pd.DatetimeIndex(days(160), name="date"), list("ABC"))
    Backtest.create(
        load(frame, ended="cash-out"), {"pathwise": PATHWISE}, out=tmp_path / "run", train="100d",
        test="60d", seeds=1, baselines=[],
    )  # fmt: skip
    desk, latest = Desk.open(tmp_path / "run"), tmp_path / "latest.csv"
    frame[60:].to_csv(latest)
    with pytest.raises(QfolioError, match=r"no prices at all.* Give prices from before it was del"):
        desk.read(latest)
    frame[60:].drop(columns="C").to_csv(latest)
    with pytest.raises(
        QfolioError, match=r"lacks C \(2020-02-19\), delisted in the backtest; give"
    ):
        desk.read(latest)
    frame[40:].to_csv(latest)
    assert desk.read(latest).assets == desk.run.prices.assets


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a backtest that has policies, but no verdict."""
    folder = tmp_path_factory.mktemp("desk") / "run"
    prices = load(write_table(folder.parent / "prices.csv"))
    backtest = Backtest.create(
        prices, {"pathwise": PATHWISE}, out=folder, train="100d", test="80d", seeds=1, baselines=[]
    )
    backtest.run()
    return folder


def every_file(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_allocation_is_recorded_and_ordered(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    orders = tmp_path / "orders.csv"
    of: dict[str, Any] = {"capital": 1000.0, "as_of": "2020-09-16"}
    with pytest.raises(QfolioError, match="The backtest is not finished, so"):
        Desk.open(folder).allocate(**of)
    tried = Desk.open(folder).allocate(**of, anyway=True, orders=orders, dry_run=True)
    assert tried.sentences[-1] == "A dry run: nothing is written."
    assert every_file(tmp_path).keys() == every_file(folder).keys()
    made = Desk.open(folder).allocate(**of, anyway=True, orders=str(orders))
    assert [record.number for record in Ledger(folder / "ledger").records()] == [1]
    assert made.record is not None
    assert made.record.trades == made.allocation.trades.tolist()
    assert made.trained == "2020-09-16"
    assert made.sentences[-1].endswith(f"{orders} has 3 orders.")
    assert made.to_json()["record"] == 1
    assert sum(sentence.startswith("Why ") for sentence in made.sentences) == 3


@pytest.mark.parametrize("update", [False, True])
def test_what_is_not_recorded_leaves_everything_as_it_was(finished, tmp_path, monkeypatch, update):
    """An earlier file of orders, too, and no policy that has learned from the new rows."""
    folder = shutil.copytree(finished, tmp_path / "run")
    newer, orders = write_table(tmp_path / "newer.csv", rows=270), tmp_path / "orders.csv"
    orders.write_text("orders of another day")
    before = every_file(tmp_path)
    of: dict[str, Any] = {"prices": newer, "capital": 1000.0, "as_of": "2020-09-26"}

    def allocate():
        return Desk.open(folder).allocate(**of, anyway=True, update=update, orders=orders)

    with monkeypatch.context() as broken:
        broken.setattr(Ledger, "append", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            allocate()
    assert every_file(tmp_path) == before
    made = allocate()  # and the next try succeeds
    assert made.record is not None
    assert made.record.policy == ("latest-1" if update else "latest")
    assert orders.read_text().count("MARKET") == 3
