"""Ctrl-C and broken pipes, as a shell sees them."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from qfolio.experiments.events import EVENTS, read

from jobs import LIMIT, alive, wait_until
from shell import qfolio
from tables import write_table

TRAIN = ["train", "pendulum", "--no-compare", "--seeds", "2", "--episodes", "100000",
         "--set", "hidden=8", "num_envs=2", "batch_size=8", "learning_starts=16"]  # fmt: skip


@pytest.fixture
def start():
    """Starts a command in a group of its own; what a failed test leaves running is killed."""
    with contextlib.ExitStack() as stack:

        def started(*words, program=("-m", "qfolio"), **options):
            process = subprocess.Popen(
                [sys.executable, *program, *map(str, words)],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
                **options,
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield started


def read_heading(process):
    """Reads what is printed until the training begins: more if no optimum has been kept yet."""
    while "greedy" not in (line := process.stdout.readline()):
        assert line, process.stderr.read()


def records(folder):
    """The steps after which something was logged."""
    events, _ = read(folder / EVENTS)
    return [event["step"] for event in events if event["event"] == "record"]


def press(process, count=1):
    """Presses Ctrl-C in a terminal, which all processes of the group get.

    Again only when the last one has arrived, as two at once may become one.
    """
    for _ in range(count):
        os.killpg(process.pid, signal.SIGINT)
        wait_until(lambda: not pending(process.pid))


def pending(process):
    """Whether Ctrl-C has not reached a process yet; unknown where there is no /proc."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False
    masks = [int(line.split()[1], 16) for line in status.splitlines() if "Pnd:" in line]
    return any(mask >> (signal.SIGINT - 1) & 1 for mask in masks)


def test_the_first_ctrl_c_stops_after_the_chunk(start, tmp_path):
    """And long before the first point of the learning curve, which is printed."""
    folder = tmp_path / "run"
    process = start(*TRAIN, "--episodes", 1_000_000, "--out", folder)
    read_heading(process)
    wait_until(lambda: max(records(folder), default=0) > 0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT)
    assert process.returncode == 130, err
    resume = f"qfolio train --no-compare --resume {folder}"
    assert out.splitlines() == [f"Stopped. Resume with: {resume}"]
    assert err == ""
    assert (folder / "checkpoint.safetensors").exists()


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_ctrl_c_while_it_compiles(start, tmp_path, count):
    """No crash at the exit; a second one ends it before anything more is done."""
    folder = tmp_path / "run"
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "programs")}
    process = start(*TRAIN, "--out", folder, env=environment)
    read_heading(process)
    press(process, count)
    out, err = process.communicate(timeout=LIMIT)
    assert process.returncode == 130, err
    resume = f"Resume with: qfolio train --no-compare --resume {folder}\n"
    if count == 1:
        assert (out, err) == (f"Stopped. {resume}", "")
    else:
        assert (out, err) == ("", f"qfolio: interrupted. {resume}")
        assert not any(records(folder))  # beyond the start


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no file is always full here")
def test_a_stream_that_cannot_be_written(tmp_path):
    def ended(*words, **streams):
        done = subprocess.run(
            [sys.executable, "-m", "qfolio", *map(str, words)], text=True,
            env=os.environ | {"PYTHONUNBUFFERED": ""}, **streams,
        )  # fmt: skip
        return done.returncode, done.stderr

    prices = write_table(tmp_path / "prices.csv")
    with open("/dev/full", "w") as full:
        assert ended("prices", "none.csv", stderr=full) == (2, None)
        assert ended("prices", prices, stdout=full, stderr=full) == (2, None)
        assert ended("prices", prices, stdout=full, stderr=subprocess.PIPE) == (
            2, "qfolio: standard output: No space left on device.\n"
        )  # fmt: skip


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
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 130, done.stderr
    assert done.stderr == f"qfolio: interrupted. Resume with: qfolio {resume}\n"
    last = read(tmp_path / "run" / EVENTS)[0][-1]
    assert (last["event"], last["state"]) == ("end", "stopped")


@pytest.mark.slow
def test_a_reader_that_leaves(start, tmp_path):
    """A closed pipe, as ``| head`` leaves it, is no error."""
    process = start(*TRAIN, "--out", tmp_path / "run")
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=LIMIT) == 0
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
            timeout=LIMIT,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_ctrl_c_with_workers(start, tmp_path, count):
    """A terminal sends it to all processes; none stays, and finished folds do."""
    prices = write_table(tmp_path / "prices.csv", rows=700)
    command = ["backtest", prices, "--agents", "pathwise", "--train", "100d", "--test", "40d",
               "--seeds", "2", "--episodes", "20000", "--on", "processes:2", "--set", "window=10",
               "horizon=20", "hidden=8,8", "num_envs=4", "rollout_length=10"]  # fmt: skip
    process = start(*command, "--out", tmp_path / "run")
    for _ in range(2):  # what is trained, and first progress
        assert process.stdout.readline()
    workers = children(process.pid)
    assert len(workers) >= 2
    press(process, count)
    out, err = process.communicate(timeout=LIMIT)
    assert process.returncode == 130, err
    resume = f"qfolio backtest --resume {tmp_path / 'run'} --on processes:2"
    assert err in ("", f"qfolio: interrupted. Resume with: {resume}\n")
    if count == 1:
        assert out.splitlines()[-1] == f"Stopped. Resume with: {resume}"
    wait_until(lambda: not any(map(alive, workers)))


REPORT = """
import sys
from qfolio import cli
from qfolio.report.backtest import finish

def wait(*args):
    print("here", flush=True)
    sys.stdin.read()

finish.write_backtest_report = wait
cli.main()
"""
"""The program, which waits for ever when it has written all results but the report."""


def test_ctrl_c_during_the_report_says_how_to_go_on(start, folder, monkeypatch, tmp_path):
    run = shutil.copytree(folder, tmp_path / "run")
    written = {name: (run / name).read_bytes() for name in ("returns.csv", "summary.json")}
    for name in ("report.html", *written):
        (run / name).unlink()
    words = ("backtest", "--resume", run)
    process = start(*words, program=("-c", REPORT), stdin=subprocess.PIPE)
    while (line := process.stdout.readline()) != "here\n":
        assert line, process.stderr.read()
    process.send_signal(signal.SIGINT)
    assert process.wait(LIMIT) == 130
    assert process.stderr.read() == (
        f"qfolio: interrupted. Resume with: qfolio backtest --resume {run}\n"
    )
    assert not (run / "report.html").exists()
    assert qfolio(monkeypatch, "backtest", "--resume", run) == 0
    assert (run / "report.html").exists()
    assert {name: (run / name).read_bytes() for name in written} == written


GRADE = """
import sys
from qfolio import cli
from qfolio.experiments.run import Run

def wait(run):
    print("here", flush=True)
    sys.stdin.read()

Run.summary = wait
cli.main()
"""
"""The program, which waits for ever when it is to grade a run."""


def test_ctrl_c_during_the_grading_ends_the_log(start, tmp_path):
    words = ("train", "finite/cliff", "--episodes", 4, "--seeds", 1, "--out", tmp_path / "run")
    process = start(*words, program=("-c", GRADE), stdin=subprocess.PIPE)
    while (line := process.stdout.readline()) != "here\n":
        assert line, process.stderr.read()
    process.send_signal(signal.SIGINT)
    assert process.wait(LIMIT) == 130
    last = read(tmp_path / "run" / EVENTS)[0][-1]
    assert (last["event"], last["state"]) == ("end", "stopped")


def children(parent):
    """The processes that a process has started."""
    found: list[int] = []
    for thread in Path(f"/proc/{parent}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # it has ended
            found += map(int, thread.read_text().split())
    return found
