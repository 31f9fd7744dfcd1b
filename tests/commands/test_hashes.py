"""Python hashes text differently in each process, and so orders sets: no result depends on it."""

import os
import subprocess
import sys

import pytest

from jobs import LIMIT
from shell import TINY, TINY_BACKTEST
from tables import write_table

TIMED = {"config.json", "events.jsonl", "report.html"}
"""Files that say when the work began, or how long it took."""


@pytest.mark.parametrize(
    ("command", "timed"),
    [
        (["train", "pendulum", "--no-compare", "--episodes", 8, "--seeds", 2, *TINY],
         TIMED | {"checkpoint.safetensors", "summary.json"}),
        (["backtest", "prices.csv", *TINY_BACKTEST], TIMED),
    ],
    ids=["train", "backtest"],
)  # fmt: skip
def test_two_processes_write_the_same_bytes(command, timed, tmp_path):
    """Each compiles all programs itself."""
    write_table(tmp_path / "prices.csv")
    names = ("0", "1")
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "qfolio", *map(str, command), "--out", name],
            cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONHASHSEED": name,
                 "JAX_COMPILATION_CACHE_DIR": str(tmp_path / f"programs{name}")},
        )
        for name in names
    ]  # fmt: skip
    for process in running:
        _, err = process.communicate(timeout=LIMIT)
        assert process.returncode == 0, err
    first, second = (
        {
            str(path.relative_to(tmp_path / name)): path.read_bytes()
            for path in (tmp_path / name).rglob("*")
            if path.is_file() and path.name not in timed
        }
        for name in names
    )
    assert first
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
