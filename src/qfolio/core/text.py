"""Text that comes from files, made safe for messages, the terminal and CSV cells."""

import difflib
import re
import unicodedata
from collections.abc import Iterable
from typing import Any

UNSAFE = frozenset({"Cc", "Cf", "Cn", "Co", "Cs", "Zl", "Zp"})
"""Unicode categories that a terminal may obey instead of showing: control, format (which may
reverse text), unassigned, private, surrogates, line and paragraph separators."""

_FORMULA = re.compile(r"(^|[;\t\r\n])([^\S\t\r\n]*[=+\-@＝＋－＠])")


def printable(text: str) -> str:
    """The text with escapes in place of characters that a terminal may obey."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(ascii(c)[1:-1] if unicodedata.category(c) in UNSAFE else c for c in text)


def quote(value: object, limit: int = 60) -> str:
    """Any value in quotation marks, on one line and cut to ``limit`` characters."""
    text = str(value)
    return f"'{printable(text if len(text) <= limit else text[: limit - 1] + '…')}'"


def amount(count: int, noun: str) -> str:
    """1 row, 2 rows."""
    return f"{count:,} {noun}" + "s" * (count != 1)


def near(name: str, known: Iterable[str]) -> str:
    """What a message says after a wrong name: "did you mean …?", or all known names."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]}?" if close else f"choose from {', '.join(names)}."


def csv_cell(value: Any) -> Any:
    """The value of a CSV cell; text that a spreadsheet would take for a formula gets an apostrophe.

    Numbers are left alone. Semicolons and tabs start a cell, too, where a spreadsheet splits at
    them. Source: OWASP, "CSV Injection".
    """
    return _FORMULA.sub(r"\1'\2", value) if isinstance(value, str) else value
