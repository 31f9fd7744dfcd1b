"""qfolio report: pages written again, and printed."""

import shlex
import shutil

import pytest

from qfolio.agents.dqn import DQN
from qfolio.experiments import continual
from qfolio.experiments.budget import Budget
from qfolio.experiments.comparison.run import Comparison, Entrant
from qfolio.experiments.continual import Plan
from qfolio.experiments.tuning import search
from qfolio.experiments.tuning.run import Tuning
from qfolio.portfolio.backtest.baselines.equal_weight import EqualWeight
from qfolio.portfolio.study.run import Study
from qfolio.report import printing
from qfolio.tasks.pendulum import Pendulum

from shell import TINY, TINY_BACKTEST, qfolio, succeed
from tables import price_table, random_walk, write_table
from tiny import PATHWISE


@pytest.fixture(scope="module")
def backtest(tmp_path_factory):
    place = tmp_path_factory.mktemp("backtest")
    prices = write_table(place / "prices.csv", rows=160)
    title = ("--title", "For the <committee>")
    succeed("backtest", prices, *TINY_BACKTEST, *title, "--out", place / "run")
    return place / "run"


def test_a_backtest_is_reported_again(backtest, monkeypatch, capsys):
    page = backtest / "report.html"
    before = page.read_bytes()
    assert b"<h1>For the &lt;committee&gt;</h1>" in before
    others = {path: path.read_bytes() for path in backtest.iterdir() if path.suffix == ".json"}
    page.unlink()
    assert qfolio(monkeypatch, "report", backtest) == 0
    assert page.read_bytes() == before
    assert all(path.read_bytes() == content for path, content in others.items())
    assert str(page) in capsys.readouterr().out.replace("\n", "")


def test_a_pdf_is_printed(backtest, monkeypatch):
    if printing.find_browser() is None:
        pytest.skip("no Chromium found")
    assert qfolio(monkeypatch, "report", backtest, "--pdf") == 0
    content = (backtest / "report.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    pages = content.count(b"/Type /Page\n")
    assert 3 <= pages <= 6


def test_without_a_browser_nothing_is_written(backtest, monkeypatch, capsys):
    monkeypatch.setenv("QFOLIO_CHROMIUM", "no-such-program")
    (backtest / "report.html").unlink(missing_ok=True)
    assert qfolio(monkeypatch, "report", backtest, "--pdf") == 2
    assert "QFOLIO_CHROMIUM is 'no-such-program', which is not a program" in capsys.readouterr().err
    assert not (backtest / "report.html").exists()


def test_an_unfinished_backtest_is_refused(backtest, monkeypatch, capsys, tmp_path):
    copy = shutil.copytree(backtest, tmp_path / "copy")
    shutil.rmtree(copy / "policies")
    assert qfolio(monkeypatch, "report", copy) == 2
    assert f"qfolio backtest --resume {copy}" in capsys.readouterr().err.replace("\n", "")


def test_a_training_is_reported_again(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    assert qfolio(monkeypatch, "train", "pendulum", "--episodes", 4, "--seeds", 1, "--no-compare",
                  "--out", folder, *TINY) == 0  # fmt: skip
    before = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert qfolio(monkeypatch, "report", folder) == 0
    assert (folder / "report.html").read_bytes() == before
    (folder / "summary.json").unlink()
    assert qfolio(monkeypatch, "report", folder) == 2
    assert "qfolio train --resume" in capsys.readouterr().err


@pytest.mark.slow
def test_a_comparison_is_reported_again(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    assert qfolio(monkeypatch, "compare", "finite/cliff", "--agents", "q-learning,sarsa",
                  "--episodes", 20, "--seeds", 2, "--out", folder) == 0  # fmt: skip
    before = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert qfolio(monkeypatch, "report", folder) == 0
    assert (folder / "report.html").read_bytes() == before


@pytest.mark.slow
def test_a_study_is_reported_again(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    tables = [write_table(tmp_path / f"{name}.csv", rows=160, seed=seed)
              for seed, name in enumerate(("one", "two"))]  # fmt: skip
    assert qfolio(monkeypatch, "study", *tables, *TINY_BACKTEST, "--out", folder) == 0
    before = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert qfolio(monkeypatch, "report", folder) == 0
    assert (folder / "report.html").read_bytes() == before


@pytest.mark.parametrize("content", [None, '{"kind": "policy"}', "[1]"])
def test_other_folders_are_refused(tmp_path, monkeypatch, capsys, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    assert qfolio(monkeypatch, "report", tmp_path) == 2
    printed = capsys.readouterr().err
    assert "Traceback" not in printed
    assert str(tmp_path) in printed.replace("\n", "")


class Mine(DQN):
    """An agent of this module, which is no part of qfolio."""


MINE = Mine(hidden=(8,), num_envs=2, batch_size=8, replay_capacity=100, learning_starts=10)
OLD, NEW = Pendulum(horizon=20), Pendulum(horizon=20, mass=2.0)


def begin_comparison(folder):
    entrants = {name: Entrant(OLD, MINE, None, Budget(2)) for name in ("one", "other")}
    Comparison.create(entrants, seeds=1, out=folder)


def begin_search(folder):
    space = search.parse(["discount=0.9..0.99"], Mine)
    Tuning.create(
        OLD, MINE, space, trials=1, seeds=1, budget=Budget(2), batch=1, fresh_seeds=1,
        preset="fast", out=folder,
    )  # fmt: skip


class Alike(EqualWeight):
    """A baseline of this module."""


def begin_study(folder):
    tables = {"one": price_table(random_walk(160, seed=0))}
    Study.create(
        tables, {"pathwise": PATHWISE}, train="80d", test="40d", seeds=1,
        baselines=[f"{__name__}:Alike"], out=folder,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("begin", "command"),
    [
        (begin_study, ["study", "--resume"]),
        (begin_comparison, ["compare", "--resume"]),
        (begin_search, ["tune", "--join"]),
        (
            lambda folder: continual.create(Plan(OLD, NEW, MINE, 2), folder),
            ["continual", "--resume"],
        ),
    ],
)
def test_what_is_not_finished_names_the_command_that_goes_on(
    begin, command, monkeypatch, capsys, tmp_path
):
    """As a shell takes it, with the module to trust."""
    folder = tmp_path / "my run"
    begin(folder)
    assert qfolio(monkeypatch, "report", folder) == 2
    printed = capsys.readouterr()
    assert "Writing" not in printed.out
    said = printed.err.strip().removesuffix(".").partition("; continue with ")[2]
    assert shlex.split(said) == ["qfolio", *command, str(folder), "--trust", __name__]
