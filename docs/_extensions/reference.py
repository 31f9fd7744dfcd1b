"""Directives that write the reference from the program: ``commands`` and ``parts``."""

import dataclasses
import inspect
import re
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

import tyro
from docutils import nodes
from source import comments
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import qfolio
from qfolio.cli import commands
from qfolio.core import settings
from qfolio.core.registry import ENTRIES, find
from qfolio.experiments.budget import Budget
from qfolio.experiments.presets import PRESETS


class Commands(SphinxDirective):
    """Every command: what it does, and a table of its arguments, in groups."""

    def run(self) -> list[nodes.Node]:
        text = "\n\n".join(command(name, action) for name, action in commands().items())
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Parts(SphinxDirective):
    """Everything of one kind in the registry: docstrings, settings and presets."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        kind = self.arguments[0]
        text = "\n\n".join(part(kind, name) for name in ENTRIES[kind].table)
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def command(name: str, action: Any) -> str:
    """The section of a command."""
    with warnings.catch_warnings():  # tyro offers no other way to its arguments
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(action)
    groups: dict[str, list[list[str]]] = {}
    for argument in parser._actions:
        if argument.dest != "help":
            typed = f"{', '.join(argument.option_strings)} {argument.metavar or ''}".strip()
            title = (argument.container.title or "options").capitalize()
            groups.setdefault(title, [[f"**{title}**", ""]]).append(
                [f"`{typed}`", linked(argument.help or "")]
            )
    rows = [row for group in groups.values() for row in group]
    about = linked(parser.description or "")
    return "\n\n".join([f"## qfolio {name}", about, table(["Argument", "Meaning"], rows)])


def part(kind: Any, name: str) -> str:
    """The section of an agent, task, baseline, reward, cost model, signal or tracker."""
    found = find(kind, name)
    exported = getattr(qfolio, found.__name__, None) is found
    module = "qfolio" if exported else found.__module__
    text = [f"## {name}"]
    text.append(
        f":::{{py:class}} {found.__name__}\n:module: {module}\n\n{linked(described(found))}\n:::"
    )
    if dataclasses.is_dataclass(found):
        rows = [[f"`{field}`", code(value), linked(note)] for field, value, note in fields(found)]
        text.append(table(["Setting", "Default", "Meaning"], rows))
    rows = [
        [task, preset, code(chosen.settings), budget(chosen.budget), str(chosen.seeds)]
        for (task, agent), presets in PRESETS.items()
        for preset, chosen in presets.items()
        if kind == "agent" and agent == name
    ]
    text.append(table(["Task", "Preset", "Settings", "Budget", "Seeds"], rows))
    return "\n\n".join(text)


def described(kind: type) -> str:
    """A class's docstring in Markdown, with a paragraph for errors instead of a section."""
    return re.sub(
        r"^(Args|Raises|Returns):\n", r"**\1**\n\n", inspect.getdoc(kind) or "", flags=re.M
    )


def linked(text: str) -> str:
    """A text of the program, whose pages become links."""
    return re.sub(r"docs/([\w/]+?)(\w+)\.md", r"[\2](../\1\2.md)", text)


def budget(chosen: Budget) -> str:
    return f"{chosen.amount:,} {chosen.unit}"


def fields(kind: type) -> Iterator[tuple[str, Any, str]]:
    """The settings of a class: their names, defaults, and the comments beside them."""
    notes: dict[str, str] = {}
    for parent in reversed(kind.__mro__):
        if parent.__module__.startswith("qfolio."):
            notes |= comments(parent)
    known = settings.names(kind)
    for field in dataclasses.fields(kind):
        if field.name in known:
            made = field.default_factory
            default = field.default if made is dataclasses.MISSING else made()
            yield field.name, default, notes.get(field.name, "")


def code(value: Any) -> str:
    """A setting's value, or several settings, as one types them."""
    if isinstance(value, dict):
        return " ".join(f"`{name}={plain(chosen)}`" for name, chosen in value.items())
    return f"`{plain(value)}`" if plain(value) else "none"


def plain(value: Any) -> str:
    if isinstance(value, tuple | list):
        return ",".join(map(plain, value))
    if isinstance(value, float):
        return f"{value:.10g}"
    return str(value).lower() if isinstance(value, bool) else str(value)


def table(head: list[str], rows: Iterable[list[str]]) -> str:
    """A table in Markdown; columns that are empty in every row are left out."""
    rows = [[" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in rows]
    kept = [i for i in range(len(head)) if any(row[i] for row in rows)]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line[i] for i in kept) + " |" for line in lines if kept)


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directives."""
    app.add_directive("commands", Commands)
    app.add_directive("parts", Parts)
    return {"parallel_read_safe": True}
