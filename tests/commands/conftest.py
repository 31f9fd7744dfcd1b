"""A backtest that several files look at."""

import pytest

from shell import succeed
from tables import write_table

TINY = ["--set", "window=10", "horizon=20", "hidden=8,8", "num_envs=4", "rollout_length=10"]


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A finished backtest, made by the command."""
    place = tmp_path_factory.mktemp("backtests")
    prices = write_table(place / "prices.csv")
    succeed(
        "backtest", prices, "--agents", "pathwise", "--train", "100d", "--test", "80d",
        "--seeds", 2, "--episodes", 24, "--out", place / "run", *TINY,
    )  # fmt: skip
    return place / "run"
