"""Workers that are actors of a Ray cluster: one per GPU, or one per group of cores.

Actors live as long as the run, because a Ray task on a GPU gets a new process, which compiles
everything again.
"""

import contextlib
import logging
import os
import pickle
import re
import socket
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, TypeVar

from qfolio.core.errors import QfolioError, needs
from qfolio.core.text import amount
from qfolio.core.version import __version__
from qfolio.experiments.executor import Job
from qfolio.experiments.fit import Listener
from qfolio.experiments.machines.dispatch import dispatch
from qfolio.experiments.machines.messages import Lost, Message, Report
from qfolio.experiments.machines.parcels import Packer
from qfolio.experiments.machines.worker import Actor, environment

R = TypeVar("R")

ANSWER = 10.0
"""Seconds that a cluster may take to accept a connection."""

PLACE = 30.0
"""Seconds that the first worker may wait for a place, if the cluster seemed to have room."""


class Ray:
    """Runs jobs on a Ray cluster, with Ray's own connection if there is one.

    Args:
        address: The cluster, such as "ray://HOST:10001" (default: that of RAY_ADDRESS, of this
            machine, or a new one on this machine).
        workers: Number of workers (default: as many as the cluster has room for at present).
        cpus: Cores of each worker.
        gpus: Whether each worker has a GPU (default: if the cluster has one).
    """

    def __init__(
        self,
        address: str | None = None,
        *,
        workers: int | None = None,
        cpus: int = 1,
        gpus: bool | None = None,
    ) -> None:
        for name, value in (("workers", workers), ("cores of a worker", cpus)):
            if value is not None and value < 1:
                raise QfolioError(f"The number of {name} is {value}; it must be 1 or more.")
        ray = _connected(address)
        there = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        self.lockstep = any("GPU" in node for node in there) if gpus is None else gpus
        kind, asked = ("GPU", 1) if self.lockstep else ("CPU", cpus)
        room = sum(int(node.get(kind, 0)) // asked for node in there)
        self.workers, self.cpus = room if workers is None else workers, cpus
        self.waits = workers is not None  # for machines that join later
        if self.workers < 1:
            what = "GPU" if self.lockstep else f"node with {amount(cpus, 'core')}"
            raise QfolioError(
                f"The Ray cluster has no {what}, so no worker can start; add one, or in Python use "
                "Ray(workers=…), which waits for it."
            )

    @property
    def devices(self) -> int:
        return 1 if self.lockstep else self.cpus

    def map(
        self, jobs: Iterable[Job[R] | None], listen: Callable[[Job[R]], Sequence[Listener]]
    ) -> Generator[tuple[Job[R], R], None, None]:
        return dispatch(lambda: contextlib.closing(_Actors(self)), jobs, listen)


class _Actors:
    """The actors by number."""

    def __init__(self, executor: Ray) -> None:
        import ray

        self._ray, self._executor, self.count = ray, executor, executor.workers
        self._opened, self._placed = time.monotonic(), executor.waits
        # Ray gives an actor without a GPU no GPU, but does not hide those of its machine.
        hidden = {} if executor.lockstep else {"JAX_PLATFORMS": "cpu"}
        self._environment = environment(executor.cpus) | hidden
        self._actor = ray.remote(
            num_cpus=executor.cpus, num_gpus=int(executor.lockstep), max_restarts=0
        )(Actor)
        self._packer = Packer()
        self._stored: dict[str, Any] = {}  # references to arrays in the cluster's store
        self._actors: dict[int, Any] = {}
        self._answers: dict[Any, int] = {}  # awaited answers, with their workers
        self._taking = set[int]()  # workers that have been sent a job, and may have died before

    def start(self, worker: int) -> None:
        self._actors[worker] = self._actor.remote(self._environment)
        self._answers[self._actors[worker].placed.remote()] = worker

    def send(self, worker: int, job: Job) -> None:
        parcel = self._packer.pack(job)
        for digest in parcel.arrays:
            if digest not in self._stored:
                self._stored[digest] = self._ray.put(self._packer.arrays[digest])
        arrays = {digest: self._stored[digest] for digest in parcel.arrays}
        self._answers[self._actors[worker].take.remote(pickle.dumps(parcel), arrays)] = worker
        self._taking.add(worker)

    def receive(self, seconds: float) -> list[tuple[int, Message]]:
        awaited = list(self._answers)
        if not awaited:  # all workers wait for jobs
            time.sleep(seconds)
            return []
        if not self._ray.wait(awaited, timeout=seconds)[0]:
            if not self._placed and time.monotonic() - self._opened > PLACE:
                raise self._no_place()
            return []
        answered, _ = self._ray.wait(awaited, num_returns=len(awaited), timeout=0)
        heard: list[tuple[int, Message]] = []
        for answer in answered:
            worker = self._answers.pop(answer)
            try:
                said: list[Message] = pickle.loads(self._ray.get(answer))
            except self._ray.exceptions.RayError as error:
                said = [Lost(_reason(error), begun=worker not in self._taking)]
                self._taking.discard(worker)
                self._ray.kill(self._actors.pop(worker))
            if not said and worker in self._taking:
                self._taking.remove(worker)
                self._actors[worker].begin.remote()
                self._listen(worker)
            elif not said:
                self._placed = True
                self._answers[self._actors[worker].ready.remote()] = worker
            elif isinstance(said[-1], Report):
                self._listen(worker)
            heard += [(worker, message) for message in said]
        return heard

    def close(self) -> None:
        """Ends all actors."""
        for actor in self._actors.values():
            self._ray.kill(actor)

    def _no_place(self) -> QfolioError:
        kind = "GPU" if self._executor.lockstep else "CPU"
        what = {"GPU": "GPUs", "CPU": "cores"}[kind]
        free = int(self._ray.available_resources().get(kind, 0))
        there = int(self._ray.cluster_resources().get(kind, 0))
        asked = "a GPU" if self._executor.lockstep else amount(self._executor.cpus, "core")
        return QfolioError(
            f"No worker got a place within {PLACE:.0f} seconds: each asks for {asked}, and of the "
            f"Ray cluster's {there} {what} {free} are free; end what else runs there, or add a "
            "machine."
        )

    def _listen(self, worker: int) -> None:
        self._answers[self._actors[worker].listen.remote()] = worker


def _connected(address: str | None) -> Any:
    """The module ray, connected to a cluster."""
    missing = 'Ray is not installed; install it with pip install "qfolio[ray]".'
    with needs("ray", otherwise=missing):
        import ray
    if not ray.is_initialized():
        named = address or os.environ.get("RAY_ADDRESS", "")
        try:
            _require_open(named)
            _connect(ray, address)
        except (OSError, ValueError, RuntimeError) as error:
            lines = str(error).strip().splitlines() or [type(error).__name__]
            why = lines[-1] if isinstance(error, ConnectionAbortedError) else lines[0]
            raise QfolioError(
                f"The Ray cluster {named or 'of this machine'} cannot be reached "
                f"({why.rstrip('.')}); check its address, and that it is running. If it asks for "
                "a token, set RAY_AUTH_MODE=token."
            ) from None
    return ray


def _require_open(address: str) -> None:
    """Raises OSError if HOST:PORT does not answer, for which Ray would wait for minutes."""
    host, _, port = address.rpartition(":")
    if port.isdigit() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=ANSWER).close()


def _connect(ray: Any, address: str | None, more: int = 2) -> None:
    """more: how often to try again if the head is too slow to start a process for this client.

    It gives up after 30 seconds, which a busy machine may need, and may then fail to start another.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # real problems raise an exception
            ray.init(address, logging_level=logging.ERROR, log_to_driver=False)
    except (ConnectionAbortedError, RuntimeError) as error:
        failed = isinstance(error, ConnectionAbortedError) or "client server failed" in str(error)
        if not more or not failed:
            raise
        _connect(ray, address, more - 1)


def _reason(error: Exception) -> str:
    """Why an actor is lost; raises QfolioError if its machine lacks a module."""
    text = str(error)
    if missing := re.search(r"No module named '([\w.]+)'", text):
        raise QfolioError(
            f"A machine of the Ray cluster has no {missing[1]}; install qfolio {__version__} on "
            "all of them."
        )
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[0].rstrip(".") if lines else type(error).__name__
