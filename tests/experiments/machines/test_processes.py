"""Workers that are processes of this machine."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qfolio.core.errors import OUT_OF_MEMORY, QfolioError, WorkerError, sentence_on
from qfolio.experiments.executor import Executor, Here, Job, persistent
from qfolio.experiments.fit import Listener
from qfolio.experiments.interrupts import interruptible
from qfolio.experiments.machines.choice import on
from qfolio.experiments.machines.processes import Processes

import jobs
from jobs import LIMIT, Add, Die, Fail, Print, Sleep, Tell, alive, silent, wait_until


def begun(*files):
    """Waits until jobs have begun."""
    wait_until(lambda: all(file.exists() for file in files))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("procesess:4", "'procesess:4' names no executor; it must be here, processes:4"),
        ("processes:0", "'processes:0' names no executor; give a number of processes from 1"),
        ("processes", "a number of processes"), ("processes:two", "a number of processes"),
        ("processes:-1", "a number of processes"), ("processes:9999", "from 1 to 1024"),
        ("", "it must be here"), ("ray:", "it must be here"), ("here:1", "it must be here"),
        ("ray://x", "it must be here"), ("ray://x:abc", "it must be here"),
    ],
)  # fmt: skip
def test_texts_that_name_no_executor(text, message):
    with pytest.raises(QfolioError, match=message):
        on(text)


def test_texts_that_name_executors():
    assert isinstance(on("here"), Here)
    assert on("processes:3") == Processes(3)
    assert all(isinstance(on(text), Executor) for text in ("here", "processes:3"))
    with pytest.raises(QfolioError, match="number of processes is 0"):
        Processes(0)
    with pytest.raises(QfolioError, match="number of cores of a process is -1"):
        Processes(1, cores=-1)


def test_long_lived_workers_get_a_large_array_once():
    table = np.arange(4000.0)
    work = [Add(str(i), i, table) for i in range(40)]
    results = {job.name: result for job, result in Processes(1).map(work, silent)}
    assert results.keys() == {job.name for job in work}
    for i, result in enumerate(results[job.name] for job in work):
        np.testing.assert_array_equal(result["sum"], table + i)
    assert len({(result["place"], result["table"]) for result in results.values()}) == 1
    assert results["0"]["place"] != os.getpid()


def test_workers_are_kept_between_maps():
    with persistent(Processes(1)) as executor:
        places = set[int]()
        for number in range(3):
            work = [Add(f"{number}{name}", number) for name in "ab"]
            done = {job.name: result for job, result in executor.map(work, silent)}
            assert [done[job.name]["sum"][0] for job in work] == [number, number]
            places |= {result["place"] for result in done.values()}
        (place,) = places
        assert alive(place)
    assert not alive(place)


def test_ctrl_c_ends_workers_that_are_kept_between_maps(tmp_path):
    """In a later map as in the first."""

    def press():
        begun(tmp_path / "a")
        os.kill(os.getpid(), signal.SIGINT)

    with persistent(Processes(1)) as executor:
        for work in ([Add("first", 1.0)], [Sleep("a", tmp_path)]):
            with interruptible() as stop:
                if work[0].name == "a":
                    threading.Thread(target=press).start()
                done = [job.name for job, _ in executor.map(work, silent)]
    assert stop.is_set()
    assert done == []


def test_listeners_hear_of_trainings_on_workers():
    heard: list[Any] = []

    class Note(Listener):
        def on_start(self, training):
            heard.append(("start", training.share, training.finished))

        def on_chunk(self, training, rows):
            heard.append((rows, training.share, training.steps_per_second, training.seconds_left))
            with pytest.raises(QfolioError, match="population of a training that runs on a worker"):
                _ = training.population

        def on_end(self, training):
            heard.append(("end", training.finished, training.interrupted))

    ((_, result),) = Processes(1).map([Tell("a")], lambda job: [Note()])
    assert result == "told"
    rows = [{"seed": 0, "episode": 1, "return": 2.5}]
    assert heard == [("start", 0.0, False), (rows, 4 / 7, 4.0, 0.75), ("end", True, False)]


def test_the_job_of_a_killed_worker_runs_again(tmp_path):
    work: list[Job] = [Die("a", tmp_path / "count", 1), Add("b", 1.0)]
    assert {job.name for job, _ in Processes(1).map(work, silent)} == {"a", "b"}
    assert (tmp_path / "count").read_text() == "xx"


def test_a_job_that_kills_every_worker(tmp_path):
    with pytest.raises(QfolioError, match=r"^a was given up.*signal SIGKILL ended its process"):
        list(Processes(1).map([Die("a", tmp_path / "count", 9)], silent))
    assert (tmp_path / "count").read_text() == "xxx"


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (QfolioError("the loss is not finite."), QfolioError, r"^the loss is not finite\.$"),
        (ZeroDivisionError("by zero"), WorkerError, r"(?s)^a failed on a worker:\nTraceback.*by"),
        (
            SystemExit("no license"),
            WorkerError,
            r"(?s)^a failed on a worker:\nTraceback.*no license",
        ),
    ],
)
def test_the_error_of_a_job(error, kind, message):
    with pytest.raises(kind, match=message) as raised:
        list(Processes(1).map([Fail("a", error)], silent))
    if kind is WorkerError:  # the command line tells it as it would here
        said = f"run failed: {type(error).__name__}: {error} (jobs.py, line "
        assert str(sentence_on(raised.value)).startswith(said)


def test_workers_print_nothing_to_the_standard_output(capfd):
    list(Processes(1).map([Print("a")], silent))
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "a\n")


def test_too_little_memory_on_a_worker():
    with pytest.raises(WorkerError) as raised:
        list(Processes(1).map([Fail("a", MemoryError())], silent))
    assert sentence_on(raised.value) == OUT_OF_MEMORY


def test_ctrl_c_ends_all_workers_and_keeps_what_is_done(tmp_path):
    names = ("a", "b")
    files = [tmp_path / name for name in names]
    work: list[Job] = [Add("done", 1.0), *(Sleep(name, tmp_path) for name in names)]

    def press():
        begun(*files)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press).start()
    assert [job.name for job, _ in Processes(2).map(work, silent)] == ["done"]
    assert not any(alive(int(file.read_text())) for file in files)


def test_a_reader_that_leaves_ends_all_workers(tmp_path):
    run = Processes(2).map([Add("done", 1.0), Sleep("a", tmp_path)], silent)
    next(run)
    begun(tmp_path / "a")
    run.close()
    assert not alive(int((tmp_path / "a").read_text()))


@pytest.mark.slow
def test_a_script_that_its_workers_run_again(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from qfolio.experiments.machines.processes import Processes\n"
        "from jobs import Add\n"
        "list(Processes(1).map([Add('a', 1.0)], lambda job: ()))\n"
    )
    command = [sys.executable, str(script), str(Path(jobs.__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    (*_, last) = done.stderr.splitlines()
    assert last.endswith(
        "QfolioError: No worker stays alive; the last one: its process ended with code 1 as it "
        'started; a script needs if __name__ == "__main__": around the call.'
    )


def test_a_script_that_its_workers_cannot_read(tmp_path):
    script = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from qfolio.experiments.machines.processes import Processes\n"
        "from jobs import Add\n"
        "if __name__ == '__main__':\n"
        "    list(Processes(1).map([Add('a', 1.0)], lambda job: ()))\n"
    )
    command = [sys.executable, "-", str(Path(jobs.__file__).parent)]
    done = subprocess.run(
        command, input=script, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    (*_, last) = done.stderr.splitlines()
    assert last.endswith("as it started; save the script in a file, which new processes can read.")


def test_workers_end_with_a_driver_that_is_killed(tmp_path):
    code = (
        "import sys; sys.path[:0] = sys.argv[2:]\n"
        "from pathlib import Path\n"
        "from qfolio.experiments.machines.processes import Processes\n"
        "from jobs import Sleep\n"
        "if __name__ == '__main__':\n"
        "    list(Processes(1).map([Sleep('a', Path(sys.argv[1]))], lambda job: ()))\n"
    )
    driver = subprocess.Popen([sys.executable, "-c", code, str(tmp_path), *sys.path])
    begun(tmp_path / "a")
    driver.kill()
    driver.wait()
    process = int((tmp_path / "a").read_text())
    wait_until(lambda: not alive(process))
