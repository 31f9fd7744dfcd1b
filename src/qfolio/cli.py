"""The entry point; slow imports are left to the commands that need them."""

import codecs
import functools
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from qfolio.core.text import discard, near, plain_signs, printable
from qfolio.core.version import __version__
from qfolio.experiments.interrupts import EXIT_CODE, exit_on_ctrl_c

SHELLS = ("bash", "zsh", "fish")
"""Shells whose completion can be installed."""

FILES = r"""# Files and folders, where there is nothing else, or only options, to offer.
_qfolio() {
  local cur="${COMP_WORDS[COMP_CWORD]}"
  _tyro_qfolio "$@"
  if [[ "$cur" != -* && $COMP_CWORD -gt 1 && "${COMPREPLY[0]}" =~ ^(-.*)?$ ]]; then
    local IFS=$'\n'
    COMPREPLY=($(compgen -f -- "$cur"))
  fi
}
complete -o filenames -F _qfolio qfolio"""
"""What tyro's completion for bash lacks: it offers an empty word where it knows none."""

ABOUT = """Reinforcement learning for portfolio optimization, graded against exact optima.

Examples:
  qfolio backtest prices.csv     backtest agents on a table of prices
  qfolio train pendulum          train an agent on a task
  qfolio backtest --help         show the options of a command
  qfolio --version               show the version"""


def main() -> NoReturn:
    """Runs the program; Ctrl-C ends it at once, or after the current chunk of a training."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed, as by ">&-": no other file may get its number
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    exit_on_ctrl_c()
    codecs.register_error("qfolio", plain_signs)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="qfolio")  # a file may have an encoding without "·" or "−"
    run()


@functools.cache
def commands() -> dict[str, Callable[..., Any]]:
    """All commands by name, as tyro reads them."""
    from qfolio.commands.allocation import allocate, follow
    from qfolio.commands.board import board
    from qfolio.commands.comparison import compare
    from qfolio.commands.continual import continual
    from qfolio.commands.parsing import grouped
    from qfolio.commands.portfolio import backtest, prices
    from qfolio.commands.report import report
    from qfolio.commands.study import study
    from qfolio.commands.training import evaluate, train, watch
    from qfolio.commands.tuning import tune

    every = (
        backtest, allocate, follow, prices, study, train, compare, evaluate, watch, tune, continual,
        board, report,
    )  # fmt: skip
    return {command.__name__: grouped(command) for command in every}


def run() -> NoReturn:
    """Runs the command line; an error of the user becomes one sentence and exit code 2."""
    from qfolio.core.errors import told

    try:
        try:
            _call(sys.argv[1:])
        finally:
            sys.stdout.flush()  # here, where a broken pipe is expected
    except BrokenPipeError:  # such as: qfolio prices table.csv | head
        discard(sys.stdout)
    except Exception as error:
        try:
            sys.stdout.flush()
        except OSError:  # the output is what failed, as on a full disk
            discard(sys.stdout)
            if isinstance(error, OSError) and not error.filename:
                error.filename = "standard output"
        if (sentence := told(error)) is None:
            raise
        _say(sentence)
        sys.exit(2)
    except KeyboardInterrupt:
        _say("interrupted")
        sys.exit(EXIT_CODE)
    sys.exit(0)


def _call(words: list[str]) -> None:
    """Runs the command that the words name, or shows the commands."""
    if words == ["--version"]:
        print(f"qfolio {__version__}")
        return
    import tyro

    from qfolio.commands.parsing import chosen, summary
    from qfolio.core.errors import QfolioError

    known, name = commands(), words[0] if words else ""
    if name in known:
        _require_usable(words)
        chosen(known[name], name, words[1:])()
        return
    if name and not name.startswith("-"):
        raise QfolioError(f"there is no command {name!r}; {near(name, known)}")
    completing = name in ("--tyro-print-completion", "--tyro-write-completion")
    if name and not completing and name not in ("-h", "--help"):
        raise QfolioError(f"there is no option {name}; give a command (see qfolio --help).")
    if completing:
        _prepare_completion(*words[1:])
    overview = {name: _named(summary(command)) for name, command in known.items()}
    try:
        tyro.extras.subcommand_cli_from_dict(
            known if completing else overview,
            prog="qfolio",
            description=ABOUT,
            args=words or ["--help"],
        )
    except SystemExit as done:
        if completing and words[1:2] == ["bash"] and not done.code:
            _complete_files(*words[2:3])
        raise


def _require_usable(words: list[str]) -> None:
    """Raises QfolioError for names that are not UTF-8, and without a current folder."""
    from qfolio.core.errors import QfolioError
    from qfolio.core.files import require_utf8

    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise QfolioError("The current folder was deleted; change to another.") from None
    for name in (here, *words):
        require_utf8(name)


def _prepare_completion(shell: str = "bash", script: str | None = None, *_: str) -> None:
    """Raises QfolioError for other shells, and makes the folder of the script."""
    from qfolio.core.errors import QfolioError

    if shell not in SHELLS:
        raise QfolioError(f"{shell!r} gets no completion; {near(shell, SHELLS)}")
    if script is not None:
        Path(script).parent.mkdir(parents=True, exist_ok=True)


def _complete_files(script: str | None = None) -> None:
    """Adds to tyro's completion for bash, in a script or as printed, what it lacks."""
    if script is None:
        print(FILES)
        return
    with open(script, "a", encoding="utf-8") as file:
        file.write(f"\n{FILES}\n")


def _named(text: str) -> Callable[[], None]:
    """A command of which only the summary is of interest."""

    def command() -> None: ...

    command.__doc__ = text
    return command


def _say(sentence: str) -> None:
    """Writes to the standard error, if it can be written."""
    try:
        print(f"qfolio: {printable(sentence)}", file=sys.stderr, flush=True)
    except OSError:
        discard(sys.stderr)
