"""The one exception that is meant for the person at the keyboard."""

import traceback
from pathlib import PurePath


class QfolioError(Exception):
    """Something the user can put right: one sentence that says what, where and what to do.

    The command line prints it without a traceback and exits with code 2.
    """


def told(error: BaseException) -> str:
    """An exception of a user's own code in a line: its type, its message and its place."""
    message = " ".join(str(error).split()).rstrip(".")
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith("<")]
    text = f"{type(error).__name__}: {message}" if message else type(error).__name__
    if isinstance(error, SyntaxError) or not own:  # which names the place itself
        return text
    return f"{text} ({PurePath(own[-1].filename).name}, line {own[-1].lineno})"
