"""Which prices a desk reads, and what its allocations write."""

import contextlib
import datetime
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from leaning import Leaning
from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.desk import allocation
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.doubts import require_plausible
from qfolio.portfolio.desk.ledger import Ledger
from qfolio.portfolio.prices.table import load

from tables import days, price_table, random_walk, write_table
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


def test_an_allocation_knows_the_lag_of_its_run(monkeypatch, tmp_path):
    """A cost model may depend on it, in the orders as in replay and follow."""
    prices, used = load(write_table(tmp_path / "prices.csv")), []
    Backtest.create(
        prices, {"pathwise": PATHWISE}, out=tmp_path / "run", seeds=1, train="100d", test="80d",
        lag=2, baselines=["equal-weight"],
    ).run()  # fmt: skip
    real = allocation.context_of

    def watched(*arguments):
        used.append(arguments[-1])
        return real(*arguments)

    monkeypatch.setattr(allocation, "context_of", watched)
    desk = Desk.open(tmp_path / "run")
    desk.allocate("equal-weight", capital=1000.0, as_of="2020-09-16", anyway=True)
    desk.reproduce("2020-09-16")
    assert used == [2, 2]


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


def test_orders_do_not_replace_what_the_run_has(finished, tmp_path):
    """Nor do they through a link."""
    folder, linked = shutil.copytree(finished, tmp_path / "run"), tmp_path / "orders.csv"
    linked.symlink_to(folder / "config.json")
    before = every_file(folder)
    for place in (folder / "config.json", folder / "new" / "orders.csv", linked):
        with pytest.raises(QfolioError, match=r"--orders is .*, in the folder of the backtest"):
            Desk.open(folder).allocate(orders=place, as_of="2020-09-16", anyway=True, capital=1.0)
    assert every_file(folder) == before


def test_orders_go_where_a_link_leads_and_to_no_device(finished, tmp_path):
    folder, orders = shutil.copytree(finished, tmp_path / "run"), tmp_path / "orders.csv"
    orders.symlink_to(tmp_path / "outbox.csv")
    of: dict[str, Any] = {"as_of": "2020-09-16", "anyway": True, "capital": 1000.0}
    Desk.open(folder).allocate(orders=orders, **of)
    assert orders.is_symlink()
    assert (tmp_path / "outbox.csv").read_text().count("MARKET") == 3
    for place, said in ((tmp_path, "is a folder"), (Path("/dev/null"), "is no regular file")):
        with pytest.raises(QfolioError, match=said):
            Desk.open(folder).allocate(orders=place, **of)


def doubtful_table(path, change):
    """Newer prices, of which the last row's B is multiplied."""
    head, *rows = write_table(path, rows=270).read_text().split()
    a, b, *rest = rows[-1].split(",")
    last = ",".join([a, b, str(change * float(rest[0])), rest[1]])
    path.write_text("\n".join([head, *rows[:-1], last]))
    return path


def test_a_doubtful_price_is_traded_on_demand_only(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    of: dict[str, Any] = {"agent": "equal-weight", "capital": 1000.0, "as_of": "2020-09-26"}
    cut = doubtful_table(tmp_path / "newer.csv", 0.1)
    found = (
        r"On 2020-09-26, 'B' moves by a factor of 0.*, close to 1/10: perhaps a split .* was cut"
    )
    with pytest.raises(QfolioError, match=found):
        Desk.open(folder).allocate(**of, prices=cut)
    assert numbers(folder) == []
    assert Desk.open(folder).allocate(**of, prices=cut, anyway=True).record is not None
    assert numbers(folder) == [1]


def test_a_crash_is_traded_with_a_warning(finished, tmp_path):
    desk = Desk.open(shutil.copytree(finished, tmp_path / "run"))
    crash = doubtful_table(tmp_path / "newer.csv", 0.45)
    made = desk.allocate("equal-weight", crash, capital=1000.0, as_of="2020-09-26")
    assert made.record is not None
    assert [each.column for each in desk.news if "perhaps a wrong price" in each.message] == ["B"]


def test_which_doubtful_prices_matter():
    values, every = random_walk(270, assets=6), np.ones(6, bool)
    earlier = values.copy()
    earlier[200:, 1] *= 0.1
    require_plausible(price_table(earlier), every)
    values[-1, 1:3] *= [0.1, 0.01]
    with pytest.raises(QfolioError, match=r"close to 1/10 \(1 more asset likewise\)"):
        require_plausible(price_table(values), every)
    require_plausible(price_table(values), np.isin(np.arange(6), (0, 3, 4, 5)))


def test_a_haircut_is_no_doubtful_price():
    values, listed = random_walk(270), np.ones((270, 3), bool)
    values[-1, 1], listed[-1, 1] = 0.1 * values[-2, 1], False
    require_plausible(price_table(values, listed=listed), np.ones(3, bool))


def fails(*_, **__):
    raise ZeroDivisionError


def fails_for_orders(replace):
    """As where a spreadsheet holds the file open: a file can be written beside it, and no more."""

    def renamed(path, target):
        return fails() if Path(target).name == "orders.csv" else replace(path, target)

    return renamed


def numbers(folder):
    return [record.number for record in Ledger(folder / "ledger").records()]


@pytest.mark.parametrize("update", [False, True])
@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize(
    ("kind", "step", "broken"),
    [(Ledger, "append", fails), (Path, "replace", fails_for_orders(Path.replace))],
    ids=["the record", "the orders"],
)
def test_what_fails_leaves_no_record_and_the_earlier_orders(
    finished, tmp_path, monkeypatch, kind, step, broken, earlier, update
):
    """A policy may have been updated; the next try follows it."""
    folder = shutil.copytree(finished, tmp_path / "run")
    newer, orders = write_table(tmp_path / "newer.csv", rows=270), tmp_path / "orders.csv"
    if earlier:
        orders.write_text("orders of another day")
    before = sorted(tmp_path.iterdir())
    of: dict[str, Any] = {"prices": newer, "capital": 1000.0, "as_of": "2020-09-26"}

    def allocate():
        return Desk.open(folder).allocate(**of, anyway=True, update=update, orders=orders)

    with monkeypatch.context() as patched:
        patched.setattr(kind, step, broken)
        with pytest.raises(ZeroDivisionError):
            allocate()
    assert numbers(folder) == []
    assert sorted(tmp_path.iterdir()) == before
    assert not earlier or orders.read_text() == "orders of another day"
    made = allocate()  # and the next try succeeds
    assert made.record is not None
    assert made.record.policy == ("latest-1" if update else "latest")
    assert orders.read_text().count("MARKET") == 3


KILLED = """
import os, signal, sys
from pathlib import Path
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.doubts import require_plausible

folder, prices, orders, victim = sys.argv[1:]
replace = Path.replace

def killed(path, target):
    if Path(target).name == victim:
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(path, target)

Path.replace = killed
Desk.open(folder).allocate(
    prices=prices, capital=1000.0, as_of="2020-09-26", anyway=True, update=True, orders=orders
)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="as POSIX kills")
@pytest.mark.parametrize(
    ("victim", "before"),
    [("latest-1.safetensors", []), ("0001.json", []), ("orders.csv", [1])],
)
def test_a_kill_leaves_no_new_orders_without_a_record(finished, tmp_path, victim, before):
    """And the same allocation again, with its update, finishes what was begun."""
    folder = shutil.copytree(finished, tmp_path / "run")
    newer, orders = write_table(tmp_path / "newer.csv", rows=270), tmp_path / "orders.csv"
    orders.write_text("orders of another day")
    words = [sys.executable, "-c", KILLED, folder, newer, orders, victim]
    assert subprocess.run(words, check=False).returncode == -signal.SIGKILL
    assert orders.read_text() == "orders of another day"
    assert numbers(folder) == before
    of: dict[str, Any] = {"prices": newer, "capital": 1000.0, "as_of": "2020-09-26"}
    for _ in range(2):
        made = Desk.open(folder).allocate(**of, anyway=True, update=True, orders=orders)
        assert orders.read_text().count("MARKET") == 3
    assert numbers(folder) == [1]
    assert made.record is not None
    assert made.record.policy == "latest-1"
    assert "The policy has already learned from the prices up to 2020-09-26, and" in " ".join(
        made.sentences
    )
    assert made.sentences[-1].startswith("This allocation is already record 1 of the ledger.")


@pytest.mark.parametrize("update", [False, True])
def test_of_two_at_once_the_loser_leaves_the_winners_orders(
    finished, tmp_path, monkeypatch, update
):
    """The winner comes between the loser's decision and its record; it may hold the lock still."""
    folder = shutil.copytree(finished, tmp_path / "run")
    newer, orders = write_table(tmp_path / "newer.csv", rows=270), tmp_path / "orders.csv"
    of: dict[str, Any] = {
        "prices": newer, "as_of": "2020-09-26", "anyway": True, "update": update, "orders": orders
    }  # fmt: skip
    locked, winners = Ledger.locked, []

    @contextlib.contextmanager
    def overtaken(ledger):
        monkeypatch.setattr(Ledger, "locked", locked)
        Desk.open(folder).allocate(capital=2000.0, **of)
        winners.append(orders.read_bytes())
        with contextlib.nullcontext() if update else locked(ledger), locked(ledger):
            yield

    monkeypatch.setattr(Ledger, "locked", overtaken)
    said = "has updated pathwise meanwhile; allocate again" if update else "is in use by process"
    with pytest.raises(QfolioError, match=said):
        Desk.open(folder).allocate(capital=1000.0, **of)
    (record,) = Ledger(folder / "ledger").records()
    assert record.cash == 2000
    assert [orders.read_bytes()] == winners
    assert Desk.open(folder).reproduce("2020-09-26")[0] == record


def test_a_policy_gives_no_weight_that_only_rounding_puts_below_zero(finished, monkeypatch):
    policy = Backtest.open(finished).policy()
    decided = np.array([[-1.2e-7, 0.5, 0.3, 0.2 + 1.2e-7]])
    monkeypatch.setattr(policy, "decide", lambda *_, **__: (decided, decided))
    weights = policy.weights(Backtest.open(finished).prices)
    assert f"{weights['cash']:.4f}" == "0.0000"
    assert sum(weights.values()) == pytest.approx(1, abs=1e-12)


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
