"""Jobs for tests of executors, in a module that workers can import."""

import os
import pickle
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.experiments.budget import Budget
from qfolio.experiments.fit import Training
from qfolio.experiments.interrupts import interruptible
from qfolio.experiments.machines.parcels import Packer, Unpacker
from qfolio.experiments.records import Records

LIMIT = 240.0
"""Seconds after which what is waited for will not come, however busy the machine is."""


def wait_until(condition, seconds=LIMIT):
    """Waits for a condition; returns True."""
    end = time.perf_counter() + seconds
    while not condition():
        assert time.perf_counter() < end, "it has not come"
        time.sleep(0.02)
    return True


@dataclass(frozen=True)
class Add:
    """Adds a large array, which is the same object for several jobs, to a number."""

    name: str
    number: float
    table: Any = field(default_factory=lambda: np.zeros(3))

    def run(self, listeners):
        return {"sum": self.table + self.number, "place": os.getpid(), "table": id(self.table)}


@dataclass(frozen=True)
class Meet(Add):
    """Adds when another worker has begun to, too."""

    folder: Path = Path()

    def run(self, listeners):
        (self.folder / str(os.getpid())).touch()
        wait_until(lambda: len(list(self.folder.iterdir())) > 1)
        return super().run(listeners)


@dataclass(frozen=True)
class Fail:
    """Raises an error."""

    name: str
    error: BaseException = field(default_factory=lambda: QfolioError("the loss is not finite."))

    def run(self, listeners):
        raise self.error


@dataclass(frozen=True)
class Print:
    """Prints its name."""

    name: str

    def run(self, listeners):
        print(self.name)
        return self.name


@dataclass(frozen=True)
class Die:
    """Kills its worker, some times; it counts them in a file."""

    name: str
    file: Path
    times: int

    def run(self, listeners):
        with self.file.open("a+") as file:
            file.write("x")
        if len(self.file.read_text()) <= self.times:
            os.kill(os.getpid(), signal.SIGKILL)
        return "alive"


@dataclass(frozen=True)
class Sleep:
    """Says that it has begun, in a file with its process, and waits for a file, the first time.

    Longer than anybody waits for its end: where nobody wakes it, it does not end by itself.
    """

    name: str
    folder: Path

    def run(self, listeners):
        if (self.folder / self.name).exists():
            return "begun before"
        (self.folder / f"{self.name}.part").write_text(str(os.getpid()))
        (self.folder / f"{self.name}.part").rename(self.folder / self.name)
        wait_until(lambda: (self.folder / "wake").exists(), 2 * LIMIT)
        return "rested"


@dataclass(frozen=True)
class Tell:
    """Trains nothing, but its listeners hear of a training."""

    name: str

    def run(self, listeners):
        training = Training(None, Budget(episodes=4), left=7, members=[0], ends=[100])
        for listener in listeners:
            listener.on_start(training)
            training.left, training.done, training.seconds = 3, 4, 1.0
            training._learned, training._learning_seconds = 4, 1.0
            listener.on_chunk(training, Records.of([{"seed": 0, "episode": 1, "return": 2.5}]))
            training.left = 0
            listener.on_end(training)
        return "told"


def silent(job):
    """No listeners."""
    return ()


def alive(process: int) -> bool:
    """Whether a process runs; a dead one that nobody has waited for does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


class Elsewhere:
    """Runs jobs in this process, one after another, but as a worker gets them: as bytes.

    ran: the names of the jobs.
    """

    devices, lockstep = 1, False

    def __init__(self):
        self.ran: list[str] = []

    def map(self, jobs, listen):
        packer, unpacker = Packer(), Unpacker()
        with interruptible() as stop:
            for job in jobs:
                if stop.is_set():
                    return
                self.ran.append(job.name)
                parcel = packer.pack(job)
                unpacker.keep({digest: packer.arrays[digest] for digest in parcel.arrays})
                result = unpacker.unpack(parcel).run(listen(job))
                if result is None:
                    return
                yield job, pickle.loads(pickle.dumps(result))
