"""A first session with the installed package, far from the checkout: commands, report, Python."""

import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

import qfolio

COMMAND = Path(sys.executable).with_name("qfolio")


def run(*arguments: str, where: str) -> None:
    subprocess.run([COMMAND, *arguments], cwd=where, check=True)


def main() -> None:
    assert Path(qfolio.__file__).is_relative_to(sys.prefix), f"{qfolio.__file__} is not installed"
    assert qfolio.__version__ == version("qfolio")
    with tempfile.TemporaryDirectory() as folder:
        moves = np.random.default_rng(0).normal(3e-4, 0.01, (1000, 3)).cumsum(0)
        days = pd.bdate_range("2020-01-01", periods=len(moves), name="date")
        prices = pd.DataFrame(100 * np.exp(moves), days, ["A", "B", "C"])
        prices.to_csv(Path(folder, "prices.csv"))
        run("--help", where=folder)
        run(
            *("backtest", "prices.csv", "--agents", "tilts", "--train", "2y", "--test", "1y"),
            *("--seeds", "1", "--out", "run"),
            where=folder,
        )
        assert Path(folder, "run", "report.html").stat().st_size > 100_000
        weights = qfolio.Backtest.open(Path(folder, "run")).policy().weights(prices)
        assert abs(sum(weights.values()) - 1) < 1e-6, weights
    print(f"qfolio {qfolio.__version__} works from its wheel; its weights are {weights}.")


if __name__ == "__main__":
    main()
