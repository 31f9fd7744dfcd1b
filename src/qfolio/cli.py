"""The entry point; jax is imported only by commands that compute."""

import sys
from collections.abc import Callable
from typing import Any, NoReturn

import tyro

from qfolio.commands.arguments import INTERRUPTED
from qfolio.commands.comparison import compare
from qfolio.commands.continual import continual
from qfolio.commands.portfolio import allocate, backtest, prices
from qfolio.commands.training import evaluate, train, watch
from qfolio.commands.tuning import tune
from qfolio.core.errors import QfolioError

OUT_OF_MEMORY = "There is too little memory for these settings; lower batch_size, hidden or seeds."


def main() -> NoReturn:
    """The entry point: errors meant for people become one sentence and exit code 2."""
    commands: dict[str, Callable[..., Any]] = {
        "backtest": backtest, "allocate": allocate, "prices": prices,
        "train": train, "compare": compare, "evaluate": evaluate, "watch": watch, "tune": tune,
        "continual": continual,
    }  # fmt: skip
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands,
            prog="qfolio",
            description="Reinforcement learning for portfolio optimization, "
            "graded against exact optima.",
        )
    except QfolioError as error:
        print(f"qfolio: {error}", file=sys.stderr)
        sys.exit(2)
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
        sys.exit(INTERRUPTED)
    sys.exit(0)
