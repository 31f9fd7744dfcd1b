"""What docs/reference/ must have: every public name, and what each setting means."""

import ast
import dataclasses
import importlib.util
import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import qfolio
from qfolio.cli import commands
from qfolio.core import settings
from qfolio.core.registry import ENTRIES, find
from qfolio.portfolio.backtest.statistics.assessment import (
    KINDS,
    Assessment,
    StrategyAssessment,
)
from qfolio.portfolio.backtest.statistics.measures import MEASURES
from qfolio.portfolio.backtest.statistics.sharpe import SharpeTest
from qfolio.portfolio.desk.follow import COLUMNS
from qfolio.portfolio.study.evidence import Active, Evidence

DOCS = Path(__file__).parents[1] / "docs"
PAGES = "\n".join(page.read_text() for page in sorted((DOCS / "reference").glob("*.md")))

spec = importlib.util.spec_from_file_location("source", DOCS / "_extensions" / "source.py")
assert spec is not None
assert spec.loader is not None
source = importlib.util.module_from_spec(spec)
spec.loader.exec_module(source)

PARTS = {
    (kind, name): find(kind, name) for kind, entries in ENTRIES.items() for name in entries.table
}


def resolve(path: str) -> Any:
    """What a dotted path names."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name) if module else import_module(name)


WRITTEN = {
    path: resolve(path) for path in re.findall(r"auto(?:class|function|exception):: (\S+)", PAGES)
}


def defined() -> set[str]:
    """Every name that qfolio's source defines, and its files."""
    root = Path(qfolio.__file__).parent
    names: set[str] = set()
    for path in root.rglob("*.py"):
        names |= {path.stem, path.relative_to(root).as_posix()}
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                names.add(node.id)
    return names


def test_the_code_of_a_formula_is_where_its_page_says():
    tables = [
        table.splitlines()
        for page in (DOCS / "algorithms").glob("*.md")
        for table in re.findall(r"^\|.*\| where \|\n(?:\|.*\n)+", page.read_text(), re.M)
    ]
    named = {
        name for _, _, *rows in tables for row in rows
        for name in re.findall(r"`(.+?)`", row.split("|")[-2])
    }  # fmt: skip
    assert len(named) > 100
    known = defined()
    assert {x for x in named if not ({x} if "/" in x else {*x.split(".")}) <= known} == set()


def test_every_public_name_has_its_reference():
    assert {kind for kind in ENTRIES if f"{{parts}} {kind}\n" in PAGES} == set(ENTRIES)
    there = {*WRITTEN.values(), *PARTS.values()}
    public = {name: getattr(qfolio, name) for name in qfolio.__all__ if name != "__version__"}
    public |= {
        entries.base: resolve(entries.base.replace(":", ".")) for entries in ENTRIES.values()
    }
    assert {name for name, found in public.items() if found not in there} == set()


def test_every_public_name_has_a_docstring():
    documented = {**WRITTEN, **{f"{kind} {name}": found for (kind, name), found in PARTS.items()}}
    silent = {name for name, found in documented.items() if not inspect.getdoc(found)}
    for name, found in WRITTEN.items():
        for member, value in vars(found).items() if isinstance(found, type) else ():
            shown = isinstance(value, property) or inspect.isroutine(value)
            if shown and not member.startswith("_") and not inspect.getdoc(getattr(found, member)):
                silent.add(f"{name}.{member}")
    assert silent == set()


@pytest.mark.parametrize(
    ("kind", "name"), [key for key in PARTS if key[0] in ("agent", "task", "cost")]
)
def test_every_setting_has_a_meaning(kind, name):
    """A comment beside it, or a sentence in its class's docstring that begins with its name."""
    found = PARTS[kind, name]
    parents = [parent for parent in found.__mro__ if parent.__module__.startswith("qfolio.")]
    meant = {field for parent in parents for field in source.comments(parent)}
    meant |= set(re.findall(r"\b(\w+)(?=(?:, \w+)*:)", inspect.getdoc(found) or ""))
    assert settings.names(found) - meant == set()


def test_every_command_says_what_it_does():
    assert {name for name, command in commands().items() if not inspect.getdoc(command)} == set()
    assert "{commands}" in PAGES


def test_every_column_and_key_of_a_file_is_explained():
    page = (DOCS / "reference" / "files.md").read_text()
    forms = (Assessment, StrategyAssessment, SharpeTest)
    written = {field.name for form in forms for field in dataclasses.fields(form)}
    written |= {*KINDS, *MEASURES, *COLUMNS, *Active.__struct_fields__, *Evidence.__struct_fields__}
    shared = {"to_reference", "to_rebalanced"}  # the start of a name in study.csv
    assert {f"`{name}_…`" for name in shared} <= set(re.findall(r"`[^`]+`", page))
    assert written - set(re.findall(r"`(\w+)`", page)) == set()
