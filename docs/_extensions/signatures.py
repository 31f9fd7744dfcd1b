"""Shows signatures and fields as they are written in the source, with jaxtyping's shapes."""

import ast
import dataclasses
import inspect
import textwrap
from typing import Any

import equinox as eqx
from source import annotations, comments
from sphinx.application import Sphinx


def written(app: Sphinx, what: str, name: str, found: Any, *_: Any) -> tuple[str, str] | None:
    """The arguments and the result of a function, or of a class's own ``__init__``."""
    if what == "class":
        found = found.__dict__.get("__init__") or found
        if isinstance(found, type):
            return ("", "") if issubclass(found, eqx.Module | tuple) else None
    try:
        source = inspect.getsource(found)
    except (OSError, TypeError):  # made by a decorator, as a dataclass's __init__ is
        return ("", "") if what == "class" and not dataclasses.is_dataclass(found) else None
    node = ast.parse(textwrap.dedent(source)).body[0]
    if not isinstance(node, ast.FunctionDef):
        return None
    arguments = node.args
    before = arguments.posonlyargs or arguments.args
    if before and before[0].arg in ("self", "cls"):
        del before[0]
    result = ast.unparse(node.returns) if node.returns and what != "class" else ""
    return f"({ast.unparse(arguments)})", result.strip("'\"")


def with_fields(
    app: Sphinx, what: str, name: str, found: Any, options: Any, lines: list[str]
) -> None:
    """Adds a class's fields, with their types and the comments beside them, to its docstring."""
    if what != "class" or not (issubclass(found, tuple) or dataclasses.is_dataclass(found)):
        return
    if "Attributes:" in (found.__doc__ or ""):
        return
    notes, types = comments(found), annotations(found)
    rows = [(field, types[field], notes.get(field)) for field in types]
    if rows:
        lines += ["", "**Fields**", ""]
        lines += [f"* ``{n}: {t}``" + (f" — {note}" if note else "") for n, t, note in rows]
        lines.append("")


def is_field(app: Sphinx, what: str, name: str, found: Any, skip: bool, options: Any) -> bool:
    """Leaves out what Python itself says of a named tuple's fields."""
    return skip or str(getattr(found, "__doc__", "")).startswith("Alias for field number")


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers what autodoc calls."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-signature", written)
    app.connect("autodoc-process-docstring", with_fields)
    app.connect("autodoc-skip-member", is_field)
    return {"parallel_read_safe": True}
