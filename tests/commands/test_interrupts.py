"""Ctrl-C and broken pipes, as a shell sees them."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jobs import alive, wait_until
from shell import qfolio
from tables import write_table

TRAIN = ["train", "pendulum", "--no-compare", "--seeds", "2", "--episodes", "100000",
         "--set", "hidden=8", "num_envs=2", "batch_size=8", "learning_starts=16"]  # fmt: skip


def start(folder, **environment):
    return subprocess.Popen(
        [sys.executable, "-m", "qfolio", *TRAIN, "--out", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )


def test_the_first_ctrl_c_stops_after_the_chunk(tmp_path):
    process = start(tmp_path / "run")
    for _ in range(3):  # what is trained, the heading, and a first point
        assert process.stdout.readline()
    process.send_signal(signal.SIGINT)
    begun = time.perf_counter()
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    resume = f"qfolio train --no-compare --resume {tmp_path / 'run'}"
    assert out.splitlines()[-1] == f"Stopped. Resume with: {resume}"
    assert err == ""
    assert time.perf_counter() - begun < 10  # two seconds where nobody else computes
    assert (tmp_path / "run" / "checkpoint.safetensors").exists()


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_ctrl_c_while_it_compiles(tmp_path, count):
    """With an empty cache; no crash at the exit, and nothing more is done."""
    process = start(tmp_path / "run", QFOLIO_CACHE=str(tmp_path / "cache"))
    for _ in range(2):  # what is trained, and the heading
        assert process.stdout.readline()
    for _ in range(count):
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
    begun = time.perf_counter()
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    resume = f"qfolio train --no-compare --resume {tmp_path / 'run'}"
    assert err in ("", f"qfolio: interrupted. Resume with: {resume}\n")
    if count == 2:
        assert time.perf_counter() - begun < 5


TWICE = """
import signal, time
import qfolio

class Twice(qfolio.Tracker):
    def log(self, values, step):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        time.sleep(60)

class Mine(qfolio.DQN):
    pass
"""


@pytest.mark.parametrize(
    ("words", "resume"),
    [
        (TRAIN, "train --no-compare --resume run"),
        (["tune", "--trials", "2", "--batch", "2", *TRAIN[3:]], "tune --join run"),
        (["compare", "--agents", "dqn,dqn:best", "--seeds", "2"], "compare --resume run"),
        (
            ["continual", "--change", "mass=2", "--agent", "twice:Mine", *TRAIN[3:]],
            "continual --resume run --trust twice",
        ),
    ],
)
def test_a_second_ctrl_c_says_how_to_go_on(words, resume, tmp_path):
    (tmp_path / "twice.py").write_text(TWICE)
    command = [sys.executable, "-m", "qfolio", *words, "--out", "run", "--track", "twice:Twice"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    assert done.stderr == f"qfolio: interrupted. Resume with: qfolio {resume}\n"


@pytest.mark.slow
def test_a_reader_that_leaves(tmp_path):
    """A closed pipe, as ``| head`` leaves it, is no error."""
    with start(tmp_path / "run") as process:
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(timeout=120) == 0
        assert process.stderr.read() == ""


def test_closed_streams_are_no_error(tmp_path):
    """As ``<&- >&- 2>&-`` leaves them; nothing that is printed lands in another file."""
    prices = write_table(tmp_path / "prices.csv", rows=700)
    command = [sys.executable, "-m", "qfolio", "prices", str(prices)]
    for closed in ((1,), (0, 1, 2)):
        done = subprocess.run(
            [sys.executable, "-c", "import os, sys; [os.close(int(n)) for n in sys.argv[1]]; "
             "os.execv(sys.argv[2], sys.argv[2:])", "".join(map(str, closed)), *command],
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_ctrl_c_with_workers(tmp_path, count):
    """A terminal sends it to all processes; none stays, and finished folds do."""
    prices = write_table(tmp_path / "prices.csv", rows=700)
    command = ["backtest", str(prices), "--agents", "pathwise", "--train", "100d", "--test", "40d",
               "--seeds", "2", "--episodes", "20000", "--on", "processes:2", "--set", "window=10",
               "horizon=20", "hidden=8,8", "num_envs=4", "rollout_length=10"]  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "qfolio", *command, "--out", str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    for _ in range(2):  # what is trained, and first progress
        assert process.stdout.readline()
    workers = children(process.pid)
    assert len(workers) >= 2
    for _ in range(count):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(0.01)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    resume = f"qfolio backtest --resume {tmp_path / 'run'} --on processes:2"
    assert err in ("", f"qfolio: interrupted. Resume with: {resume}\n")
    if count == 1:
        assert out.splitlines()[-1] == f"Stopped. Resume with: {resume}"
    wait_until(lambda: not any(map(alive, workers)), seconds=10)


def test_ctrl_c_during_the_report_says_how_to_go_on(folder, monkeypatch, tmp_path):
    run = shutil.copytree(folder, tmp_path / "run")
    written = {name: (run / name).read_bytes() for name in ("returns.csv", "summary.json")}
    for name in ("report.html", *written):
        (run / name).unlink()
    process = subprocess.Popen(
        [sys.executable, "-m", "qfolio", "backtest", "--resume", str(run)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until((run / "returns.csv").exists)  # of all results the first
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err == f"qfolio: interrupted. Resume with: qfolio backtest --resume {run}\n"
    assert not (run / "report.html").exists()
    assert qfolio(monkeypatch, "backtest", "--resume", run) == 0
    assert (run / "report.html").exists()
    assert {name: (run / name).read_bytes() for name in written} == written


def children(parent):
    """The processes that a process has started."""
    threads = Path(f"/proc/{parent}/task").glob("*/children")
    return [int(child) for thread in threads for child in thread.read_text().split()]
