"""The worker's side: a process (``serve``) or an actor of Ray (``Actor``).

jax is imported after cores and environment have been set.
"""

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from multiprocessing import connection
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from qfolio.core.errors import QfolioError, sentence_on
from qfolio.experiments.machines.messages import Done, Failed, Message, Ready, place, versions

if TYPE_CHECKING:
    from qfolio.experiments.machines.parcels import Parcel, Unpacker


def prepare(environment: Mapping[str, str]) -> Ready:
    """Sets jax up in a process in which nothing has imported it."""
    os.environ.update(environment)
    from qfolio.core import devices

    devices.configure()
    return Ready(place(), versions())


def environment(cores: int) -> dict[str, str]:
    """This process's settings of XLA, for a worker that computes on ``cores`` cores."""
    return {"XLA_FLAGS": os.environ.get("XLA_FLAGS", ""), "NPROC": str(cores)}


def work(unpacker: "Unpacker", parcel: "Parcel", send: Callable[[Message], None]) -> None:
    """Runs a job, and sends its reports and its result."""
    from qfolio.experiments.machines.remote import Reporter

    try:  # includes sending, which fails if a result cannot be pickled
        send(Done(unpacker.unpack(parcel).run([Reporter(send)])))
    except QfolioError as error:
        send(Failed(str(error), plain=True))
    except (Exception, SystemExit) as error:  # sys.exit would end the worker, or its thread in Ray
        send(Failed(traceback.format_exc(), plain=False, sentence=sentence_on(error)))


def serve(pipe: connection.Connection, cores: list[int], environment: dict[str, str]) -> None:
    """The main function of a process: runs jobs from the pipe until it is closed."""
    threading.Thread(target=_end_with_the_driver, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver's to act on; Windows cannot block it
    sys.stdout = sys.stderr  # what a user's own code prints; --json has the driver's for itself
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)

    def send(message: Message) -> None:
        pipe.send_bytes(pickle.dumps(message, protocol=5))

    with contextlib.suppress(EOFError, OSError):  # the driver has gone
        send(prepare(environment))
        from qfolio.experiments.machines.parcels import Unpacker

        unpacker = Unpacker()
        while True:
            parcel, arrays = pickle.loads(pipe.recv_bytes())
            unpacker.keep(arrays)
            work(unpacker, parcel, send)


def _end_with_the_driver() -> None:
    """Ends this process when the driver ends, even in the middle of a job."""
    driver = multiprocessing.parent_process()
    assert driver is not None
    connection.wait([driver.sentinel])
    os._exit(1)


class Actor:
    """A worker that Ray keeps alive; its answers are messages as bytes."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._environment, self._said = environment, SimpleQueue[Message]()
        self._taken: tuple[Any, ...] = ()  # the arguments of ``_run``

    def placed(self) -> bytes:
        """No messages; answered as soon as the actor has a place in the cluster."""
        return pickle.dumps([])

    def ready(self) -> bytes:
        ready = prepare(self._environment)
        from qfolio.experiments.machines.parcels import Unpacker

        self._unpacker = Unpacker()
        return pickle.dumps([ready])

    def take(self, parcel: bytes, arrays: dict[str, Any]) -> bytes:
        """Takes a job; arrays: references to the arrays that it needs. Answers no messages."""
        self._taken = pickle.loads(parcel), arrays
        return pickle.dumps([])

    def begin(self) -> None:
        """Begins the job that was taken, in the background."""
        threading.Thread(target=self._run, args=self._taken).start()

    def listen(self) -> bytes:
        """The messages so far, as bytes; waits until there is one."""
        said = [self._said.get()]
        with contextlib.suppress(Empty):
            while True:
                said.append(self._said.get_nowait())
        return pickle.dumps(said)

    def _run(self, parcel: "Parcel", arrays: dict[str, Any]) -> None:
        import ray

        try:
            lacking = self._unpacker.lacks(parcel)
            self._unpacker.keep({digest: ray.get(arrays[digest]) for digest in lacking})
        except Exception:  # an answer is due, or the driver would wait for it forever
            self._said.put(Failed(traceback.format_exc(), plain=False))
            return
        work(self._unpacker, parcel, self._said.put)
