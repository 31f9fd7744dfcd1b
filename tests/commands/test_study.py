import json

import pytest

from qfolio.commands.study import _numbers, _tables
from qfolio.portfolio.study.run import Study

from shell import TINY_BACKTEST, qfolio, succeed
from tables import write_table


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Two tables, one that is too short, and a finished study of them made by the command."""
    place = tmp_path_factory.mktemp("studies")
    one = write_table(place / "one.csv", rows=160)
    two = write_table(place / "two.csv", rows=160, seed=1)
    short = write_table(place / "short.csv", rows=100, seed=2)
    succeed("study", one, f"other={two}", short, *TINY_BACKTEST, "--out", place / "run")
    return place


def test_the_command_writes_the_whole_folder(place):
    folder = place / "run"
    assert {path.name for path in folder.iterdir()} == {
        "study.json", "study.csv", "report.html", "tables", "events.jsonl",
    }  # fmt: skip
    study = Study.open(folder)
    assert list(study.config.tables) == ["one", "other"]
    assert [each.name for each in study.config.variants] == ["lag1-10bp"]
    assert (folder / "tables/other/lag1-10bp/report.html").exists()
    why = json.loads((folder / "tables/other/lag1-10bp/why.json").read_text())
    assert list(why["agents"]) == ["pathwise"]
    assert study.config.result is not None
    assert study.config.result.looks == 2
    page = (folder / "report.html").read_text()
    assert "short is left out." in page
    assert 'href="tables/one/lag1-10bp/report.html"' in page
    task = study.backtest("one").config.agents["pathwise"].task
    assert (task["window"], task["horizon"]) == (10, 20)


def test_resuming_a_finished_study_reports_again(place, monkeypatch, capsys):
    before = json.loads((place / "run/study.json").read_text())
    (place / "run/report.html").unlink()
    assert qfolio(monkeypatch, "study", "--resume", place / "run") == 0
    printed = capsys.readouterr().out
    assert "short is left out: 100 rows" in printed
    assert "No evidence that pathwise beats equal-weight in growth after costs" in printed
    assert "This study took 2 looks." in printed
    assert json.loads((place / "run/study.json").read_text()) == before
    assert (place / "run/report.html").exists()
    for words in (["--lags", "3"], ["--seed=0"], ["--cost-bps", 10]):  # defaults, too
        assert qfolio(monkeypatch, "study", "--resume", place / "run", *words) == 2
        assert "--resume keeps the study's settings" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "needs at least one table; name its file"),
        (["nothing.csv"], "nothing.csv"),
        (["one.csv", "one=two.csv"], "one.csv and two.csv are both called one"),
        (["one.csv", "again=one.csv"], "one and again are the same table"),
        (["one.csv", "--agents", "dqm"], "no agent"),
        (["one.csv", "--lags", "one"], "--lags is 'one'; it must be numbers"),
        (["one.csv", "--lags", "1.5"], "--lags has 1.5; lags are whole numbers"),
        (["one.csv", "--costs-bps", "9999"], "--costs-bps is 9999"),
        (["one.csv", "--after", "nowhere"], "nowhere is no study"),
        (
            ["one.csv", "--train", "80d", "--test", "40d", "--benchmark", "Z"],
            "one: The benchmark 'Z' is no baseline",
        ),
        (["one.csv", "--strategy", "mine"], "it must be NAME=FILE"),
        (["one.csv", "--train", "80d", "--test", "40d", "--mandate", "none.toml"], "none.toml"),
        (["short.csv", "--train", "80d", "--test", "40d"], "short is too short: 100 rows"),
    ],
)
def test_studies_that_are_refused(place, monkeypatch, capsys, tmp_path, options, message):
    monkeypatch.chdir(place)
    assert qfolio(monkeypatch, "study", *options, "--out", tmp_path / "run") == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed
    assert len(printed.splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_strategies_benchmark_and_mandate_hold_for_every_table(
    place, monkeypatch, capsys, tmp_path
):
    (tmp_path / "mine.csv").write_text("date,A,B\n2020-01-05,0.4,0.4\n")
    (tmp_path / "mandate.toml").write_text("[assets]\ncap = 0.5\n")
    code = qfolio(
        monkeypatch, "study", place / "one.csv", place / "two.csv", *TINY_BACKTEST,
        "--strategy", f"mine={tmp_path / 'mine.csv'}", "--benchmark", "A",
        "--mandate", tmp_path / "mandate.toml", "--out", tmp_path / "run",
    )  # fmt: skip
    assert code == 0
    printed = capsys.readouterr().out
    assert "pathwise beats A in growth after costs over 2 tables" in printed
    assert "best rebalancing of A" not in printed
    for table in ("one", "two"):
        config = Study.open(tmp_path / "run").backtest(table).config
        assert (config.strategies, config.benchmark) == (("mine", "A"), "A")
        assert config.mandate is not None
        assert config.mandate.assets.cap == 0.5


def test_lags_and_costs_are_lists_beside_the_main_value():
    assert _numbers("--costs-bps", "20, 10,50", 10.0) == [10, 20, 50]
    assert _numbers("--lags", None, 2) == [2]


def test_tables_are_called_as_their_files_in_any_script():
    files = ("bo\u0308rse.csv", "株価.csv", "指数=index.csv", "u\u0308=eu.csv", "S&P 500.csv")
    assert list(_tables(files, str)) == ["b\u00f6rse", "株価", "指数", "\u00fc", "S-P-500"]


def test_a_folder_has_one_configuration(place, monkeypatch, capsys):
    again = ["study", place / "two.csv", *TINY_BACKTEST, "--out", place / "run"]
    assert qfolio(monkeypatch, *again) == 2
    assert "is not empty" in capsys.readouterr().err
