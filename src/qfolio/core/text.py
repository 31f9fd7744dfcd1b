"""Text and values made safe for messages, the terminal and its streams, CSV cells and JSON."""

import difflib
import math
import os
import re
import shlex
import subprocess
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

UNSAFE = frozenset({"Cc", "Cf", "Cn", "Co", "Cs", "Zl", "Zp"})
"""Unicode categories that a terminal may obey instead of showing: control, format (which may
reverse text), unassigned, private, surrogates, line and paragraph separators."""

MENTIONED = 20
"""Most names that a message lists."""

PLAIN = {
    "\N{MINUS SIGN}": "-", "–": "-", "·": "*", "×": "x", "…": "...", "’": "'", "“": '"', "”": '"',
    "≤": "<=", "≥": ">=", "±": "+-", "∞": "inf", "─": "-", "│": "|",
}  # fmt: skip
"""What stands for a character in an encoding without it, such as ASCII; "?" for all others."""

_FORMULA = re.compile(r"(^|[;\t\r\n])([^\S\t\r\n]*[=+\-@＝＋－＠])")


def printable(text: str) -> str:
    """The text with escapes in place of characters that a terminal may obey."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(ascii(c)[1:-1] if unicodedata.category(c) in UNSAFE else c for c in text)


def plain_signs(error: UnicodeError) -> tuple[str, int]:
    """A handler of encoding errors (``codecs.register_error``) that keeps signs: see ``PLAIN``."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(PLAIN.get(c, "?") for c in lacking), error.end


def discard(stream: TextIO) -> None:
    """Lets the rest of what a stream is given go nowhere, as when its reader has gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def quote(value: object, limit: int = 60) -> str:
    """Any value in quotation marks, on one line and cut to ``limit`` characters."""
    text = str(value)
    return f"'{printable(text if len(text) <= limit else text[: limit - 1] + '…')}'"


def shell(*words: Path | str) -> str:
    """Words as the system's shell takes them, for commands that can be pasted."""
    join = subprocess.list2cmdline if os.name == "nt" else shlex.join
    return join(map(str, words))


def amount(count: int, noun: str) -> str:
    """A count with its noun: 1 row, 2 rows, 1,000 rows."""
    return f"{count:,} {plural(noun, count)}"


def plural(noun: str, count: int) -> str:
    """The noun, with an s unless ``count`` is 1."""
    return noun if count == 1 else f"{noun}s"


def figure(value: float | None, form: str) -> str:
    """A number in one of Python's formats, such as ``+.1%``, as the terminal shows it.

    Negative numbers have a true minus sign; zero has no sign. ∞ stands for infinity, and a dash for
    NaN and None.
    """
    if value is None or value != value:
        return "–"
    text = f"{value:{form}}"
    if not text.strip("+-0.,%"):
        text = text.lstrip("+-")
    return text.replace("-", "\N{MINUS SIGN}").replace("inf", "∞")


def four_digits(value: float | None) -> str:
    """A number with four significant digits, and all those before its decimal point."""
    if value is not None and abs(float(f"{value:.4g}")) >= 1000:
        return figure(value, ",.0f")
    return figure(value, ".4g" if value is None or abs(value) < 1 else "#.4g")


def listed(names: Sequence[str], word: str = "and") -> str:
    """Names joined for a sentence: a, b and c."""
    return f" {word} ".join([*([", ".join(names[:-1])] if names[1:] else []), names[-1]])


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name that is closest to a wrong one, ignoring case; None if none is close."""
    names = {other.casefold(): other for other in known if other}
    given = name.casefold()

    def unlike(other: str) -> tuple[float, int]:  # dnq is as similar to dyna-q as to dqn
        return -difflib.SequenceMatcher(None, other, given).ratio(), abs(len(other) - len(given))

    close = difflib.get_close_matches(given, names)
    return names[min(close, key=unlike)] if close else None


def hint(name: str, known: Iterable[str]) -> str:
    """A question in parentheses with the closest known name; empty if none is close."""
    close = closest(name, known)
    return f" (did you mean {quote(close)}?)" if close else ""


def near(name: str, known: Iterable[str]) -> str:
    """What a message says after a wrong name: "did you mean …?", or the known names."""
    names = list(known)
    if close := closest(name, names):
        return f"did you mean {close}?"
    if not names:
        return "there is none to choose from."
    more = ", …" if len(names) > MENTIONED else "."
    return f"choose from {', '.join(names[:MENTIONED])}{more}"


def finite(value: Any) -> Any:
    """A document with None in place of numbers that JSON lacks: NaN and infinities."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def csv_cell(value: Any) -> Any:
    """The value of a CSV cell; text that a spreadsheet would take for a formula gets an apostrophe.

    Numbers are left alone. Semicolons and tabs start a cell, too, where a spreadsheet splits at
    them. Source: OWASP, "CSV Injection".
    """
    return _FORMULA.sub(r"\1'\2", value) if isinstance(value, str) else value
