"""How commands are typed: --help, --version, --json, and what is said of wrong words."""

import dataclasses
import errno
import inspect
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Annotated, get_args

import pytest
from rich.console import Console
from tyro.conf import Positional

import qfolio
from qfolio.cli import commands
from qfolio.commands import console
from qfolio.commands.arguments import fresh_name
from qfolio.commands.parsing import Document, Failed, description, example, grouped
from qfolio.core.registry import TASKS

from shell import qfolio as typed
from tables import write_table

EVERY = commands()


def helped(part):
    """The options of a command, those in groups included, with their help."""
    for option in inspect.signature(part).parameters.values():
        kind, *marks = get_args(option.annotation)
        if dataclasses.is_dataclass(kind):
            yield from helped(kind)
        else:
            yield option, next(mark.help for mark in marks if getattr(mark, "help", None))


@pytest.mark.parametrize("name", EVERY)
def test_every_option_names_its_default_once(name):
    """But for what must be given, and for switches, which are off."""
    for option, text in helped(EVERY[name]):
        silent = option.default is False or option.default is option.empty
        assert (text.count("(default: ") == 0) if silent else (text.count("(default: ") == 1), text


@pytest.mark.parametrize("name", EVERY)
def test_every_command_has_examples_of_itself(name, monkeypatch, capsys):
    lines = example(EVERY[name])
    assert lines
    assert all(line.startswith(f"qfolio {name}") for line in lines)
    monkeypatch.setenv("COLUMNS", "80")
    assert typed(monkeypatch, name, "--help") == 0
    page = capsys.readouterr().out
    assert all(f"  {line}\n" in page for line in lines)
    assert max(map(len, page.splitlines())) <= 80
    assert description(EVERY[name]) in page


def test_the_help_of_training_names_every_task():
    said = dict((option.name, text) for option, text in helped(EVERY["train"]))["task"]
    assert set(TASKS) <= set(re.findall(r"[\w/-]+", said))


def test_options_are_in_groups(monkeypatch, capsys):
    assert typed(monkeypatch, "backtest", "--help") == 0
    page = capsys.readouterr().out
    titles = ["price", "split", "cost and mandate", "learning", "comparison", "run", "output"]
    places = [page.index(f"{title} options") for title in titles]
    assert places == sorted(places)
    assert places[2] < page.index("--cap FLOAT") < places[3]
    said = " ".join(page.replace("│", " ").split())
    assert "Largest weight of one asset, above 0 and at most 1; a mandate" in said
    assert "may set a cap above 1 instead (default: 1)." in said


@pytest.mark.parametrize("name", EVERY)
def test_every_option_is_in_a_group(name):
    options = inspect.signature(EVERY[name]).parameters.values()
    loose = [option.name for option in options if option.kind is option.KEYWORD_ONLY]
    assert not [option for option in loose if not option.endswith("_options")]


def test_commands_of_the_same_second_have_folders_of_their_own():
    names = {fresh_name("market/kelly", "dqn").as_posix() for _ in range(20)}
    assert len(names) > 15
    assert all(re.fullmatch(r"runs/market-kelly-dqn-\d{8}-\d{6}-[0-9a-f]{4}", x) for x in names)


def test_the_version(monkeypatch, capsys):
    assert typed(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"qfolio {qfolio.__version__}\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["bactest"], "did you mean backtest?"),
        (["xyz"], "choose from backtest, allocate"),
        (["--resume", "runs"], "qfolio: there is no option --resume; give a command"),
        (["backtest", "--bechmark", "x"], "qfolio backtest --help"),
        (["prices", "--missing", "x"], "qfolio prices --help"),
        (["evaluate"], "qfolio evaluate --help"),
        ([], ""),
    ],
)
def test_wrong_words(monkeypatch, capsys, words, said):
    monkeypatch.setenv("COLUMNS", "200")
    assert typed(monkeypatch, *words) == (2 if words else 0)
    printed = capsys.readouterr()
    assert said in printed.err
    assert bool(printed.out) == (not words)


def test_prices_as_json(monkeypatch, capsys, tmp_path):
    good = write_table(tmp_path / "good.csv")
    assert typed(monkeypatch, "prices", good, "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["rows"] == 260
    assert "260 rows of 3 assets" in err
    bad = tmp_path / "bad.csv"
    bad.write_text(good.read_text().replace("2020-01-05,", "2020-01-05,-", 1))
    assert typed(monkeypatch, "prices", bad, "--json") == 2
    found, *_ = json.loads(capsys.readouterr().out)["findings"]
    assert (found["severity"], found["row"]) == ("error", 6)
    assert typed(monkeypatch, "prices", tmp_path / "none.csv", "--json") == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("qfolio: ")
    assert err.count("\n") == 1


REPORTING = [name for name, call in EVERY.items() if "as_json" in str(inspect.signature(call))]


@pytest.mark.parametrize("name", REPORTING)
def test_an_error_leaves_the_json_output_empty(monkeypatch, capsys, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    assert typed(monkeypatch, name, "there-is-none", "--json") == 2
    out, err = capsys.readouterr()
    assert not out
    assert re.fullmatch(r"qfolio: .+[.?]\n", err)
    assert not list(tmp_path.iterdir())


def test_json_holds_any_document(capsys):
    def command(place: Annotated[Positional[Path], ""], *, wrong: bool = False) -> Document:
        """Report."""
        print("a note")
        if wrong:
            raise Failed({"wrong": True})
        return {"place": place, "numbers": [1.5, math.nan, (math.inf,)]}

    call = grouped(command)
    call(place=Path("a"), wrong=False, output_options=Output(True))
    out, err = capsys.readouterr()
    assert json.loads(out) == {"place": "a", "numbers": [1.5, None, [None]]}
    assert err == "a note\n"


class Output:
    def __init__(self, as_json):
        self.as_json = as_json


def test_bash_completes_commands_and_options(monkeypatch, tmp_path):
    script = tmp_path / "new" / "qfolio"
    (tmp_path / "table.csv").touch()
    assert typed(monkeypatch, "--tyro-write-completion", "bash", script) is None
    assert typed(monkeypatch, "--tyro-write-completion", "tcsh", tmp_path / "other") == 2
    for words, completed in (
        (["qfolio", "backt"], "backtest"),
        (["qfolio", "prices", "--miss"], "--missing"),
        (["qfolio", "prices", "--missing", "drop"], "drop-asset"),
        (["qfolio", "prices", f"{tmp_path}/ta"], f"{tmp_path}/table.csv"),
        (["qfolio", "report", f"{tmp_path}/n"], f"{tmp_path}/new"),
    ):
        line = " ".join(words)
        asked = (
            f"source {script}; complete -p qfolio >/dev/null || exit 3; "
            f"COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'; "
            f"COMP_POINT={len(line)}; $(complete -p qfolio | sed 's/.*-F \\([^ ]*\\).*/\\1/'); "
            "echo ${COMPREPLY[@]}"
        )
        found = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, check=True)
        assert completed in found.stdout.split()


def test_a_line_break_in_a_name_is_shown_and_not_obeyed(capsys):
    console.say("", "Report: runs/a\nqfolio: all is well/report.html")
    assert capsys.readouterr().out == "\nReport: runs/a\\nqfolio: all is well/report.html\n"


def test_a_current_folder_that_is_gone_is_told(monkeypatch, capsys):
    def gone():
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    monkeypatch.setattr(os, "getcwd", gone)
    assert typed(monkeypatch, "prices", "prices.csv") == 2
    said = "qfolio: The current folder was deleted; change to another.\n"
    assert capsys.readouterr().err == said


def test_a_name_that_is_not_utf_8_is_refused_at_the_start(monkeypatch, capsys):
    assert typed(monkeypatch, "train", "pendulum", "--out", "runs/\udcff") == 2
    assert capsys.readouterr().err == (
        r"qfolio: 'runs/\udcff' is not UTF-8; rename the file or the folder." "\n"
    )


def test_help_needs_no_docstrings():
    asked = [sys.executable, "-OO", "-m", "qfolio", "backtest", "--help"]
    done = subprocess.run(asked, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--cost-bps" in done.stdout


def test_a_pipe_folds_nothing(capsys):
    row = ("a strategy with a long name", *["-123,456.78%"] * 12)
    console.print_table(("strategy", *["numbers"] * 12), [row])
    assert capsys.readouterr().out.splitlines()[1].split("  ") == [row[0], *row[1:]]


def test_a_narrow_terminal_folds_names_and_cuts_no_number(monkeypatch, capsys):
    narrow = Console(width=50, force_terminal=True, color_system=None)
    monkeypatch.setattr(console, "console", narrow)
    with narrow.capture() as shown:
        console.print_table(("", "growth", "drawdown"), [("a-name-" * 8, "−23.64%", "88.0%")])
    printed = shown.get()
    assert "−23.64%" in printed
    assert "…" not in printed
    with narrow.capture() as shown:  # where numbers alone fill the width
        narrow.width = 20
        console.print_table(("", "growth", "drawdown"), [("a-name", "−123.64%", "88.0%")])
    assert shown.get().splitlines()[1].split() == ["a-name", "−123.64%", "88.0%"]
    narrow.width = 50
    console.tell("A sentence with words that are longer than the terminal is wide, by far.")
    assert capsys.readouterr().out.split("\n")[0].endswith(" longer than the")


def test_a_dumb_terminal_is_told_like_a_file(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(console, "console", Console(force_terminal=True, color_system=None))
    with console.working("Writing"):
        pass
    assert capsys.readouterr().out.startswith("Writing.\n")


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["backtest", "--seeds", "x"], "--seeds is 'x'; it must be a whole number."),
        (["backtest", "--cost-bps", "ten"], "--cost-bps is 'ten'; it must be a number."),
        (["backtest", "--late", "trimm"], "--late is 'trimm'; did you mean trim?"),
        (["backtest", "--late", "x"], "--late is 'x'; choose from error, drop-asset, trim, join."),
        (["backtest", "--returns", "x"],
         "--returns is 'x'; choose from fraction, percent, relative."),
        (["backtest", "--sedes", "2"], "there is no option --sedes; did you mean --seeds?"),
        (["backtest", "a.csv", "b.csv"], "there is no argument b.csv."),
        (["allocate", "run", "--ended", "None"],
         "--ended is 'None'; choose from gap, cash-out."),
        (["follow", "run", "--ended", "cashout"], "--ended is 'cashout'; did you mean cash-out?"),
        (["train", "--seeds"], "--seeds needs a value."),
        (["evaluate"], "PATH is missing: folder of a run."),
    ],
)  # fmt: skip
def test_wrong_words_are_one_sentence_that_names_the_help(
    words, said, terminal, monkeypatch, capsys
):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)  # there, tyro uses colors
    assert typed(monkeypatch, *words) == 2
    assert capsys.readouterr().err == f"qfolio: {said} See qfolio {words[0]} --help.\n"
