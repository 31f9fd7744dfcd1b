"""The exception for errors that a user can fix, and checks that raise it."""

import contextlib
import inspect
import reprlib
import sysconfig
import traceback
from collections.abc import Collection, Iterator
from numbers import Integral
from pathlib import Path, PurePath
from types import UnionType
from typing import Any

from qfolio.core.text import listed

OUT_OF_MEMORY = (
    "There is too little memory; free some, or ask for less: a smaller table, fewer seeds, or a "
    "lower num_envs, batch_size or hidden."
)


class QfolioError(Exception):
    """An error that a user can fix: one sentence that says what is wrong, where, and what to do.

    The command line prints it without a traceback and exits with code 2.
    """


class TooFewRowsError(QfolioError):
    """A table has too few rows for what is asked of it; a study leaves such a table out."""


class WorkerError(RuntimeError):
    """An error that a job raised on a worker, with its traceback there.

    sentence: as of ``sentence_on``, by the worker.
    """

    def __init__(self, message: str, sentence: str | None) -> None:
        super().__init__(message)
        self.sentence = sentence


def require_type(
    name: str, value: object, kinds: type | UnionType | tuple[type, ...], wanted: str
) -> None:
    """Raises QfolioError unless an argument has one of some types.

    wanted: what it must be, for the message.
    """
    if not _is(value, kinds):
        raise QfolioError(f"{name} is {reprlib.repr(value)}; it must be {wanted}.")


def require_whole(name: str, value: Any, low: int, high: int) -> None:
    """Raises QfolioError unless an argument is a whole number in a range."""
    require_type(name, value, Integral, "a whole number")
    if not low <= value <= high:
        raise QfolioError(f"{name} is {value}; it must be from {low} to {high}.")


def require_list(name: str, value: object, kinds: type | UnionType, wanted: str) -> None:
    """Raises QfolioError unless an argument is a list, a tuple, … of elements of some types.

    A text is none, although its letters are elements. wanted: as for ``require_type``.
    """
    if (
        not isinstance(value, Collection)
        or isinstance(value, str | bytes)
        or not all(_is(each, kinds) for each in value)
    ):
        raise QfolioError(f"{name} is {reprlib.repr(value)}; it must be {wanted}.")


def require_methods(kind: type, *bases: type) -> None:
    """Raises QfolioError unless a class's methods take the arguments that those of its bases do."""
    for base in bases:
        for name, method in vars(base).items():
            public = name == "__call__" or not name.startswith("_")
            if not (issubclass(kind, base) and public and inspect.isfunction(method)):
                continue
            wanted = [*inspect.signature(method).parameters]
            bound = isinstance(inspect.getattr_static(kind, name), staticmethod | classmethod)
            try:
                inspect.signature(getattr(kind, name)).bind(*wanted[bound:])
            except TypeError:
                raise QfolioError(
                    f"{kind.__name__}.{name} must be a method that takes {listed(wanted)}."
                ) from None


@contextlib.contextmanager
def needs(*packages: str, otherwise: str) -> Iterator[None]:
    """Raises QfolioError if an import within it lacks one of some optional packages.

    otherwise: what it says, unless the package is there, but cannot be imported.
    """
    try:
        yield
    except ImportError as error:
        if isinstance(error, ModuleNotFoundError) and error.name in packages:
            raise QfolioError(otherwise) from None
        raise QfolioError(f"{packages[0]} cannot be imported: {one_line(error)}.") from None


def _is(value: object, kinds: type | UnionType | tuple[type, ...]) -> bool:
    """Whether a value has one of some types; True and False are no numbers here."""
    return isinstance(value, kinds) and (kinds is bool or not isinstance(value, bool))


def one_line(error: BaseException) -> str:
    """An exception from a user's code, on one line: its type, message and location."""
    kind = type(error)
    traced = kind.__module__ == "jax.errors" and kind.__name__ in _TRACED
    message = _COMPILED if traced else " ".join(str(error).split()).rstrip(".")
    frames = traceback.extract_tb(error.__traceback__)
    known = [frame for frame in frames if not frame.filename.startswith("<")]
    frame = own_frame(error) or (known[-1] if known else None)
    text = f"{kind.__name__}: {message}" if message else kind.__name__
    if isinstance(error, SyntaxError) or not frame:  # a SyntaxError's message names the place
        return text
    return f"{text} ({PurePath(frame.filename).name}, line {frame.lineno})"


def sentence_on(error: BaseException) -> str | None:
    """What to tell of an error of a user's own code, or of too little memory; None of another."""
    if isinstance(error, WorkerError):
        return error.sentence
    if is_out_of_memory(error):
        return OUT_OF_MEMORY
    own = own_frame(error)
    return None if own is None else f"{own.name} failed: {one_line(error)}."


def is_out_of_memory(error: BaseException) -> bool:
    """Whether there was too little memory, of the machine or of a device."""
    exhausted = isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error)  # jax's own
    return isinstance(error, MemoryError) or exhausted


def told(error: BaseException) -> str | None:
    """What to tell a user of an error; None if only a traceback says enough."""
    if isinstance(error, QfolioError):
        return str(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        denied = isinstance(error, PermissionError) and error.filename
        advice = "; get the right to read and write there, or name another place" if denied else ""
        return f"{where}{error.strerror or error}{advice}."
    return sentence_on(error)


def own_frame(error: BaseException) -> traceback.FrameSummary | None:
    """The last place in a user's own code that an exception passed; None if there is none."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = PurePath(frame.filename)
        if path.is_absolute() and not any(path.is_relative_to(place) for place in _NOT_OWN):
            return frame
    return None


_TRACED = (
    "ConcretizationTypeError",
    "NonConcreteBooleanIndexError",
    "TracerArrayConversionError",
    "TracerBoolConversionError",
    "TracerIntegerConversionError",
)
"""Errors of jax whose message explains tracing, at places within qfolio."""

_COMPILED = (
    "this code is compiled before its values are known, so numpy, if, while, int and float cannot "
    "take them, nor can x[x > 0]; use jax.numpy, jnp.where or jax.lax"
)

_NOT_OWN = [
    str(Path(__file__).parents[1]),
    *map(sysconfig.get_path, ("stdlib", "purelib", "platlib")),
]
"""Where Python, the libraries and qfolio are."""
