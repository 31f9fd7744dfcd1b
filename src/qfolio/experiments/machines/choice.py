"""Executors by name, as ``--on`` takes them."""

import re

from qfolio.core.errors import QfolioError, require_type
from qfolio.experiments.executor import Executor, Here

MOST = 1024
"""The largest number of processes on one machine."""


def on(text: Executor | str | None) -> Executor:
    """The executor that a text names.

    Args:
        text: "here" for this process, "processes:4" for four processes of this machine, "ray" for
            the Ray cluster of this machine (started if there is none), "ray://HOST:10001" for a
            cluster reached through Ray Client. None stands for "here", and an executor for itself.

    Raises:
        QfolioError: The text names no executor, the number of processes is out of range, or Ray is
            not installed, cannot be reached or has no room.
    """
    if text is None:
        return Here()
    if not isinstance(text, str):
        wanted = 'text such as "processes:4", or an executor, such as qfolio.on("processes:4")'
        require_type("executor", text, Executor, wanted)
        return text
    kind, _, rest = text.partition(":")
    if text == "here":
        return Here()
    if kind == "processes" and rest.isdecimal() and 1 <= int(rest) <= MOST:
        from qfolio.experiments.machines.processes import Processes

        return Processes(int(rest))
    if text == "ray" or (kind == "ray" and re.fullmatch(r"//.+:\d+", rest)):
        from qfolio.experiments.machines.rays import Ray

        return Ray(text if rest else None)
    if kind == "processes":
        raise QfolioError(
            f"{text!r} names no executor; give a number of processes from 1 to {MOST}, such as "
            "processes:4."
        )
    raise QfolioError(
        f"{text!r} names no executor; it must be here, processes:4 (or another number), ray or "
        "ray://HOST:10001."
    )
