"""Messages from a worker to the driver. Nothing here imports jax, which a worker configures."""

import os
import platform
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from qfolio.core.version import __version__
from qfolio.experiments.records import Records

if TYPE_CHECKING:
    from qfolio.experiments.fit import Training


class Ready(NamedTuple):
    """A worker has started and waits for a job."""

    where: str  # its machine and process
    versions: dict[str, str]


class Report(NamedTuple):
    """The progress of a training, for its listeners in the driver."""

    hook: Literal["on_start", "on_chunk", "on_end"]
    training: "Training"  # without its population
    rows: Records


class Done(NamedTuple):
    """A job's result; the worker waits for the next."""

    result: Any


class Failed(NamedTuple):
    """A job raised an error, which would recur on any worker.

    plain: whether it is a QfolioError; otherwise ``error`` is a traceback, and ``sentence`` what
    ``sentence_on`` says of it.
    """

    error: str
    plain: bool
    sentence: str | None = None


class Lost(NamedTuple):
    """A worker is lost."""

    why: str  # in a few words
    begun: bool = True  # whether it may have begun the job that it was given


Message = Ready | Report | Done | Failed | Lost


def versions() -> dict[str, str]:
    """Versions that worker and driver must share for results to be equal bit for bit."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"qfolio": __version__, "jax": version("jax"), "Python": python}


def place() -> str:
    """This machine and process, for messages."""
    return f"process {os.getpid()} on {platform.node()}"
