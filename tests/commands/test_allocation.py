"""qfolio allocate: trades, the ledger, orders."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from qfolio.core.files import write_arrays
from qfolio.portfolio.desk.ledger import Ledger
from qfolio.portfolio.prices.stored import to_arrays
from qfolio.portfolio.prices.table import load

from shell import TINY_BACKTEST, qfolio
from tables import write_table

AS_OF = ["--as-of", "2020-09-16"]


@pytest.fixture(scope="module")
def folder(folder, tmp_path_factory):
    """A copy, which gets a ledger."""
    return shutil.copytree(folder, tmp_path_factory.mktemp("desk") / "run")


def allocation(folder, monkeypatch, capsys, *options):
    capsys.readouterr()
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, "--json", *options) == 0
    return json.loads(capsys.readouterr().out)


def test_allocate_from_cash(folder, monkeypatch, capsys):
    plan = allocation(folder, monkeypatch, capsys, "--capital", 10_000)
    assert plan["wealth"] == 10_000
    reason = plan["reasons"][0]
    explained = sum(driver["weight"] for driver in reason["drivers"]) + reason["rest"]
    assert explained == pytest.approx(reason["change"])
    assert len({each["asset"] for each in plan["reasons"]}) == 3
    weights = [row["weight"] for row in plan["assets"]]
    assert sum(weights) + plan["cash_weight"] == pytest.approx(1, abs=1e-5)


def test_allocate_from_holdings(folder, monkeypatch, capsys, tmp_path):
    holdings = tmp_path / "holdings.csv"
    holdings.write_text("asset,shares\nA,100\ncash,500\n")
    plan = allocation(folder, monkeypatch, capsys, "--holdings", holdings)
    price = plan["assets"][0]["price"]
    assert plan["wealth"] == pytest.approx(100 * price + 500)
    assert plan["assets"][0]["weight_now"] == pytest.approx(100 * price / plan["wealth"])
    whole = allocation(folder, monkeypatch, capsys, "--holdings", holdings, "--whole-shares")
    shares = [row["trade_shares"] for row in whole["assets"]]
    assert shares == [round(x) for x in shares]
    assert whole["cash_after"] >= 0


def test_allocate_on_newer_prices(folder, monkeypatch, capsys, tmp_path):
    newer = write_table(tmp_path / "newer.csv", rows=270, names=("A", "B", "C"))
    options = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 100]
    plan = allocation(folder, monkeypatch, capsys, *options)
    assert plan["date"] == "2020-09-26"


def test_a_split_since_the_backtest_is_named(folder, monkeypatch, capsys, tmp_path):
    newer = write_table(tmp_path / "newer.csv", rows=270, names=("A", "B", "C"))
    head, *rows = [line.split(",") for line in newer.read_text().split()]
    for halved in (rows[100:], rows[265:]):  # the first is in rows that the backtest saw
        for row in halved:
            row[2] = str(float(row[2]) / 2)
    newer.write_text("\n".join(",".join(row) for row in [head, *rows]))
    options = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 100, "--dry-run"]
    assert qfolio(monkeypatch, "allocate", folder, *options) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("perhaps a split that was not adjusted") == 1
    assert "Warning: newer.csv, row 267 (2020-09-22), column 'B': the price is" in said


def test_of_many_splits_since_the_backtest_none_is_hidden(folder, monkeypatch, capsys, tmp_path):
    """Of those in newer rows, five are named, and the count of the others has a date."""
    newer = write_table(tmp_path / "newer.csv", rows=340, names=("A", "B", "C"))
    head, *rows = [line.split(",") for line in newer.read_text().split()]
    for start in (*range(20, 140, 20), *range(265, 335, 10)):
        for row in rows[start:]:
            row[2] = str(float(row[2]) / 2)
    newer.write_text("\n".join(",".join(row) for row in [head, *rows]))
    options = ["--prices", newer, "--as-of", "2020-12-05", "--capital", 100, "--dry-run"]
    assert qfolio(monkeypatch, "allocate", folder, *options) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("perhaps a split that was not adjusted") == 5
    assert "Warning: newer.csv, row 327" in said
    assert "2020-10-02: and 7 more moves that may be splits, the latest on this date" in said


def test_a_price_carried_forward_is_named_although_the_backtest_saw_it_stand(
    folder, monkeypatch, capsys, tmp_path
):
    newer = write_table(tmp_path / "newer.csv", rows=270, names=("A", "B", "C"))
    head, *rows = [line.split(",") for line in newer.read_text().split()]
    for row in rows[245:]:  # the backtest ends with row 260
        row[2] = rows[244][2]
    newer.write_text("\n".join(",".join(row) for row in [head, *rows]))
    options = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 100, "--dry-run"]
    assert qfolio(monkeypatch, "allocate", folder, *options) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Warning: newer.csv, row 271 (2020-09-26), column 'B': the price has been" in said
    assert "(25 rows): perhaps the asset was delisted" in said


def test_prices_that_were_filled_forward_are_named(folder, monkeypatch, capsys, tmp_path):
    newer = write_table(tmp_path / "newer.csv", rows=270, names=("A", "B", "C"))
    head, *rows = newer.read_text().split()
    a, b, _, d = rows[-1].split(",")
    newer.write_text("\n".join([head, *rows[:-2], f"{rows[-2][:10]},,,", f"{a},{b},,{d}"]))
    options = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 100, "--dry-run"]
    assert qfolio(monkeypatch, "allocate", folder, *options, "--missing", "forward-fill") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Warning: newer.csv, 2020-09-25: left out: 1 row without any number." in said
    assert "Warning: newer.csv, 2020-09-26: filled forward: 1 missing price" in said
    assert "newer.csv, 2020-09-26: the last row has no price of 'B', and takes an earlier" in said


def test_holdings_from_before_the_last_orders_are_named(copy, monkeypatch, capsys, tmp_path):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    newer = write_table(tmp_path / "newer.csv", rows=270)
    of = ["allocate", copy, "--agent", "equal-weight", "--capital"]
    stale = "The holdings are those of record 1 before its trades; if these were filled, export"
    later, holdings = ["--prices", newer, "--as-of", "2020-09-26"], tmp_path / "holdings.csv"
    holdings.write_text("asset,shares\nA,1\n")
    for capital, more, named in (
        (1000, AS_OF, False), (1000, later, True),
        (1000.01, later, True),  # interest or a fee
        (1000, [*later, "--holdings", holdings], False),
    ):  # fmt: skip
        assert qfolio(monkeypatch, *of, capital, *more) == 0
        assert (stale in " ".join(capsys.readouterr().out.split())) == named


def test_after_its_trades_an_allocation_is_not_made_again(copy, monkeypatch, capsys, tmp_path):
    """It would take the place of the record that has the trades, and order more of them."""
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    path, holdings = tmp_path / "orders.csv", tmp_path / "holdings.csv"
    of = ["--agent", "equal-weight", "--orders", path]
    plan = allocation(copy, monkeypatch, capsys, *of, "--capital", 3000)
    with path.open() as file:
        bought = {row["symbol"]: row["quantity"] for row in csv.DictReader(file)}
    lines = [f"{name},{shares}" for name, shares in bought.items()]
    holdings.write_text("\n".join(["asset,shares", *lines, "cash,1.5", ""]))
    held = ["allocate", copy, *AS_OF, "--holdings", holdings]
    assert qfolio(monkeypatch, *held, *of) == 2
    assert "those of record 1 of 2020-09-16 after its trades, so that" in capsys.readouterr().err
    assert [record["trades"] for record in records(copy)] == [
        [row["trade_shares"] for row in plan["assets"]]
    ]
    assert qfolio(monkeypatch, *held, *of, "--dry-run") == 0
    assert qfolio(monkeypatch, *held, "--agent", "momentum") == 0  # what else is wanted is ordered
    assert "It supersedes record 1 of the same date" in capsys.readouterr().out


def test_after_its_trades_neither_rounding_nor_adjusted_prices_let_it_be_made_again(
    copy, monkeypatch, capsys, tmp_path
):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    holdings, adjusted = tmp_path / "holdings.csv", tmp_path / "adjusted.csv"
    of = ["--agent", "equal-weight"]
    plan = allocation(copy, monkeypatch, capsys, *of, "--capital", 3000, "--whole-shares")
    lines = [f"{row['asset']},{row['trade_shares']}" for row in plan["assets"]]
    holdings.write_text("\n".join(["asset,shares", *lines, f"cash,{plan['cash_after']}", ""]))
    head, *rows = write_table(tmp_path / "prices.csv").read_text().split()
    cells = [row.split(",") for row in rows]
    lines = [
        f"{day},{float(a) * (0.99 if day < '2020-09' else 1)},{b},{c}" for day, a, b, c in cells
    ]
    adjusted.write_text("\n".join([head, *lines]))
    held = ["allocate", copy, *AS_OF, "--holdings", holdings, *of]
    for options in ([], ["--prices", adjusted], ["--whole-shares", "--prices", adjusted]):
        assert qfolio(monkeypatch, *held, *options) == 2
        assert "of record 1 of 2020-09-16 after its trades, so that" in capsys.readouterr().err
    assert len(records(copy)) == 1


def test_a_history_that_is_not_the_backtests_is_refused_or_named(
    folder, monkeypatch, capsys, tmp_path
):
    newer = write_table(tmp_path / "newer.csv", rows=270, names=("A", "B", "C"))
    of = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 100, "--dry-run"]
    head, *rows = newer.read_text().split()
    newer.write_text("\n".join(["date,C,B,A", *rows]))
    assert qfolio(monkeypatch, "allocate", folder, *of) == 2
    said = "qfolio: The price table has other returns than the backtest's for A, C, on most of the"
    assert said in capsys.readouterr().err
    cells = [row.split(",") for row in rows]
    cells[99][1] = str(1.3 * float(cells[99][1]))
    newer.write_text("\n".join([head, *map(",".join, cells)]))
    assert qfolio(monkeypatch, "allocate", folder, *of) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Warning: newer.csv, 2020-04-09, column 'A': the return is +" in said
    assert "in the backtest's table (the first of 2 that differ). Correct the table" in said


def test_a_deposit_after_the_trades_is_invested(copy, monkeypatch, capsys, tmp_path):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    holdings = tmp_path / "holdings.csv"
    plan = allocation(copy, monkeypatch, capsys, "--agent", "equal-weight", "--capital", 3000)
    lines = [f"{row['asset']},{row['trade_shares']}" for row in plan["assets"]]
    holdings.write_text("\n".join(["asset,shares", *lines, "cash,500", ""]))
    of = ["allocate", copy, *AS_OF, "--holdings", holdings, "--agent", "equal-weight"]
    assert qfolio(monkeypatch, *of) == 0
    assert sum(records(copy)[-1]["weights_before"][1:]) < 0.9 < sum(records(copy)[-1]["target"][1:])


def test_many_shares_are_shown_with_all_digits(folder, monkeypatch, capsys):
    of = ["--agent", "equal-weight", "--capital", 1e8, "--whole-shares", "--dry-run"]
    plan = allocation(folder, monkeypatch, capsys, *of)
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *of) == 0
    printed = capsys.readouterr().out
    for row in plan["assets"]:
        assert f" +{row['trade_shares']:,.0f}\n" in printed


@pytest.mark.parametrize("command", ["allocate", "follow"])
def test_options_without_a_table_to_read_are_refused(command, folder, monkeypatch, capsys):
    options = ["--missing", "forward-fill", "--returns", "percent", "--delisting-haircut", 0.5]
    assert qfolio(monkeypatch, command, folder, *options) == 2
    said = "leave out --missing, --delisting-haircut and --returns, or give --prices."
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--capital", 1], "stale"), ([*AS_OF], "nothing to allocate"),
        ([*AS_OF, "--agent", "dqn"], "no agent, baseline or strategy 'dqn'; choose from"),
        ([*AS_OF, "--agent", "equal-weigh"], "did you mean equal-weight?"),
        ([*AS_OF, "--capital", -1], "at least 0"),
        (["--as-of", "soon"], "must be a date"), (["--as-of", "2020-01-05"], "after 2020-01-05"),
    ],
)  # fmt: skip
def test_allocations_that_are_refused(folder, monkeypatch, capsys, options, message):
    assert qfolio(monkeypatch, "allocate", folder, *options) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed


def test_holdings_are_refused_by_their_line(folder, monkeypatch, capsys, tmp_path):
    path = tmp_path / "holdings.csv"
    path.write_text("asset,shares\nA,1\ncash,5\n")
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, "--holdings", path,
                  "--capital", 5) == 2  # fmt: skip
    assert "line 3: cash is also given by --capital" in capsys.readouterr().err


@pytest.fixture
def copy(folder, tmp_path):
    """Of the finished backtest, to change."""
    return shutil.copytree(folder, tmp_path / "copy")


def judge(folder, finding, verdict, against="to_reference"):
    """Has the backtest find this of its agent, beside equal weights."""
    path = folder / "summary.json"
    summary = json.loads(path.read_text())
    for key in ("to_reference", "to_rebalanced"):
        growth = summary["strategies"]["pathwise-together"][key]["growth"]
        assert growth["finding"] in ("better", "worse", "none")
        growth["finding"] = finding if key == against else "none"
    summary["verdicts"]["pathwise-together"][0] = verdict
    path.write_text(json.dumps(summary))


def test_an_allocation_names_agent_date_and_verdict(folder, copy, monkeypatch, capsys):
    summary = json.loads((folder / "summary.json").read_text())
    verdict = summary["verdicts"]["pathwise-together"][0]
    plan = allocation(folder, monkeypatch, capsys, "--capital", 1)
    assert (plan["agent"], plan["trained_until"]) == ("pathwise", "2020-09-16")
    assert plan["verdict"] == verdict
    judge(copy, "none", "No evidence of \x1b[2Jskill.")
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 1) == 0
    printed = capsys.readouterr().out
    assert "Agent: pathwise, trained on prices up to 2020-09-16." in printed
    assert "In its backtest: No evidence of \\x1b[2Jskill." in printed
    assert printed.count("\nWhy ") == 3


@pytest.mark.parametrize("against", ["to_reference", "to_rebalanced"])
def test_a_policy_that_was_found_worse_is_traded_on_demand_only(copy, monkeypatch, capsys, against):
    judge(copy, "worse", "pathwise-together falls short of equal-weight.", against)
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 1) == 2
    assert capsys.readouterr().err == (
        "qfolio: In its own backtest, pathwise-together falls short of equal-weight; to trade "
        "it nevertheless, add --agent pathwise or --anyway.\n"
    )
    for consent in (["--agent", "pathwise"], ["--anyway"]):
        plan = allocation(copy, monkeypatch, capsys, "--capital", 1, *consent)
        assert plan["verdict"] == "pathwise-together falls short of equal-weight."


def test_a_backtest_without_a_verdict(copy, monkeypatch, capsys):
    for damaged in ('{"strategies": {"pathwise": 1}}', '{"strategies": {'):
        (copy / "summary.json").write_text(damaged)
        assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 1) == 2
        assert "summary.json is damaged; write it again" in capsys.readouterr().err
    (copy / "summary.json").unlink()
    for consent in ([], ["--agent", "pathwise"]):
        assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 1, *consent) == 2
        assert "is not finished, so it does not say how pathwise" in capsys.readouterr().err
    plan = allocation(copy, monkeypatch, capsys, "--capital", 1, "--anyway")
    assert plan["verdict"] is None


def test_prices_that_do_not_match(folder, monkeypatch, capsys, tmp_path):
    other = write_table(tmp_path / "other.csv", names=("A", "B", "D"))
    assert qfolio(monkeypatch, "allocate", folder, "--prices", other, *AS_OF) == 2
    assert "lacks 'C' and has 'D'" in capsys.readouterr().err


def records(folder):
    return [json.loads(path.read_text()) for path in sorted((folder / "ledger").glob("*.json"))]


def test_prices_that_end_early_are_read_as_in_the_backtest(folder, monkeypatch, capsys, tmp_path):
    prices = write_table(tmp_path / "prices.csv")
    options = ["--prices", prices, "--capital", 100, "--dry-run", "--delisting-haircut", 0.3]
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *options) == 2
    assert "ended=cash-out (--ended cash-out)" in capsys.readouterr().err
    assert allocation(folder, monkeypatch, capsys, *options, "--ended", "cash-out")["assets"]


@pytest.mark.parametrize("command", ["allocate", "follow"])
def test_the_help_names_what_may_be_typed_of_prices_that_end(command, monkeypatch, capsys):
    assert qfolio(monkeypatch, command, "--help") == 0
    assert "--ended {gap,cash-out}" in capsys.readouterr().out


def test_the_ledger_goes_on_beyond_four_digits(copy, monkeypatch, capsys):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    allocation(copy, monkeypatch, capsys, "--capital", 1000)
    (first,) = records(copy)
    (copy / "ledger" / "0001.json").unlink()
    (copy / "ledger" / "9999.json").write_text(json.dumps({**first, "number": 9999}))
    for number, capital in ((10_000, 7), (10_001, 8), (10_002, 9)):
        made = allocation(copy, monkeypatch, capsys, "--capital", capital)
        assert made["record"] == number
    found = Ledger(copy / "ledger").records()
    assert [(each.number, each.supersedes) for each in found] == [
        (9999, None), (10_000, 9999), (10_001, 10_000), (10_002, 10_001)
    ]  # fmt: skip


def test_the_ledger_has_one_record_for_the_same_inputs(copy, monkeypatch, capsys, tmp_path):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    plan = allocation(copy, monkeypatch, capsys, "--capital", 1000)
    (record,) = records(copy)
    assert plan["record"] == record["number"] == 1
    assert (record["date"], record["agent"], record["policy"]) == (
        "2020-09-16", "pathwise", "latest",
    )  # fmt: skip
    assert all(len(digest) == 64 for digest in record["digests"].values())
    assert record["target"][1:] == [row["weight"] for row in plan["assets"]]
    assert record["trades"] == [row["trade_shares"] for row in plan["assets"]]
    assert sum(record["costs"].values()) == pytest.approx(plan["expected_cost"])
    assert allocation(copy, monkeypatch, capsys, "--capital", 1000)["record"] == 1
    assert allocation(copy, monkeypatch, capsys, "--capital", 7, "--dry-run")["record"] is None
    assert len(records(copy)) == 1
    capsys.readouterr()
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 2000) == 0
    printed = capsys.readouterr().out
    assert "It supersedes record 1 of the same date, which had other holdings." in printed
    assert [record["supersedes"] for record in records(copy)] == [None, 1]
    # Back to the first inputs: the last record counts, and it has others.
    assert allocation(copy, monkeypatch, capsys, "--capital", 1000)["record"] == 3
    words = ["allocate", copy, *AS_OF, "--capital", 1000, "--agent", "equal-weight"]
    assert qfolio(monkeypatch, *words) == 0
    assert "which had another agent and another policy." in capsys.readouterr().out


def test_any_order_is_reproduced_after_an_update(copy, monkeypatch, capsys, tmp_path):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    first = allocation(copy, monkeypatch, capsys, "--capital", 1000)
    newer = write_table(tmp_path / "newer.csv", rows=270)
    then = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 1000, "--json"]
    update = ["allocate", copy, *then, "--update"]
    capsys.readouterr()
    assert qfolio(monkeypatch, *update[:-4], "--update") == 2
    assert "nothing to allocate" in capsys.readouterr().err
    policies = copy / "policies" / "pathwise"
    assert not (policies / "latest-1.safetensors").exists()  # a refused one keeps nothing
    before = (policies / "latest.safetensors").read_bytes()
    assert qfolio(monkeypatch, *update, "--dry-run") == 0
    assert not (policies / "latest-1.safetensors").exists()
    tried = json.loads(capsys.readouterr().out)
    assert qfolio(monkeypatch, *update) == 0
    second = json.loads(capsys.readouterr().out)
    assert second["trained_until"] == "2020-09-26"
    assert second["assets"] == tried["assets"]
    assert (policies / "latest.safetensors").read_bytes() == before
    assert [record["policy"] for record in records(copy)] == ["latest", "latest-1"]
    for plan in (first, second):
        assert qfolio(monkeypatch, "allocate", copy, "--reproduce", plan["date"], "--json") == 0
        again = json.loads(capsys.readouterr().out)
        assert again["assets"] == plan["assets"]
    # With the inputs given once more, and rows that came later.
    later = write_table(tmp_path / "later.csv", rows=280)
    given = ["--reproduce", "2020-09-26", "--prices", later, "--capital", 1000]
    assert qfolio(monkeypatch, "allocate", copy, *given) == 0
    assert "is reproduced: prices, settings, holdings and policy" in capsys.readouterr().out
    assert qfolio(monkeypatch, "allocate", copy, *given[:-1], 999) == 2
    assert "the holdings differ from those of the ledger" in capsys.readouterr().err
    other = write_table(tmp_path / "other.csv", rows=280, scale=2)
    changed = ["--reproduce", "2020-09-26", "--prices", other, "--capital", 999]
    assert qfolio(monkeypatch, "allocate", copy, *changed) == 2
    assert "the prices up to 2020-09-26 and the holdings differ" in capsys.readouterr().err
    (policies / "latest-1.safetensors").write_bytes(before)
    assert qfolio(monkeypatch, "allocate", copy, "--reproduce", "2020-09-26") == 2
    assert "the file of the policy latest-1 differ" in capsys.readouterr().err


def test_what_was_changed_since_an_allocation_is_noticed(copy, monkeypatch, capsys, tmp_path):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    newer = ["--prices", write_table(tmp_path / "newer.csv", rows=270), "--as-of", "2020-09-26"]
    assert qfolio(monkeypatch, "allocate", copy, *newer, "--capital", 1000) == 0
    again = ["allocate", copy, "--reproduce", "2020-09-26"]
    record, config = copy / "ledger" / "0001.json", copy / "config.json"
    content, settings = record.read_text(), config.read_text()
    changed = json.loads(content)
    changed["target"][:2] = changed["target"][1::-1]
    capsys.readouterr()

    def refused(said):
        assert qfolio(monkeypatch, *again) == 2
        assert said in capsys.readouterr().err

    record.write_text(json.dumps(changed))
    refused("gives other weights from the same inputs")
    record.write_text(content)
    config.write_text(f"{settings} ")
    refused("config.json differ")
    config.write_text(settings)
    (kept,) = (copy / "ledger" / "prices").iterdir()
    write_arrays(kept, to_arrays(load(write_table(tmp_path / "other.csv", rows=270, scale=2))))
    refused("does not belong to record 1")
    record.rename(record.with_name("0007.json"))
    refused("0007.json is damaged")


@pytest.mark.parametrize(
    ("content", "message"),
    [("", "damaged"), ('{"number": 1}', "damaged"), ('{"format": 99}', "damaged")],
)
def test_a_damaged_ledger_is_refused(copy, monkeypatch, capsys, content, message):
    allocation(copy, monkeypatch, capsys, "--capital", 1000)
    number = max(record["number"] for record in records(copy))
    (copy / "ledger" / f"{number:04d}.json").write_text(content)
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 1) == 2
    assert message in capsys.readouterr().err


def test_holdings_that_were_changed_in_the_ledger_are_noticed(copy, monkeypatch, capsys):
    """By all commands that read it, not by --reproduce alone."""
    allocation(copy, monkeypatch, capsys, "--capital", 1000)
    path = max((copy / "ledger").glob("*.json"))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"cash": 2000.0}))
    assert qfolio(monkeypatch, "follow", copy) == 2
    assert "is damaged (its holdings do not have their digest)" in capsys.readouterr().err


def test_what_the_ledger_does_not_know_is_refused(copy, monkeypatch, capsys):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    assert qfolio(monkeypatch, "allocate", copy, "--reproduce", "2020-09-16") == 2
    assert "no allocation of '2020-09-16'; it is empty" in capsys.readouterr().err
    for options in (["--agent", "pathwise"], ["--whole-shares"], ["--as-of", "2020-09-16"]):
        assert qfolio(monkeypatch, "allocate", copy, "--reproduce", "2020-09-16", *options) == 2
        said = capsys.readouterr().err
        assert (
            f"--reproduce takes its settings from the ledger and trades nothing; leave out "
            f"{options[0]}." in said
        )


def test_a_baseline_is_followed(folder, monkeypatch, capsys):
    """Equal weights after costs, whatever the agents learned; nothing needs to be trained."""
    plan = allocation(folder, monkeypatch, capsys, "--agent", "equal-weight", "--capital", 3000)
    assert [row["weight"] for row in plan["assets"]] == pytest.approx([1 / 3] * 3)
    assert plan["expected_cost"] == pytest.approx(3)  # 10 bp of what is spent
    assert plan["trained_until"] is None
    assert "This baseline, which learned nothing, grew by" in plan["verdict"]
    assert records(folder)[-1]["policy"] is None
    capsys.readouterr()
    assert qfolio(monkeypatch, "allocate", folder, "--reproduce", "2020-09-16") == 0
    assert "is reproduced: prices, settings and holdings have" in capsys.readouterr().out
    momentum = ["--agent", "momentum", "--capital", 3000]
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *momentum) == 0
    assert "Baseline: momentum.\nIn its backtest: This baseline" in capsys.readouterr().out
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *momentum, "--update") == 2
    assert "momentum learns nothing; leave out --update" in capsys.readouterr().err


def test_a_baseline_that_gives_no_order_leaves_the_holding(folder, monkeypatch, capsys, tmp_path):
    holdings = tmp_path / "holdings.csv"
    holdings.write_text("asset,shares\nA,100\ncash,500\n")
    kept = ["--agent", "buy-and-hold", "--holdings", holdings]
    plan = allocation(folder, monkeypatch, capsys, *kept)
    assert [row["trade_shares"] for row in plan["assets"]] == [0, 0, 0]
    assert plan["cash_after"] == 500
    # Of a fully invested account that is equally weighted, nothing is traded either.
    prices = [row["price"] for row in plan["assets"]]
    lines = [f"{name},{1000 / price!r}" for name, price in zip("ABC", prices, strict=True)]
    holdings.write_text("\n".join(["asset,shares", *lines, ""]))
    plan = allocation(folder, monkeypatch, capsys, "--agent", "equal-weight", *kept[2:])
    assert [row["trade_shares"] for row in plan["assets"]] == [0, 0, 0]


def test_a_warning_stands_above_the_orders_of_a_worse_policy(copy, monkeypatch, capsys):
    judge(copy, "worse", "pathwise-together falls short of equal-weight.")
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, "--capital", 1, "--anyway") == 0
    printed = " ".join(capsys.readouterr().out.split())
    warning = "WARNING. In its backtest: pathwise-together falls short of equal-weight."
    assert warning in printed
    assert printed.index("WARNING") < printed.index("weight now")


def test_orders_as_csv(folder, monkeypatch, capsys, tmp_path):
    path, holdings = tmp_path / "orders.csv", tmp_path / "holdings.csv"
    holdings.write_text("asset,shares\nA,100\ncash,5000\n")
    of = ["--agent", "equal-weight", "--holdings", holdings, "--orders", path]
    plan = allocation(folder, monkeypatch, capsys, *of)
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["side"] for row in rows] == sorted((row["side"] for row in rows), reverse=True)
    assert {row["order_type"] for row in rows} == {"MARKET"}
    by_name = {row["asset"]: row for row in plan["assets"]}
    for row in rows:
        asset = by_name[row["symbol"]]
        sign = 1 if row["side"] == "BUY" else -1
        assert sign * float(row["quantity"]) == pytest.approx(asset["trade_shares"], abs=1e-6)
        assert float(row["weight_before"]) == pytest.approx(asset["weight_now"], abs=1e-6)
        assert float(row["weight_after"]) == pytest.approx(asset["weight_after"], abs=1e-6)
    paid = sum(float(row["expected_cost"]) for row in rows)
    assert paid == pytest.approx(plan["expected_cost"], abs=0.02)
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *of, "--layout", "ib") == 2
    assert "takes whole shares only; add --whole-shares" in capsys.readouterr().err
    whole = [*of, "--layout", "ib", "--whole-shares", "--currency", "EUR"]
    allocation(folder, monkeypatch, capsys, *whole)
    header, *lines = path.read_text().splitlines()
    assert header == (
        "Action,Quantity,Symbol,SecType,Exchange,Currency,TimeInForce,OrderType,BasketTag"
    )
    assert all(",STK,SMART,EUR,DAY,MKT,qfolio 2020-09-16" in line for line in lines)
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *of, "--layout", "x") == 2
    assert "--layout is 'x'; choose from generic, ib, alpaca, schwab" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--prices", "--holdings", "--members"])
def test_orders_do_not_replace_an_input(option, folder, monkeypatch, capsys, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("asset,shares\ncash,1\n")
    assert qfolio(monkeypatch, "allocate", folder, option, path, "--orders", path) == 2
    assert f"{option} and --orders name one file" in capsys.readouterr().err
    assert path.exists()


def test_orders_that_cannot_be_written_are_not_recorded(copy, monkeypatch, capsys, tmp_path):
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    of = ["--agent", "equal-weight", "--capital", 1000, "--orders"]
    for place in (tmp_path, ".", copy / "config.json" / "orders.csv"):
        assert qfolio(monkeypatch, "allocate", copy, *AS_OF, *of, place) == 2
        assert "Traceback" not in capsys.readouterr().err
    assert not (copy / "ledger").exists()
    path = tmp_path / "orders.csv"
    monkeypatch.setattr("qfolio.portfolio.desk.desk.Desk.record", lambda *_: 1 / 0)
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, *of, path) == 2
    assert not path.exists()


FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="has no device that is always full")
def test_what_is_recorded_although_it_cannot_be_printed_is_said(copy, tmp_path):
    """And ends with another code than what is refused, of which nothing is recorded."""
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    path = tmp_path / "orders.csv"
    of = [copy, *AS_OF, "--agent", "equal-weight", "--capital", 1000, "--orders", path]
    words = [sys.executable, "-m", "qfolio", "allocate", *map(str, of)]

    def run(*more):
        with FULL.open("w") as full:
            done = subprocess.run(
                [*words, *more], stdout=full, stderr=subprocess.PIPE, text=True, check=False
            )
        return done.returncode, done.stderr

    code, _ = run("--dry-run")
    assert (code, path.exists()) == (2, False)
    code, said = run()
    assert code == 3
    assert said == (
        "qfolio: The allocation cannot be printed (No space left on device). Recorded in the "
        f"ledger as {copy}/ledger/0001.json. {path} has 3 orders.\n"
    )
    assert len(records(copy)) == 1
    assert path.read_text().count("MARKET") == 3


def test_only_assets_that_are_not_shown_are_spoken_of(folder, monkeypatch, capsys, tmp_path):
    holdings = tmp_path / "holdings.csv"
    holdings.write_text("asset,shares\nA,100\n")
    for agent, hidden in (("equal-weight", False), ("buy-and-hold", True)):
        of = ["--holdings", holdings, "--agent", agent, "--dry-run"]
        assert qfolio(monkeypatch, "allocate", folder, *AS_OF, *of) == 0
        assert ("are not shown" in capsys.readouterr().out) == hidden


def test_nothing_to_trade_is_an_empty_file_of_orders(folder, monkeypatch, capsys, tmp_path):
    path, holdings = tmp_path / "orders.csv", tmp_path / "holdings.csv"
    holdings.write_text("asset,shares\nA,100\n")
    of = ["--agent", "buy-and-hold", "--holdings", holdings, "--orders", path]
    allocation(folder, monkeypatch, capsys, *of)
    assert len(path.read_text().splitlines()) == 1
    path.unlink()
    assert allocation(folder, monkeypatch, capsys, *of, "--dry-run")["record"] is None
    assert not path.exists()  # a dry run writes nothing


def test_a_day_without_a_decision_is_named(copy, monkeypatch, capsys, tmp_path):
    """The first allocation is due at once; the second one comes before the first of October."""
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    path = copy / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"calendar": "monthly"}))
    said = "The backtest decides monthly, and would not on 2020-09-26; its latest decision was due"
    of = ["--agent", "equal-weight", "--capital", 1000]
    assert qfolio(monkeypatch, "allocate", copy, *AS_OF, *of) == 0
    assert "decides monthly" not in capsys.readouterr().out
    for rows, last in ((270, "2020-09-26"), (275, "2020-10-01")):
        newer = write_table(tmp_path / f"{rows}.csv", rows=rows)
        options = ["--prices", newer, "--as-of", last, *of]
        assert qfolio(monkeypatch, "allocate", copy, *options) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert (f"{said} on 2020-09-01." in printed) == (rows == 270)


def test_a_holding_within_the_band_is_said_to_stay(copy, monkeypatch, capsys, tmp_path):
    path, holdings = copy / "config.json", tmp_path / "holdings.csv"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"calendar": "drift:0.6"}))
    holdings.write_text("asset,shares\nA,1\nB,1\nC,1\n")
    options = [*AS_OF, "--agent", "equal-weight", "--holdings", holdings]
    assert qfolio(monkeypatch, "allocate", copy, *options) == 0
    said = "Nothing is ordered: no weight is more than 0.6 from what is wanted."
    assert said in " ".join(capsys.readouterr().out.split())
    # Here the capital is too small for a share, whatever the band.
    path.write_text(json.dumps(json.loads(path.read_text()) | {"calendar": "drift:0.01"}))
    options = [*AS_OF, "--agent", "equal-weight", "--capital", 1, "--whole-shares", "--dry-run"]
    assert qfolio(monkeypatch, "allocate", copy, *options) == 0
    said = "every trade is less than a whole share or lot, or costs more than it moves."
    assert said in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_a_budget_of_the_year_is_that_of_the_ledger(tmp_path, monkeypatch, capsys):
    prices, mandate = write_table(tmp_path / "prices.csv"), tmp_path / "mandate.toml"
    mandate.write_text("[trading]\nturnover_a_year = 0.9\nfill = 3\n")
    run = tmp_path / "run"
    options = [*TINY_BACKTEST, "--mandate", mandate, "--out", run]
    assert qfolio(monkeypatch, "backtest", prices, *options) == 0
    follow = ["allocate", run, *AS_OF, "--agent", "equal-weight", "--json", "--anyway"]
    capsys.readouterr()
    assert qfolio(monkeypatch, *follow, "--capital", 1000) == 0
    printed = capsys.readouterr()
    first = json.loads(printed.out)
    assert "fills orders over 3 rows" in printed.err
    assert "orders have used 0.0% this year, and this one uses 90.0%" in printed.err
    assert "The expected cost is that of all parts" in printed.err
    assert first["spent"] == 0
    assert sum(row["weight"] for row in first["assets"]) == pytest.approx(0.9)  # the whole order
    # A row later one of three parts is filled, and then another one.
    later = [each for each in follow if each not in AS_OF] + ["--dry-run", "--capital", 1000]
    for rows, spent in ((261, 0.3), (262, 0.6), (263, 0.9)):
        table = write_table(tmp_path / f"{rows}.csv", rows=rows)
        day = str(np.datetime64("2020-01-01") + rows - 1)
        assert qfolio(monkeypatch, *later, "--prices", table, "--as-of", day) == 0
        assert json.loads(capsys.readouterr().out)["spent"] == pytest.approx(spent)
    newer = write_table(tmp_path / "newer.csv", rows=270)
    options = ["--prices", newer, "--as-of", "2020-09-26", "--capital", 1000]
    assert qfolio(monkeypatch, *(each for each in follow if each not in AS_OF), *options) == 0
    second = json.loads(capsys.readouterr().out)
    assert second["spent"] == pytest.approx(0.9)
    assert all(row["weight"] == 0 for row in second["assets"])
    assert qfolio(monkeypatch, "allocate", run, "--reproduce", second["date"], "--json") == 0
    assert json.loads(capsys.readouterr().out)["assets"] == second["assets"]
    assert qfolio(monkeypatch, "follow", run, "--prices", newer) == 0


def test_an_allocation_in_hindsight_is_not_recorded(copy, monkeypatch, capsys, tmp_path):
    """Its policy has learned from prices up to 2020-09-16."""
    shutil.rmtree(copy / "ledger", ignore_errors=True)
    earlier = write_table(tmp_path / "earlier.csv", rows=250)
    options = ["--prices", earlier, "--as-of", "2020-09-06", "--capital", 1000]
    assert qfolio(monkeypatch, "allocate", copy, *options, "--agent", "pathwise") == 2
    hindsight = "learned from prices up to 2020-09-16, which were not known on 2020-09-06"
    printed = capsys.readouterr().err
    assert f"{hindsight}; give later prices, or add --anyway" in printed
    assert qfolio(monkeypatch, "allocate", copy, *options, "--anyway", "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["record"] is None
    assert f"{hindsight}, so that nothing is recorded." in " ".join(printed.err.split())
    assert not (copy / "ledger").exists()
    assert qfolio(monkeypatch, "allocate", copy, *options, "--agent", "equal-weight") == 0
    assert len(records(copy)) == 1  # a baseline has learned nothing
