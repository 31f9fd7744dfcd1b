"""Handling of Ctrl-C: the first stops a training after its current chunk, a second at once.

The main thread waits for jax, sometimes for seconds, and Python cannot interrupt jax: an
exception would come too late, end inside one of jax's callbacks, or crash the process at its exit.
The command line therefore listens in a separate thread (``exit_on_ctrl_c``). Files on disk are
complete at any moment, because they are written under another name and renamed.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from qfolio.core.text import printable

EXIT_CODE = 130
"""The conventional exit code of a program that Ctrl-C ended."""

_trainings: list[threading.Event] = []
"""The stop request of the training in the main thread, if there is one."""

_resumes: list[str] = []
"""The command that goes on with the work in the main thread, if it can be resumed."""

_last_acts: list[Callable[[], object]] = []
"""What is done when Ctrl-C ends the process, from a thread beside the work."""

_NEW_LINE = "\r\x1b[2K\x1b[?25h"
"""What clears the line of a bar, and shows the cursor again."""


@contextlib.contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Yields an event that the first Ctrl-C sets; a second one interrupts at once.

    A nested block shares the outer block's event: both stop.
    """
    if threading.current_thread() is not threading.main_thread():
        yield threading.Event()
        return
    if _trainings:
        yield _trainings[0]
        return
    stop = threading.Event()
    previous = signal.getsignal(signal.SIGINT)
    if previous is not _ignore:  # the command line's thread does not need a handler
        signal.signal(signal.SIGINT, lambda *_: _first(stop) or signal.default_int_handler(*_))
    _trainings.append(stop)
    try:
        yield stop
    finally:
        _trainings.remove(stop)
        signal.signal(signal.SIGINT, previous)


@contextlib.contextmanager
def resumable(command: str) -> Iterator[None]:
    """Within the block, Ctrl-C that ends the process says that ``command`` goes on.

    For a second Ctrl-C in a training, and for what follows it, such as a report, which has no state
    of its own to stop at.
    """
    _resumes.append(command)
    try:
        yield
    finally:
        _resumes.remove(command)


@contextlib.contextmanager
def before_leaving(act: Callable[[], object]) -> Iterator[None]:
    """Within the block, Ctrl-C that ends the process first calls ``act``, in another thread."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)


def exit_on_ctrl_c() -> None:
    """Makes Ctrl-C end the process with ``EXIT_CODE``, unless it stops a training first."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.signal(signal.SIGINT, _ignore)
    signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_listen, args=(receiver, sender), daemon=True).start()


def _leave() -> None:
    """Ends the process with ``EXIT_CODE``, without waiting for jax's threads.

    Nothing is flushed: output is flushed when printed, and a main thread that waits for the reader
    of a pipe would hold the lock.
    """
    for act in [*_last_acts]:  # of which the main thread may remove some
        with contextlib.suppress(Exception):
            act()
    start = _NEW_LINE if sys.stderr.isatty() else ""
    advice = f". Resume with: {printable(_resumes[-1])}" if _resumes else ""
    with contextlib.suppress(OSError):
        os.write(2, f"{start}qfolio: interrupted{advice}\n".encode())
    os._exit(EXIT_CODE)


def _ignore(number: int, frame: Any) -> None:
    """Does nothing, so that Python raises no KeyboardInterrupt: the thread acts on the signal."""


def _first(stop: threading.Event) -> bool:
    """Asks the training to stop; false if it has been asked already."""
    asked = stop.is_set()
    stop.set()
    return not asked


def _listen(receiver: socket.socket, sender: socket.socket) -> None:
    """Acts on signal numbers; holds a reference to the sender to keep it open."""
    while numbers := receiver.recv(64):
        for number in numbers:
            if number == signal.SIGINT:
                stop = next(iter(_trainings), None)  # the main thread may remove it at any moment
                if stop is None or not _first(stop):
                    _leave()
