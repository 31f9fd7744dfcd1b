"""The command line as a test types it."""

import sys

import pytest

from qfolio.cli import run

TINY = ["--set", "hidden=8", "num_envs=2", "batch_size=8", "learning_starts=16",
        "episode_steps=0", "horizon=20"]  # fmt: skip


def qfolio(monkeypatch, *arguments):
    """The command's exit code; what it printed is in capsys."""
    monkeypatch.setattr(sys, "argv", ["qfolio", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit:
        run()
    return exit.value.code
