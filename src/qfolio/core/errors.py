"""The exception for errors that a user can fix, and checks that raise it."""

import reprlib
import traceback
from collections.abc import Collection
from numbers import Integral
from pathlib import PurePath
from types import UnionType
from typing import Any


class QfolioError(Exception):
    """An error that a user can fix: one sentence that says what is wrong, where, and what to do.

    The command line prints it without a traceback and exits with code 2.
    """


def require_type(name: str, value: object, kinds: type | tuple[type, ...], wanted: str) -> None:
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


def _is(value: object, kinds: type | UnionType | tuple[type, ...]) -> bool:
    """Whether a value has one of some types; True and False are no numbers here."""
    return isinstance(value, kinds) and (kinds is bool or not isinstance(value, bool))


def one_line(error: BaseException) -> str:
    """An exception from a user's code, on one line: its type, message and location."""
    message = " ".join(str(error).split()).rstrip(".")
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith("<")]
    text = f"{type(error).__name__}: {message}" if message else type(error).__name__
    if isinstance(error, SyntaxError) or not own:  # a SyntaxError's message names the place
        return text
    return f"{text} ({PurePath(own[-1].filename).name}, line {own[-1].lineno})"
