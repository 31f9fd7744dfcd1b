import csv
import json
import shutil

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.folder import BacktestFolder
from qfolio.portfolio.backtest.run import Backtest

from shell import qfolio
from tables import write_table

TINY = ["--set", "window=10", "horizon=20", "hidden=8,8", "num_envs=4", "rollout_length=10"]
AS_OF = ["--as-of", "2020-09-16"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished backtest, made by the command."""
    place = tmp_path_factory.mktemp("backtests")
    prices = write_table(place / "prices.csv")
    with pytest.MonkeyPatch.context() as monkeypatch:
        code = qfolio(
            monkeypatch, "backtest", prices, "--agents", "pathwise", "--train", "100d", "--test",
            "80d", "--seeds", 2, "--episodes", 24, "--out", place / "run", *TINY,
        )  # fmt: skip
    assert code == 0
    return place / "run"


def test_backtest_writes_the_whole_folder(folder):
    assert {path.name for path in folder.iterdir()} == {
        "config.json", "prices.safetensors", "policies", "returns.csv", "weights.csv",
        "summary.json", "why.json", "training", "wealth.png", "report.html", "events.jsonl",
    }  # fmt: skip
    config = json.loads((folder / "config.json").read_text())
    assert config["cost"] == pytest.approx(0.001)
    task = config["agents"]["pathwise"]["task"]
    assert (task["window"], task["horizon"]) == (10, 20)
    assert config["command"].startswith("qfolio backtest ")
    assert "equal-weight" in (folder / "report.html").read_text()


def test_a_backtest_shows_itself_in_a_notebook(folder):
    backtest = Backtest.open(folder)
    shown = backtest._repr_html_()
    assert "Backtest of pathwise" in shown
    measures = json.loads((folder / "summary.json").read_text())["strategies"]
    growth = measures["equal-weight"]["measures"]["growth"]["mean"]
    assert f"<td>equal-weight</td><td>{100 * growth:.1f} %</td>" in shown
    assert "equal-weight at" not in shown  # the other speeds of rebalancing


def test_resuming_a_finished_backtest_reports_again(folder, monkeypatch, capsys):
    before = (folder / "returns.csv").read_text()
    assert qfolio(monkeypatch, "backtest", "--resume", folder) == 0
    assert (folder / "returns.csv").read_text() == before
    assert "equal-weight" in capsys.readouterr().out


def test_backtest_explains_its_agents(folder):
    why = Why.read(BacktestFolder(folder).read_why())
    assert list(why.agents) == ["pathwise-together"]
    with (folder / "returns.csv").open() as file:
        returns = [float(row["pathwise-together"]) for row in csv.DictReader(file)]
    parts = why.agents["pathwise-together"].decomposition
    assert parts.net == pytest.approx(365 * np.mean(returns), abs=1e-12)
    assert parts.static + parts.timing - parts.cost == pytest.approx(parts.net, abs=1e-12)
    assert json.loads((folder / "summary.json").read_text())["diagnosis"] == why.diagnosis
    page = (folder / "report.html").read_text()
    assert "that pathwise-together earned" in page
    assert all(sentence in page for said in why.diagnosis.values() for sentence in said)
    with pytest.raises(QfolioError, match="damaged"):
        Why.read({"agents": {}})


def allocation(folder, monkeypatch, capsys, *options):
    capsys.readouterr()
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, "--json", *options) == 0
    return json.loads(capsys.readouterr().out)


def test_allocate_from_cash(folder, monkeypatch, capsys):
    plan = allocation(folder, monkeypatch, capsys, "--capital", 10_000)
    assert plan["wealth"] == 10_000
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--capital", 1], "stale"), ([*AS_OF], "nothing to allocate"),
        ([*AS_OF, "--capital", -1], "at least 0"), ([*AS_OF, "--agent", "dqn"], "no agent 'dqn'"),
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
    (copy / "summary.json").write_text('{"strategies": {"pathwise": 1}}')
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
    assert "without 'C' and with 'D'" in capsys.readouterr().err


def test_the_check_of_prices(monkeypatch, capsys, tmp_path):
    good = write_table(tmp_path / "good.csv")
    assert qfolio(monkeypatch, "prices", good) == 0
    assert "260 rows of 3 assets" in capsys.readouterr().out
    lines = good.read_text().splitlines()
    lines[5] = lines[5].rsplit(",", 1)[0] + ",-3"
    bad = tmp_path / "bad.csv"
    bad.write_text("\n".join(lines))
    assert qfolio(monkeypatch, "prices", bad) == 2
    printed = capsys.readouterr().out
    assert "row 6 (2020-01-05), column 'C'" in printed
    assert "negative" in printed


def test_the_check_of_prices_guesses_at_splits_and_escapes_names(monkeypatch, capsys, tmp_path):
    path = write_table(tmp_path / "prices.csv", names=("A", "B", "\x1b[2J\u202eC"))
    rows = [line.split(",") for line in path.read_text().splitlines()]
    factor = 0.5 * float(rows[199][1]) / float(rows[200][1])
    for row in rows[200:]:
        row[1] = str(factor * float(row[1]))
    path.write_text("\n".join(map(",".join, rows)))
    assert qfolio(monkeypatch, "prices", path, "--features", rows[0][3]) == 0
    printed = capsys.readouterr().out
    assert "close to 1/2: perhaps a split that was not adjusted. If so, use adj" in printed
    assert "0 errors, 1 warning, 0 notes." in printed
    assert "Features: \\x1b[2J\\u202eC." in printed
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, "prices", "\x1b[2J.csv") == 2
    assert "\\x1b[2J.csv' cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["nothing.csv"], "nothing.csv"), (["--agents", "dqm"], "no agent"),
        (["--agents", "dqn,dqn"], "twice"), (["--agents", ""], "at least one agent"),
        (["--preset", "quick"], "no preset"), (["--set", "lag=2"], "options of their own"),
        (["--set", "dqn.windw=2"], "has this setting"), (["--train", "90y"], "nothing to test"),
        (["--seeds", "0"], "seeds is 0"), (["--cost-bps", "-5"], "--cost-bps is -5"),
        (["--on", "procesess:4"], "--on is 'procesess:4'; it must be here, processes:4"),
        (["--on", "processes:0"], "--on is 'processes:0'; give a number of processes"),
    ],
)  # fmt: skip
def test_backtests_that_are_refused(monkeypatch, capsys, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, "backtest", *options, "--out", tmp_path / "run") == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed
    assert not (tmp_path / "run").exists()
