"""Typed configuration of a folder: written as JSON and validated when read."""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, ClassVar, TypeVar

import msgspec

from qfolio.core.errors import QfolioError
from qfolio.core.files import read_json, write_json
from qfolio.core.text import quote
from qfolio.core.version import __version__

AGENT_NAME = r"^\w[\w-]*(:[\w-]+)?$"
"""Pattern of the names that agents have in a comparison or a backtest, such as dqn or dqn:fast.

A spreadsheet would take a name that starts with - for a formula.
"""

AgentName = Annotated[str, msgspec.Meta(pattern=AGENT_NAME)]


def agent_folder(name: str) -> str:
    """The name of an agent's folder; some systems allow no colon there."""
    return name.replace(":", "-")


def require_agent_names(names: Collection[str]) -> None:
    """Raises QfolioError unless each can be an agent's name, and that of a folder of its own."""
    for name in names:
        if not (isinstance(name, str) and re.fullmatch(AGENT_NAME, name)):
            raise QfolioError(
                f"An agent is called {quote(name)}; use letters, digits, - and _, with no - at "
                "the start and at most one colon within, as in tilts:low-risk."
            )
        folder = agent_folder(name).casefold()  # some systems do not tell a from A
        other = next((n for n in names if n != name and agent_folder(n).casefold() == folder), None)
        if other is not None:
            raise QfolioError(f"{name} and {other} would share a folder; rename one.")


class Config(msgspec.Struct, kw_only=True, frozen=True):
    """The configuration of a folder; each kind of folder has a subclass.

    Annotated fields constrain values: ``seeds: Annotated[int, msgspec.Meta(ge=1)]``. Constraints
    that types cannot express are checked in ``__post_init__``, which raises ValueError or
    QfolioError.
    """

    kind: ClassVar[str]
    """Name of this kind of folder in messages, such as "backtest"."""

    format: ClassVar[int]
    """Number of the format; a change that makes older folders unreadable raises it by one."""

    version: str = __version__
    """Version of qfolio that wrote the file."""


C = TypeVar("C", bound=Config)


def write_config(path: Path, config: Config) -> None:
    """Writes the settings with their kind and the number of their format."""
    head = {"kind": config.kind, "format": config.format}
    write_json(path, {**head, **msgspec.to_builtins(config)})


def read_config(path: Path, kind: type[C]) -> C:
    """Reads the settings in a file.

    Raises QfolioError if the file is missing, belongs to a folder of another kind, was written in
    another format, or holds invalid values.
    """
    if not path.is_file():
        raise QfolioError(
            f"{path.parent} is no {kind.kind}: it has no {path.name}; give the folder of one."
        )
    content = read_json(path)
    found = content.pop("kind", None)
    if isinstance(found, str) and found != kind.kind:
        raise QfolioError(f"{path.parent} is a {found}, not a {kind.kind}; give the folder of one.")
    form = content.pop("format", None)
    if found != kind.kind or form != kind.format:
        known = found == kind.kind and isinstance(form, int)
        newer = known and form > kind.format
        age = "" if not known else ", a newer one" if newer else ", an older one"
        advice = "update qfolio" if newer else "use that version"
        raise QfolioError(
            f"{path.parent} was written by qfolio {content.get('version', '(unknown version)')} in "
            f"another format{age}; this is {__version__}: {advice}, or start over."
        )
    try:
        return msgspec.convert(content, kind)
    except (msgspec.ValidationError, QfolioError) as error:
        reason = _readable(str(error)).rstrip(".")
        raise QfolioError(f"{path} is damaged ({reason}); restore it, or start over.") from None


def _readable(message: str) -> str:
    """msgspec's message with the place first: "agents.dqn.seeds: expected int, got str"."""
    text, _, place = message.replace("`", "").partition(" - at $")
    if missing := re.fullmatch(r"Object missing required field (\w+)", text):
        return f"{place}.{missing[1]} is missing".lstrip(".")
    return f"{place.lstrip('.')}: {text[:1].lower()}{text[1:]}" if place else text
