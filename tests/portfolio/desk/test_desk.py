"""Which prices a desk reads, and what its allocations write."""

import datetime
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from leaning import Leaning
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


def test_whole_numbers_are_recorded_as_the_ledger_reads_them(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    for _ in range(2):  # the second time, the ledger is read
        today = datetime.date(2020, 9, 16)
        made = Desk.open(folder).allocate(capital=1000, as_of=today, anyway=True)
        assert made.record is not None
        assert made.record.number == 1
    held = np.zeros(3, int), 1000
    assert Desk.open(folder).reproduce("2020-09-16", holdings=held)[0] == made.record


@pytest.mark.parametrize("argument", ["prices", "holdings"])
@pytest.mark.parametrize("kind", [str, Path])
def test_orders_do_not_replace_an_input(finished, tmp_path, argument, kind):
    path = tmp_path / "table.csv"
    path.write_text("asset,shares\ncash,1000\n")
    of: dict[str, Any] = {argument: kind(path), "orders": kind(path.parent / "." / path.name)}
    with pytest.raises(QfolioError, match=f"--{argument} and --orders name one file"):
        Desk.open(finished).allocate(**of, as_of="2020-09-16", anyway=True, dry_run=True)


def fails(*_, **__):
    raise ZeroDivisionError


def fails_for_orders(replace):
    """As where a spreadsheet holds the file open: a file can be written beside it, and no more."""

    def renamed(path, target):
        return fails() if Path(target).name == "orders.csv" else replace(path, target)

    return renamed


@pytest.mark.parametrize("update", [False, True])
@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize(
    ("kind", "step", "broken"),
    [(Ledger, "append", fails), (Path, "replace", fails_for_orders(Path.replace))],
    ids=["the record", "the orders"],
)
def test_what_fails_leaves_everything_as_it_was(
    finished, tmp_path, monkeypatch, kind, step, broken, earlier, update
):
    """An earlier file of orders, too, and no policy that has learned from the new rows."""
    folder = shutil.copytree(finished, tmp_path / "run")
    newer, orders = write_table(tmp_path / "newer.csv", rows=270), tmp_path / "orders.csv"
    if earlier:
        orders.write_text("orders of another day")
    before = every_file(tmp_path)
    of: dict[str, Any] = {"prices": newer, "capital": 1000.0, "as_of": "2020-09-26"}

    def allocate():
        return Desk.open(folder).allocate(**of, anyway=True, update=update, orders=orders)

    with monkeypatch.context() as patched:
        patched.setattr(kind, step, broken)
        with pytest.raises(ZeroDivisionError):
            allocate()
    assert every_file(tmp_path) == before
    made = allocate()  # and the next try succeeds
    assert made.record is not None
    assert made.record.policy == ("latest-1" if update else "latest")
    assert orders.read_text().count("MARKET") == 3


def test_an_allocation_that_fails_removes_its_own_policy_alone(finished, tmp_path, monkeypatch):
    """Meanwhile, another process may have updated the policy once more."""
    folder = shutil.copytree(finished, tmp_path / "run")
    own, other = (folder / "policies/pathwise" / f"latest-{n}.safetensors" for n in (1, 2))

    def append(*_, **__):
        shutil.copy(own, other)
        fails()

    monkeypatch.setattr(Ledger, "append", append)
    newer = write_table(tmp_path / "newer.csv", rows=270)
    of: dict[str, Any] = {"prices": newer, "capital": 1000.0, "as_of": "2020-09-26"}
    with pytest.raises(ZeroDivisionError):
        Desk.open(folder).allocate(**of, anyway=True, update=True)
    assert (own.exists(), other.exists()) == (False, True)


def test_an_agent_that_the_folder_cannot_restore_is_given(tmp_path):
    agent = Leaning(**PATHWISE.settings, towards=np.array([0.0, 0.0, 0.0, 1.0]))
    folder, prices = tmp_path / "run", load(write_table(tmp_path / "prices.csv"))
    Backtest.create(
        prices, {"leaning": agent}, out=folder, train="100d", test="80d", seeds=1, baselines=[],
        episodes=PATHWISE.episodes, task=PATHWISE.task,
    ).run()  # fmt: skip
    with pytest.raises(QfolioError, match="towards of the agent leaning:Leaning is no setting"):
        Desk.open(folder)
    desk = Desk.open(folder, agents={"leaning": agent})
    made = desk.allocate(capital=1000.0, as_of="2020-09-16", anyway=True)
    assert made.allocation.weights[-1] > 0.5
    assert desk.reproduce("2020-09-16")[0] == made.record
