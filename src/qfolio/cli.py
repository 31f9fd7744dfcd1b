"""The entry point; jax is imported only by commands that compute."""

import os
import sys
from collections.abc import Callable
from typing import Any, NoReturn

import tyro

from qfolio.commands.comparison import compare
from qfolio.commands.continual import continual
from qfolio.commands.portfolio import allocate, backtest, prices
from qfolio.commands.training import evaluate, train, watch
from qfolio.commands.tuning import tune
from qfolio.core.errors import QfolioError
from qfolio.experiments.interrupts import EXIT_CODE, exit_on_ctrl_c

OUT_OF_MEMORY = "There is too little memory for these settings; lower batch_size, hidden or seeds."


def main() -> NoReturn:
    """The program: Ctrl-C ends it at once, or after the current chunk of a training."""
    exit_on_ctrl_c()
    run()


def run() -> NoReturn:
    """Runs what was typed; errors meant for people become one sentence and exit code 2."""
    commands: dict[str, Callable[..., Any]] = {
        "backtest": backtest, "allocate": allocate, "prices": prices,
        "train": train, "compare": compare, "evaluate": evaluate, "watch": watch, "tune": tune,
        "continual": continual,
    }  # fmt: skip
    try:
        try:
            tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="qfolio",
                description="Reinforcement learning for portfolio optimization, "
                "graded against exact optima.",
            )
        finally:
            sys.stdout.flush()  # here, where a broken pipe is expected
    except QfolioError as error:
        print(f"qfolio: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # such as: qfolio prices table.csv | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nobody reads the rest
        sys.exit(0)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"qfolio: {where}{error.strerror or error}.", file=sys.stderr)
        sys.exit(2)
    except MemoryError:
        print(f"qfolio: {OUT_OF_MEMORY}", file=sys.stderr)
        sys.exit(2)
    except RuntimeError as error:  # jax's own, which cannot be imported here
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print(f"qfolio: {OUT_OF_MEMORY}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("qfolio: interrupted", file=sys.stderr)
        sys.exit(EXIT_CODE)
    sys.exit(0)
