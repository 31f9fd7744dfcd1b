import csv
import json

import numpy as np
import pytest

from shell import qfolio

TINY = ["--set", "window=10", "horizon=20", "hidden=8,8", "num_envs=4", "rollout_length=10"]
AS_OF = ["--as-of", "2020-09-16"]


def write_table(path, rows=260, names=("A", "B", "C"), scale=1.0):
    rng = np.random.default_rng(0)
    values = 50 * np.exp(np.cumsum(rng.normal(3e-4, 0.01, (rows, 3)), axis=0)) * scale
    dates = np.datetime64("2020-01-01") + np.arange(rows)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["date", *names])
        writer.writerows([day, *row] for day, row in zip(dates, values.tolist(), strict=True))
    return path


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
        "summary.json", "wealth.png", "report.html",
    }  # fmt: skip
    config = json.loads((folder / "config.json").read_text())
    assert config["cost"] == pytest.approx(0.001)
    task = config["agents"]["pathwise"]["task"]
    assert (task["window"], task["horizon"]) == (10, 20)
    assert config["command"].startswith("qfolio backtest ")
    assert "equal-weight" in (folder / "report.html").read_text()


def test_resuming_a_finished_backtest_reports_again(folder, monkeypatch, capsys):
    before = (folder / "returns.csv").read_text()
    assert qfolio(monkeypatch, "backtest", "--resume", folder) == 0
    assert (folder / "returns.csv").read_text() == before
    assert "equal-weight" in capsys.readouterr().out


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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("asset,shares\nD,1\n", "does not know"), ("asset,shares\nA,-1\n", "0 or more"),
        ("asset,shares\nA,x\n", "must be a number"), ("A,1\n", "columns asset and shares"),
        ("asset,shares\nA,1\nA,2\n", "comes twice"), ("", "columns asset and shares"),
        ("asset,shares\ncash,5\n", "leave out one"), ("asset,shares\nA,nan\n", "0 or more"),
    ],
)  # fmt: skip
def test_holdings_that_are_refused(folder, monkeypatch, capsys, tmp_path, content, message):
    path = tmp_path / "holdings.csv"
    path.write_text(content)
    assert qfolio(monkeypatch, "allocate", folder, *AS_OF, "--holdings", path,
                  "--capital", 5) == 2  # fmt: skip
    assert message in capsys.readouterr().err


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["nothing.csv"], "nothing.csv"), (["--agents", "dqm"], "no agent"),
        (["--agents", "dqn,dqn"], "twice"), (["--agents", ""], "at least one agent"),
        (["--preset", "quick"], "no preset"), (["--set", "lag=2"], "options of their own"),
        (["--set", "dqn.windw=2"], "has this setting"), (["--train", "90y"], "nothing to test"),
        (["--seeds", "0"], "seeds is 0"), (["--cost-bps", "-5"], "--cost-bps is -5"),
    ],
)  # fmt: skip
def test_backtests_that_are_refused(monkeypatch, capsys, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, "backtest", *options, "--out", tmp_path / "run") == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed
    assert not (tmp_path / "run").exists()
