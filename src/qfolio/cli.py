"""The entry point; slow imports are left to the commands that need them."""

import os
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from qfolio.core.text import printable
from qfolio.experiments.interrupts import EXIT_CODE, exit_on_ctrl_c

OUT_OF_MEMORY = "There is too little memory for these settings; lower batch_size, hidden or seeds."


def main() -> NoReturn:
    """Runs the program; Ctrl-C ends it at once, or after the current chunk of a training."""
    exit_on_ctrl_c()
    run()


def commands() -> dict[str, Callable[..., Any]]:
    """All commands by name."""
    from qfolio.commands.allocation import allocate, follow
    from qfolio.commands.board import board
    from qfolio.commands.comparison import compare
    from qfolio.commands.continual import continual
    from qfolio.commands.portfolio import backtest, prices
    from qfolio.commands.report import report
    from qfolio.commands.study import study
    from qfolio.commands.training import evaluate, train, watch
    from qfolio.commands.tuning import tune

    return {
        "backtest": backtest, "allocate": allocate, "follow": follow, "prices": prices,
        "study": study, "train": train, "compare": compare, "evaluate": evaluate, "watch": watch,
        "tune": tune, "continual": continual, "board": board, "report": report,
    }  # fmt: skip


def run() -> NoReturn:
    """Runs the command line; a QfolioError becomes one sentence and exit code 2."""
    import tyro

    from qfolio.core.errors import QfolioError

    try:
        try:
            tyro.extras.subcommand_cli_from_dict(
                commands(),
                prog="qfolio",
                description="Reinforcement learning for portfolio optimization, "
                "graded against exact optima.",
            )
        finally:
            sys.stdout.flush()  # here, where a broken pipe is expected
    except QfolioError as error:
        _refuse(str(error))
    except BrokenPipeError:  # such as: qfolio prices table.csv | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # discards the rest
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _refuse(f"{where}{error.strerror or error}.")
    except MemoryError:
        _refuse(OUT_OF_MEMORY)
    except RuntimeError as error:  # jax's own, which cannot be imported here
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        _refuse(OUT_OF_MEMORY)
    except KeyboardInterrupt:
        print("qfolio: interrupted", file=sys.stderr)
        sys.exit(EXIT_CODE)
    sys.exit(0)


def _refuse(sentence: str) -> NoReturn:
    print(f"qfolio: {printable(sentence)}", file=sys.stderr)
    sys.exit(2)
