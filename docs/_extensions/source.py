"""The fields of a class as the source has them: their types, and the comments beside them."""

import ast
import inspect
import io
import textwrap
import tokenize


def comments(kind: type) -> dict[str, str]:
    """The comment on the line of each field that a class defines itself."""
    tokens = tokenize.generate_tokens(io.StringIO(_source(kind)).readline)
    found = {t.start[0]: t.string[1:].strip() for t in tokens if t.type == tokenize.COMMENT}
    lines = {name: line.end_lineno or 0 for name, line in _fields(kind).items()}
    return {name: found[line] for name, line in lines.items() if line in found}


def annotations(kind: type) -> dict[str, str]:
    """The types of a class's own public fields."""
    types = {name: ast.unparse(line.annotation) for name, line in _fields(kind).items()}
    return {k: v for k, v in types.items() if not k.startswith("_") and "ClassVar" not in v}


def _fields(kind: type) -> dict[str, ast.AnnAssign]:
    (definition,) = ast.parse(_source(kind)).body
    assert isinstance(definition, ast.ClassDef)
    lines = [line for line in definition.body if isinstance(line, ast.AnnAssign)]
    return {line.target.id: line for line in lines if isinstance(line.target, ast.Name)}


def _source(kind: type) -> str:
    return textwrap.dedent(inspect.getsource(kind))
