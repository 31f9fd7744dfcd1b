"""Imports point down the house, also those inside functions and those for the type checker."""

import ast
from pathlib import Path

import pytest

import qfolio

SOURCE = Path(qfolio.__file__).parent
FLOORS = [
    {"core"}, {"solvers"}, {"learning"}, {"agents", "tasks"}, {"experiments"}, {"portfolio"},
    {"adapters"}, {"report"}, {"commands"}, {"cli", "__init__", "__main__"},
]  # fmt: skip
FLOOR = {wing: number for number, wings in enumerate(FLOORS) for wing in wings}


def imported(path):
    """Modules of the package that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("wing", sorted(FLOOR.keys() - FLOORS[-1]))
def test_no_import_points_up(wing):
    files = sorted((SOURCE / wing).rglob("*.py"))
    assert files
    for path in files:
        for name in imported(path):
            package, _, rest = name.partition(".")
            if package == "qfolio":
                other = rest.partition(".")[0]
                allowed = other == wing or FLOOR.get(other, 99) < FLOOR[wing]
                assert allowed, f"{path.relative_to(SOURCE)} imports {name}"


def test_the_statistics_of_a_backtest_stand_alone():
    own = "qfolio.portfolio.backtest.statistics"
    files = sorted((SOURCE / "portfolio" / "backtest" / "statistics").glob("*.py"))
    assert files
    for path in files:
        for name in imported(path):
            allowed = not name.startswith("qfolio") or name.startswith((own, "qfolio.core"))
            assert allowed, f"{path.name} imports {name}"


def test_every_module_lies_in_a_wing():
    there = {path.stem for path in SOURCE.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert there - {"__pycache__"} == FLOOR.keys()


def test_tests_mirror_the_source():
    """A test file lies where the module that it tests does."""
    tests = Path(__file__).parent
    for folder in {path.parent for path in tests.rglob("test_*.py")} - {tests}:
        assert (SOURCE / folder.relative_to(tests)).is_dir(), folder
