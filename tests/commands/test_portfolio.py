import csv
import json
import math
import shutil

import numpy as np
import pandas as pd
import pytest

from qfolio.commands.backtesting import Options
from qfolio.core.errors import QfolioError
from qfolio.core.text import figure
from qfolio.experiments.presets import preset
from qfolio.portfolio.backtest.attribution.why import Why
from qfolio.portfolio.backtest.folder import BacktestFolder
from qfolio.portfolio.backtest.run import Backtest
from qfolio.report.backtest.finish import finish

from shell import qfolio
from tables import days, write_table


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
    assert f"<td>equal-weight</td><td>{figure(growth, '.1%')}</td>" in shown
    assert "equal-weight at" not in shown  # the other speeds of rebalancing


def test_a_notebook_shows_a_measure_that_is_none_as_a_dash(folder, monkeypatch):
    measures = {"growth": -0.05, "sharpe": math.nan, "turnover": 0.0, "drawdown": 0.25}
    monkeypatch.setattr(BacktestFolder, "read_measures", lambda folder: {"idle": measures})
    cells = "".join(f"<td>{cell}</td>" for cell in ("idle", "−5.0%", "–", "0.0", "25.0%"))
    assert cells in Backtest.open(folder)._repr_html_()


def test_python_finishes_a_backtest_as_the_command_does(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    written = {"returns.csv", "weights.csv", "summary.json", "why.json", "wealth.png"}
    for name in ("report.html", *written):
        (copy / name).unlink()
    found = finish(Backtest.open(copy))
    assert (copy / "report.html").is_file()
    for name in written:
        assert (copy / name).read_bytes() == (folder / name).read_bytes(), name
    assert "pathwise" in found.assessment.strategies
    assert set(found.entries) == set(found.assessment.strategies)
    kept = Backtest.open(folder)
    without = Backtest.create(
        kept.prices, {"tilts": preset("fast", "portfolio", "tilts")}, train="100d", test="50d"
    )
    with pytest.raises(QfolioError, match=r"no folder to write to; create it with out="):
        finish(without)


def test_resuming_a_finished_backtest_reports_again(folder, monkeypatch, capsys):
    before = (folder / "returns.csv").read_text()
    assert qfolio(monkeypatch, "backtest", "--resume", folder, "--json") == 0
    assert (folder / "returns.csv").read_text() == before
    out, err = capsys.readouterr()
    reported = json.loads(out)
    assert reported["report"] == str(folder / "report.html")
    assert "equal-weight" in reported["strategies"]
    assert "equal-weight" in err


@pytest.mark.slow
def test_a_backtest_goes_on_and_its_ledger_is_still_reproduced(
    folder, monkeypatch, capsys, tmp_path
):
    run, prices = shutil.copytree(folder, tmp_path / "run"), write_table(tmp_path / "p.csv", 280)
    before = (run / "returns.csv").read_text()
    asked = ["allocate", run, "--capital", 1000, "--as-of", "2020-09-16", "--anyway"]
    assert qfolio(monkeypatch, *asked) == 0
    assert qfolio(monkeypatch, "backtest", prices, "--resume", run, "--cap", 0.5) == 2
    assert "--resume keeps the backtest's settings" in capsys.readouterr().err
    assert qfolio(monkeypatch, "backtest", prices, "--resume", run) == 0
    after = (run / "returns.csv").read_text()
    assert after.startswith(before)
    assert after.count("\n") == before.count("\n") + 20
    assert qfolio(monkeypatch, "allocate", run, "--reproduce", "2020-09-16") == 0
    capsys.readouterr()
    assert qfolio(monkeypatch, "follow", run, "--json") == 0
    assert json.loads(capsys.readouterr().out)["rows"] == 19  # the first of 20 has the trade


def test_strategies_and_a_benchmark_of_ones_own(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "prices.csv")
    dates = days(260).astype(str)
    index = ["date,level", *(f"{day},{100 + i % 7}" for i, day in enumerate(dates))]
    (tmp_path / "world.csv").write_text("\n".join(index))
    (tmp_path / "mine.csv").write_text("date,A,cash\n2020-06-01,0.5,0.5\n")
    returns = ["date,return", *(f"{day},0.001" for day in dates)]
    (tmp_path / "fund.csv").write_text("\n".join(returns))
    own = ["--strategy", "mine=mine.csv", "--strategy", "fund=fund.csv"]
    tiny = ["--set", "window=10", "horizon=20", "hidden=4", "num_envs=2", "rollout_length=10"]
    options = [
        "prices.csv", "--agents", "pathwise", "--train", "100d", "--test", "80d", "--seeds", 1,
        "--episodes", 4, "--baselines", "momentum", *own, *tiny,
    ]  # fmt: skip
    made = ["backtest", *options, "--benchmark", "world.csv", "--out", "run"]
    assert qfolio(monkeypatch, *made) == 0
    printed = capsys.readouterr().out
    assert "against world, a year" in printed
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["reference"] == "world"
    assert list(summary["verdicts"]) == ["pathwise", "mine", "fund"]
    assert all("world" in sentences[0] for sentences in summary["verdicts"].values())
    assert {name: entry["kind"] for name, entry in summary["strategies"].items()} == {
        "pathwise": "agent", "mine": "strategy", "fund": "strategy", "world": "baseline",
        "equal-weight": "baseline", "momentum": "baseline",
    }  # fmt: skip
    assert summary["strategies"]["mine"]["relative"]["beta"]["over_time"]
    assert summary["strategies"]["fund"]["measures"]["turnover"]["mean"] is None
    assert json.loads((tmp_path / "run" / "why.json").read_text())["reference"] == "world"
    assert "fund" in (tmp_path / "run" / "report.html").read_text()
    for file in ("world.csv", "mine.csv", "fund.csv"):
        (tmp_path / file).unlink()
    before = (tmp_path / "run" / "returns.csv").read_text()
    assert qfolio(monkeypatch, "backtest", "--resume", "run") == 0
    assert (tmp_path / "run" / "returns.csv").read_text() == before
    for more, message in (
        (["--resume", "run", "--benchmark", "A"], "--resume keeps the backtest's settings"),
        (["--resume", "run", "--cost-bps=10"], "--resume keeps the backtest's settings"),
        (["--resume", "run", "--title", ""], "--resume keeps the backtest's settings"),
        ([*options[:-len(own) - len(tiny)], "--strategy", "mine"], "it must be NAME=FILE"),
        ([*options[:-len(own) - len(tiny)], "--benchmark", "Z"], "and no file"),
    ):  # fmt: skip
        assert qfolio(monkeypatch, "backtest", *more) == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
def test_an_agent_may_name_its_preset():
    options = Options(agents="tilts,tilts:low-risk", assignments=("tilts:low-risk.ridge=2",))
    chosen = options.presets()
    assert list(chosen) == ["tilts", "tilts:low-risk"]
    assert [each.task["anchor"] for each in chosen.values()] == [
        "equal-weight", "equal-weight+minimum-variance-nonlinear",
    ]  # fmt: skip
    assert [each.settings.get("ridge") for each in chosen.values()] == [None, 2]
    with pytest.raises(QfolioError, match="no preset 'low-risk' for dqn on portfolio"):
        Options(agents="dqn:low-risk").presets()


def test_backtest_obeys_a_mandate(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "prices.csv")
    (tmp_path / "groups.csv").write_text("asset,sector\nA,Metals\nB,Metals\nC,Energy\n")
    mandate = tmp_path / "mandate.toml"
    options = ["prices.csv", "--agents", "pathwise", "--train", "100d", "--test", "80d", "--seeds",
               1, "--episodes", 4, "--baselines", "momentum", "--mandate", "mandate.toml", "--set",
               "window=10", "horizon=20", "hidden=4", "num_envs=2",
               "rollout_length=10"]  # fmt: skip
    mandate.write_text("[assets]\ncap = 0.1\n[cash]\nmax = 0.5\n")
    assert qfolio(monkeypatch, "backtest", *options, "--out", "run") == 2
    assert "caps of assets (10%) and cash of at most 50% clash" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    mandate.write_text(
        '[assets]\ncap = 0.6\n[groups]\nfile = "groups.csv"\n[groups.sector.Metals]\ncap = 0.3\n'
        '[trading]\ncalendar = "weekly"\n[costs]\nminimum = 1.0\ncash_rate = 0.02\n'
    )
    assert qfolio(monkeypatch, "backtest", *options, "--out", "run") == 0
    page = (tmp_path / "run" / "report.html").read_text()
    for said in (
        "groups.sector.Metals.cap = 0.3",
        "itemized(minimum=1.0, cash_rate=0.02)",
        "on the first day of each week",
        "Table of growth by capital",
    ):
        assert said in page
    with (tmp_path / "run" / "returns.csv").open() as file:
        cash = [float(row["risk_free"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose(cash, math.expm1(0.02 / 365), rtol=1e-3)
    capsys.readouterr()
    for file in (mandate, tmp_path / "groups.csv"):
        file.unlink()
    asked = ["run", "--capital", 1000, "--as-of", "2020-09-16", "--anyway", "--json"]
    assert qfolio(monkeypatch, "allocate", *asked) == 0
    weights = {row["asset"]: row["weight"] for row in json.loads(capsys.readouterr().out)["assets"]}
    assert weights["A"] + weights["B"] <= 0.3 + 1e-5


def test_returns_give_no_share_prices(monkeypatch, capsys, tmp_path):
    """Their levels start at 100, and no number of shares can be bought at them."""
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "prices.csv")
    prices = pd.read_csv("prices.csv", index_col=0)
    prices.pct_change().iloc[1:].to_csv("returns.csv")
    options = ["returns.csv", "--returns", "fraction", "--agents", "pathwise", "--train", "100d",
               "--test", "80d", "--seeds", 1, "--episodes", 4, "--baselines", "buy-and-hold",
               "--set", "window=10", "horizon=20", "hidden=4", "num_envs=2",
               "rollout_length=10"]  # fmt: skip
    assert qfolio(monkeypatch, "backtest", *options, "--out", "run") == 0
    asked = ["run", "--capital", 1000, "--as-of", "2020-09-16", "--anyway"]
    for more in (["--whole-shares"], ["--orders", "orders.csv"]):
        assert qfolio(monkeypatch, "allocate", *asked, *more) == 2
        assert "Returns give no share prices" in " ".join(capsys.readouterr().err.split())
    assert qfolio(monkeypatch, "allocate", *asked) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.strip().startswith("A ")]
    assert line.split()[1] == line.split()[-1] == "–"
    # Prices of the same assets may be given for it.
    given = ["--prices", "prices.csv", "--whole-shares"]
    assert qfolio(monkeypatch, "allocate", *asked, *given) == 0


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
    assert "pathwise-together earned" in page
    assert why.diagnosis == {}  # it trades, and listens to its observations
    with pytest.raises(QfolioError, match="damaged"):
        Why.read({"agents": {}})


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
        (["--agents", "tilts,tilts:fast"], "tilts and tilts:fast, which have the same settings"),
        (["--agents", "", "--set", "window=2"], "at least one agent"),
        (["--preset", "quick"], "no preset"), (["--set", "lag=2"], "options of their own"),
        (["--set", "dqn.windw=2"], "has this setting"), (["--train", "90y"], "nothing to test"),
        (["--set", "dqm.window=2"], "no agent is named dqm; did you mean"),
        (["--train", "20d"], "a longer --train in a backtest), or lower window or horizon"),
        (["--seeds", "0"], "seeds is 0"), (["--cost-bps", "-5"], "--cost-bps is -5"),
        (["--on", "procesess:4"], "'procesess:4' names no executor; it must be here, processes:4"),
        (["--on", "processes:0"], "'processes:0' names no executor; give a number of processes"),
    ],
)  # fmt: skip
def test_backtests_that_are_refused(monkeypatch, capsys, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, "backtest", *options, "--out", tmp_path / "run") == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed
    assert not (tmp_path / "run").exists()
