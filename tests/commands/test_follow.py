"""qfolio follow: a ledger marked to market."""

import csv
import json
import shutil

import numpy as np
import pandas as pd
import pytest

from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.follow import follow

from shell import qfolio, succeed
from tables import write_table

DAYS = ["2020-09-16", "2020-10-16", "2020-11-15"]


def table(path, rows, fall=0.0):
    """The backtest's prices, and more of the same; falling from the first allocation on."""
    write_table(path, rows=rows)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    for i, line in enumerate(lines[261:]):
        line[1:] = [repr(float(price) * (1 - fall) ** (i + 1)) for price in line[1:]]
    path.write_text("\n".join(map(",".join, lines)) + "\n")
    return path


@pytest.fixture(scope="module")
def folder(folder, tmp_path_factory):
    """A copy with three monthly allocations, the last of them twice."""
    place = tmp_path_factory.mktemp("follow")
    run = shutil.copytree(folder, place / "run")
    for i, date in enumerate(DAYS):
        prices = table(place / f"{i}.csv", 260 + 30 * i)
        for capital in (900, 1000)[i < 2 :]:
            succeed("allocate", run, "--prices", prices, "--as-of", date, "--capital", capital)
    return run


def test_follow_shows_live_beside_the_backtest(folder, monkeypatch, capsys, tmp_path):
    prices = table(tmp_path / "later.csv", 335)
    assert qfolio(monkeypatch, "follow", folder, "--prices", prices, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    with (folder / "follow.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert (found["allocations"], found["rows"], len(rows)) == (3, 335 - 260 - 1, 74)
    assert (rows[0]["date"], rows[-1]["date"]) == ("2020-09-18", "2020-11-30")
    returns = np.array([float(row["return"]) for row in rows])
    assert found["growth"] == pytest.approx(np.prod(1 + returns))
    assert float(rows[-1]["growth"]) == pytest.approx(found["growth"])
    low, middle, high = found["band"]
    assert low < middle < high
    for name, end in (("low", low), ("middle", middle), ("high", high)):
        assert float(rows[-1][f"band_{name}"]) == pytest.approx(end)
    cash, wealth = (np.array([float(row[name]) for row in rows]) for name in ("cash", "wealth"))
    assert (cash <= wealth + 1e-9).all()
    assert (cash < 0.5 * wealth).sum() > 60
    assert found["benchmark"] == "equal-weight"
    assert float(rows[-1]["benchmark"]) == pytest.approx(found["benchmark_growth"])
    assert found["alarm_since"] is None
    assert found["costs"] == pytest.approx(sum(float(row["cost"]) for row in rows))
    assert found["costs"] > 0.5
    # All is sold, and bought again with what was paid in: no return.
    assert abs(found["flows"]) > 1
    assert qfolio(monkeypatch, "follow", folder, "--prices", prices) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "3 allocations of pathwise since 2020-09-16, 74 rows up to 2020-11-30: " in printed
    assert "Live returns are consistent with the backtest (evidence against it" in printed
    assert "no retrain is due before it is 80d old." in printed
    assert "Holdings differed from those expected 2 times" in printed
    page = (folder / "follow.html").read_text()
    assert page.count("<svg") == 2
    assert "Live returns are consistent with the backtest" in page
    assert "pathwise, live and in the backtest" in page
    assert "Of histories like the backtest’s, 95% end between" in page


def test_follow_reads_a_table_of_returns_as_allocate_does(folder, monkeypatch, capsys, tmp_path):
    prices, returns = table(tmp_path / "later.csv", 335), tmp_path / "returns.csv"
    frame = pd.read_csv(prices, index_col=0)
    frame.pct_change().iloc[1:].to_csv(returns)
    found = []
    for words in (["--prices", prices], ["--prices", returns, "--returns", "fraction"]):
        assert qfolio(monkeypatch, "follow", folder, *words, "--json") == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[1]["growth"] == pytest.approx(found[0]["growth"])
    assert found[1]["flows"] == pytest.approx(found[0]["flows"])
    assert qfolio(monkeypatch, "follow", folder, "--prices", returns) == 2
    assert "(--returns)" in capsys.readouterr().err


def test_a_loss_at_every_row_raises_the_alarm(folder, monkeypatch, capsys, tmp_path):
    prices = table(tmp_path / "fall.csv", 420, fall=0.02)
    out = tmp_path / "fall-follow.csv"
    options = ["--prices", prices, "--out", out]
    assert qfolio(monkeypatch, "follow", folder, *options, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["evidence"] > found["alarm_at"] == 40
    with out.open() as file:
        rows = list(csv.DictReader(file))
    first = next(row["date"] for row in rows if float(row["evidence"]) >= 40)
    assert found["alarm_since"] == first
    assert found["retrain_due"]
    assert qfolio(monkeypatch, "follow", folder, *options) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"ALARM since {first}: live returns are worse than the backtest's" in printed
    assert "Live is below the band." in printed
    assert "a retrain is due because of the alarm and its age of 80d or more" in printed


def test_a_newer_policy_is_named_and_its_age_counts(folder, monkeypatch, capsys, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    follow = ["follow", copy, "--prices", table(tmp_path / "later.csv", 350)]
    assert qfolio(monkeypatch, *follow) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "up to 2020-09-16; a retrain is due because of its age of 80d or more" in printed
    longer = table(tmp_path / "longer.csv", 345)
    assert qfolio(monkeypatch, "backtest", longer, "--resume", copy) == 0
    capsys.readouterr()
    assert qfolio(monkeypatch, *follow) == 0
    printed = " ".join(capsys.readouterr().out.split())
    newer = "up to 2020-09-16, and a newer one, which the next allocation will use, up to"
    assert f"{newer} 2020-12-10; no retrain is due before it is 80d old." in printed
    assert qfolio(monkeypatch, *follow, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["retrain_due"], found["newer_policy_learned"]) == (False, "2020-12-10")


def test_before_the_first_return(folder, monkeypatch, capsys):
    """The ledger's second allocation is later than the backtest's own prices."""
    assert qfolio(monkeypatch, "follow", folder) == 2
    assert "have no row of 2020-10-16, on which record 2 was made" in capsys.readouterr().err


def test_a_ledger_without_returns_or_records(folder, monkeypatch, capsys, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    for number in (2, 3, 4):
        (copy / "ledger" / f"{number:04d}.json").unlink()
    assert qfolio(monkeypatch, "follow", copy) == 0
    printed = capsys.readouterr().out
    assert "1 allocation of pathwise since 2020-09-16: no trade has earned a return yet." in printed
    assert len((copy / "follow.csv").read_text().splitlines()) == 1
    (copy / "ledger" / "0001.json").unlink()
    assert qfolio(monkeypatch, "follow", copy) == 2
    assert "is empty; record an allocation with qfolio allocate" in capsys.readouterr().err


def test_a_backtest_that_lost_returns_promises_nothing(folder, monkeypatch, capsys, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    lines = (copy / "returns.csv").read_text().splitlines(keepends=True)
    (copy / "returns.csv").write_text("".join(lines[:-10]))
    assert qfolio(monkeypatch, "follow", copy, "--prices", table(tmp_path / "more.csv", 335)) == 2
    assert "returns.csv is missing or damaged; write it again with" in capsys.readouterr().err


def test_a_baseline_is_followed_without_training(folder, monkeypatch, capsys, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    shutil.rmtree(copy / "ledger")
    prices = table(tmp_path / "later.csv", 340)
    of = ["--as-of", "2020-09-16", "--capital", 1000, "--agent", "equal-weight"]
    assert qfolio(monkeypatch, "allocate", copy, *of) == 0
    assert qfolio(monkeypatch, "follow", copy, "--prices", prices) == 0
    assert "equal-weight learns nothing, so there is nothing to train." in capsys.readouterr().out


@pytest.mark.parametrize("command", ["follow", "allocate"])
def test_columns_come_from_files_of_their_own(folder, monkeypatch, capsys, tmp_path, command):
    prices, rates = table(tmp_path / "later.csv", 335), tmp_path / "rates.csv"
    rates.write_text("date,rate\n2019-12-01,0.02\n")
    more = ["--as-of", "2020-11-30", "--capital", 1, "--dry-run"] if command == "allocate" else []
    given = [command, folder, "--prices", prices, *more, "--columns"]
    assert qfolio(monkeypatch, *given, f"rate={rates}") == 0
    capsys.readouterr()
    assert qfolio(monkeypatch, *given, "rate=none.csv") == 2
    assert "'none.csv' cannot be read" in capsys.readouterr().err


def test_the_page_does_not_replace_the_rows(folder, monkeypatch, capsys, tmp_path):
    assert qfolio(monkeypatch, "follow", folder, "--out", tmp_path / "live.html") == 2
    assert "name it *.csv" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_rows_replace_no_file_of_the_run_and_none_that_is_read(
    folder, monkeypatch, capsys, tmp_path
):
    prices = table(tmp_path / "later.csv", 335)
    follow, before = ["follow", folder, "--prices", prices, "--out"], prices.read_bytes()
    assert qfolio(monkeypatch, *follow, folder / "returns.csv") == 2
    assert (
        "returns.csv, in the folder of the backtest, which has its own" in capsys.readouterr().err
    )
    assert qfolio(monkeypatch, *follow, prices) == 2
    assert "--prices and --out name one file; give the rows their own" in capsys.readouterr().err
    assert prices.read_bytes() == before
    assert qfolio(monkeypatch, *follow, folder / "follow.csv") == 0  # the default


def test_a_gain_at_every_row_is_above_the_band(folder, monkeypatch, capsys, tmp_path):
    prices = table(tmp_path / "rise.csv", 420, fall=-0.02)
    assert qfolio(monkeypatch, "follow", folder, "--prices", prices) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Live is above the band." in printed
    assert "consistent" not in printed + (folder / "follow.html").read_text()


def test_two_rows_have_no_annual_figures(folder, monkeypatch, capsys, tmp_path):
    prices = table(tmp_path / "later.csv", 323)
    out = tmp_path / "few.csv"
    copy = shutil.copytree(folder, tmp_path / "copy")
    for number in (1, 2):
        (copy / "ledger" / f"{number:04d}.json").unlink()
    assert qfolio(monkeypatch, "follow", copy, "--prices", prices, "--out", out) == 0
    (live,) = (line for line in capsys.readouterr().out.split("\n") if line.startswith("live"))
    assert live.split()[2:5] == ["–", "–", "–"]
    assert "<td>–</td><td>–</td><td>–</td>" in (tmp_path / "few.html").read_text()


def test_rows_that_a_backtest_was_given_later_are_live(folder, tmp_path, monkeypatch):
    copy = shutil.copytree(folder, tmp_path / "copy")
    later = table(tmp_path / "later.csv", 345)
    before = follow(Desk.open(copy), later).tested
    assert qfolio(monkeypatch, "backtest", later, "--resume", copy) == 0
    np.testing.assert_array_equal(follow(Desk.open(copy), later).tested, before)


def test_the_rows_since_the_first_allocation_are_enough(folder, monkeypatch, capsys, tmp_path):
    """The policy's window, which nothing is decided on, needs no rows before."""
    prices, found = table(tmp_path / "later.csv", 335), []
    for first in (1, 260):
        lines = prices.read_text().splitlines()
        prices.write_text("\n".join([lines[0], *lines[first:]]))
        assert qfolio(monkeypatch, "follow", folder, "--prices", prices, "--json") == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[1]["growth"] == pytest.approx(found[0]["growth"])
    assert found[1]["benchmark_growth"] == pytest.approx(found[0]["benchmark_growth"])
