"""The command line as a test types it."""

import sys

import pytest

from qfolio.cli import run

TINY = ["--set", "hidden=8", "num_envs=2", "batch_size=8", "learning_starts=16",
        "episode_steps=0", "horizon=20"]  # fmt: skip

TINY_BACKTEST = [
    "--agents", "pathwise", "--train", "80d", "--test", "40d", "--seeds", 1, "--episodes", 8,
    "--baselines", "equal-weight",
    "--set", "window=10", "horizon=20", "hidden=4", "num_envs=4", "rollout_length=10",
]  # fmt: skip


def qfolio(monkeypatch, *arguments):
    """The command's exit code; what it printed is in capsys."""
    monkeypatch.setattr(sys, "argv", ["qfolio", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit:
        run()
    return exit.value.code


def succeed(*arguments):
    """Runs a command outside of a test, such as in a fixture that many share."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert qfolio(monkeypatch, *arguments) == 0
