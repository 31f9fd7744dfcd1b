"""What README and docs/guides/own_parts.md show is executed, with less to compute."""

import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from qfolio.portfolio.desk.holdings import read_holdings
from qfolio.portfolio.prices.table import load

from shell import qfolio
from tables import write_table

ROOT = Path(__file__).parents[1]


def blocks(page, language):
    """The code blocks of a page, each with the line of text before it."""
    text = (ROOT / page).read_text()
    return re.findall(rf"([^\n]*)\n+```{language}\n(.*?)```", text, re.DOTALL)


def changed(text, **changes):
    """A text with options of commands set to other values: each of them must be there."""
    for name, value in changes.items():
        text, count = re.subn(rf"--{name} \S+", f"--{name} {value}", text)
        assert count, f"{text} has no --{name}"
    return text


@pytest.fixture
def prices(tmp_path, monkeypatch):
    """A table of prices in the current directory."""
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "prices.csv", 400, ("AAPL", "B", "C"))


@pytest.fixture
def own(tmp_path, monkeypatch, prices):
    """The files that the page has its reader write; returns what forgets their modules."""
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    names = []
    for before, code in blocks("docs/guides/own_parts.md", "python"):
        (name,) = re.findall(r"`(\w+)\.py`", before)
        (tmp_path / f"{name}.py").write_text(code)
        names.append(name)
    assert names == ["corridor", "constant", "momentum", "downside", "interest", "trend"]
    yield lambda: [sys.modules.pop(name, None) for name in names]
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_the_page_about_own_parts(own, monkeypatch, capsys):
    shown = "".join(code for _, code in blocks("docs/guides/own_parts.md", "sh")).splitlines()
    corridor, table, merton, rate, backtest, own_backtest, evaluate, resume = shown

    def run(command):
        return qfolio(monkeypatch, *shlex.split(command)[1:])

    assert run(corridor) == 0
    summary = json.loads(Path("runs/corridor/summary.json").read_text())
    assert summary["return_per_seed"] == pytest.approx([0.7] * summary["seeds"])  # 1 − 3 · 0.1
    assert "Q-learning on Corridor" in Path("runs/corridor/report.html").read_text()
    assert run(changed(table, agents="q-learning,sarsa", steps=80, seeds=2)) == 0
    assert run(merton) == 0
    summary = json.loads(Path("runs/merton/summary.json").read_text())
    assert max(summary["regret_per_seed"]) < 0.04
    assert "--resume runs/merton --trust constant" in Path("runs/merton/report.html").read_text()
    assert run(changed(rate, steps=1600, trials=2)) == 0
    few = "--train 200d --test 100d --seeds 1 --episodes 32 --set window=10 horizon=25"
    backtest = backtest.replace("backtest", "backtest prices.csv", 1).replace("--set", few)
    assert run(changed(backtest, agents="constant:Constant")) == 0
    assert "Constant" in Path("runs/backtest/report.html").read_text()
    own_backtest = own_backtest.replace("backtest", "backtest prices.csv", 1).replace("--set", few)
    assert run(own_backtest) == 0
    summary = json.loads(Path("runs/own/summary.json").read_text())
    kinds = {name: entry["kind"] for name, entry in summary["strategies"].items()}
    assert {name for name, kind in kinds.items() if kind != "rebalancing"} == {
        "pathwise", "equal-weight", "minimum-variance", "Momentum"
    }  # fmt: skip
    config = json.loads(Path("runs/own/config.json").read_text())
    task = config["agents"]["pathwise"]["task"]
    assert task["reward"] == "downside:Downside"
    assert task["signals"] == "momentum:120-20,trend:Trend:60"
    policy = [
        "allocate",
        "runs/backtest",
        "--agent",
        "Constant",
        "--as-of",
        "2021-02-04",
        "--capital",
        "1000",
    ]
    opened = [["evaluate", "runs/merton"], ["tune", "--join", "runs/rate"], policy]
    for command in opened:
        own()
        capsys.readouterr()
        assert qfolio(monkeypatch, *command) == 2
        assert "add --trust constant" in capsys.readouterr().err
        assert qfolio(monkeypatch, *command, "--trust", "constant") == 0
    rows = Path("prices.csv").read_text()
    Path("newer.csv").write_text(f"{rows}2021-02-04,50,50,50\n")
    updated = [*policy, "--prices", "newer.csv", "--update", "--trust", "constant", "--anyway"]
    assert qfolio(monkeypatch, *updated) == 0
    own()
    assert qfolio(monkeypatch, "backtest", "--resume", "runs/own") == 2
    assert "--trust" in capsys.readouterr().err
    trusted = ["--trust", "momentum", "downside", "interest", "trend"]
    assert qfolio(monkeypatch, "backtest", "--resume", "runs/own", *trusted) == 0
    own()
    assert run(evaluate) == 0
    own()
    assert run(changed(resume, steps=410_000)) == 0


def test_an_environment_in_the_current_directory(own, monkeypatch, tmp_path):
    (tmp_path / "corridor.py").write_text(
        "import gymnasium\nfrom gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv\n"
        "if 'Own-v0' not in gymnasium.registry:\n"
        "    gymnasium.register('Own-v0', entry_point=CliffWalkingEnv, max_episode_steps=20)\n"
    )
    start = ["train", "gym:corridor:Own-v0", "--agent", "q-learning", "--steps", 80, "--seeds", 1]
    assert qfolio(monkeypatch, *start, "--out", "run") == 0
    own()
    assert qfolio(monkeypatch, "evaluate", "run", "--episodes", 1) == 2
    assert qfolio(monkeypatch, "evaluate", "run", "--episodes", 1, "--trust", "corridor") == 0


TINY = {"hidden": (4,), "num_envs": 4, "rollout_length": 10}
LENGTH = {"horizon": 20}
SMALL = {
    "episodes": 16,
    "settings": {"num_envs": 4, "rollout_length": 20, "head": 5},
    "task": {"window": 1, "signals": "momentum:21", "anchor": "equal-weight", **LENGTH},
}
SMALLER = {
    '"portfolio", "tilts")': '"portfolio", "tilts")._replace(**SMALL)',
    'out="runs/mine")': 'out="runs/mine", train="200d", test="150d", seeds=1)',
    "train_size=1260, test_size=252": "train_size=200, test_size=150",
    "seeds=2, cost=0.001": "seeds=1, episodes=16, window=10, settings=TINY | LENGTH",
}


@pytest.mark.slow
def test_the_examples_of_the_readme(prices, tmp_path):
    table = pd.read_csv("prices.csv", index_col="date")
    returns = table.set_axis(pd.bdate_range("2020-01-01", periods=400)).pct_change().dropna()
    examples = [code for _, code in blocks("README.md", "python")]
    assert len(examples) >= 3
    text = "\n".join(examples)
    for shown, smaller in SMALLER.items():
        assert shown in text
        text = text.replace(shown, smaller)
    names: dict[str, Any] = {"returns": returns, "TINY": TINY, "LENGTH": LENGTH, "SMALL": SMALL}
    exec(compile(text, "README.md", "exec"), names)
    assert (tmp_path / "runs/mine/config.json").exists()
    assert len(names["portfolio"].returns) == 150
    assert names["environment"].reset(seed=0)[1] is not None


def test_the_tables_that_are_shown_are_read(tmp_path):
    """Those of the README and of the page, and their numbers are those of skfolio's table."""
    whole = load().to_frame()
    for page in ("README.md", "docs/guides/tables.md"):
        *tables, held = [code for _, code in blocks(page, "csv")]
        for table in tables:
            path = tmp_path / "prices.csv"
            path.write_text(table)
            shown = load(path).to_frame()
            expected = whole.loc[shown.index, shown.columns].round(2)
            pd.testing.assert_frame_equal(shown, expected, check_names=False)
        path = tmp_path / "holdings.csv"
        path.write_text(held)
        shares, cash = read_holdings(path, ("AAPL", "BAC", "JNJ"), None)
        assert (shares[0], cash) == (120, 2500)
