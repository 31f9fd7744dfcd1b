"""Workers that are processes of this machine.

They are spawned, because a fork of a process in which jax has started threads may deadlock. Each
has its own share of the cores and ends when the driver does, even if the driver is killed.
"""

import contextlib
import multiprocessing
import pickle
import signal
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TypeVar, cast

import jax

from qfolio.core.devices import LOCKSTEP, cores
from qfolio.core.errors import QfolioError
from qfolio.experiments.executor import Job
from qfolio.experiments.fit import Listener
from qfolio.experiments.machines.dispatch import dispatch
from qfolio.experiments.machines.messages import Lost, Message
from qfolio.experiments.machines.parcels import Packer
from qfolio.experiments.machines.worker import environment, serve

R = TypeVar("R")

ENDING = 1.0
"""Seconds that a process may take to end after closing its pipe."""

_SPAWN = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Processes:
    """Runs jobs in ``count`` processes of this machine.

    In a script of your own, put the call that runs them under ``if __name__ == "__main__":``,
    because each process imports the script.

    cores: number of cores of each process (default: an equal share).
    """

    count: int
    cores: int | None = None
    lockstep = False

    def __post_init__(self) -> None:
        for name, value in (("processes", self.count), ("cores of a process", self.cores or 1)):
            if value < 1:
                raise QfolioError(f"The number of {name} is {value}; it must be 1 or more.")

    @property
    def devices(self) -> int:
        return self.cores or max(1, len(cores()) // self.count)

    def map(
        self, jobs: Iterable[Job[R] | None], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Generator[tuple[Job[R], R], None, None]:
        _require_cores()
        return dispatch(lambda: _opened(self), jobs, listen)


class _Pool:
    """The processes by number."""

    def __init__(self, executor: Processes) -> None:
        self.count, self._devices = executor.count, executor.devices
        self._environment = environment(executor.devices)
        self._packer = Packer()
        self._processes: dict[int, SpawnProcess] = {}
        self._pipes: dict[int, connection.Connection] = {}
        self._sent: dict[int, set[str]] = {}  # arrays, by worker that has said something

    def start(self, worker: int) -> None:
        ours, theirs = _SPAWN.Pipe()
        usable, first = cores(), worker * self._devices
        mine = [usable[i % len(usable)] for i in range(first, first + self._devices)]
        process = _SPAWN.Process(target=serve, args=(theirs, mine, self._environment), daemon=True)
        process.start()
        theirs.close()  # only the worker's copy is left, so the pipe closes when it ends
        self._processes[worker], self._pipes[worker] = process, ours

    def send(self, worker: int, job: Job) -> None:
        parcel = self._packer.pack(job)
        new = [digest for digest in parcel.arrays if digest not in self._sent[worker]]
        self._sent[worker].update(new)
        content = (parcel, {digest: self._packer.arrays[digest] for digest in new})
        with contextlib.suppress(OSError):  # receive() notices a lost worker
            self._pipes[worker].send_bytes(pickle.dumps(content, protocol=5))

    def receive(self, seconds: float) -> list[tuple[int, Message]]:
        workers = {pipe: worker for worker, pipe in self._pipes.items()}
        heard: list[tuple[int, Message]] = []
        for pipe in connection.wait(list(workers), seconds):
            pipe = cast("connection.Connection", pipe)  # on Windows, of a class beside it
            worker = workers[pipe]
            try:
                heard.append((worker, pickle.loads(pipe.recv_bytes())))
                self._sent.setdefault(worker, set())
            except (EOFError, OSError):
                heard.append((worker, Lost(self._bury(worker))))
        return heard

    def close(self) -> None:
        """Ends all processes."""
        for process in self._processes.values():
            process.kill()  # their results are no longer wanted
        for worker in list(self._processes):
            self._bury(worker)

    def _bury(self, worker: int) -> str:
        """Removes a process that has closed its pipe, and says how it ended."""
        process = self._processes.pop(worker)
        self._pipes.pop(worker).close()
        process.join(ENDING)
        process.kill()
        process.join()
        code = process.exitcode
        process.close()
        if code is not None and code < 0:
            why = f"signal {signal.Signals(-code).name} ended its process"
        else:
            why = f"its process ended with code {code}"
        if self._sent.pop(worker, None) is None:
            why += f" as it started; {_advice()}"
        return why


def _advice() -> str:
    """What a script needs so that a new process can import it."""
    file = getattr(sys.modules["__main__"], "__file__", None)
    if file is not None and not Path(file).exists():
        return "save the script in a file, which new processes can read"
    return 'a script needs if __name__ == "__main__": around the call'


@contextlib.contextmanager
def _opened(executor: Processes) -> Iterator[_Pool]:
    if hasattr(signal, "pthread_sigmask"):
        # Processes inherit what this thread blocks: Ctrl-C, which a terminal sends to all of them,
        # is the driver's to act on. The tracker unblocks it when it starts, so it starts first.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    pool = _Pool(executor)
    try:
        yield pool
    finally:
        pool.close()


def _require_cores() -> None:
    """Raises QfolioError unless jax computes on the CPU, whose cores processes can share."""
    if (platform := jax.devices()[0].platform) in LOCKSTEP:
        raise QfolioError(
            f"Processes share out cores, but jax computes on a {platform} here; use --on ray, or "
            "set JAX_PLATFORMS=cpu."
        )
