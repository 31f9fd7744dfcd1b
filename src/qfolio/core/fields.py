"""How agents and tasks declare and check their settings."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx

from qfolio.core.errors import QfolioError


def static(default: Any) -> Any:
    """A setting that is fixed when the program is compiled: members may not differ in it."""
    return eqx.field(static=True, default=default)


def number(default: float) -> Any:
    """A setting that is an input of the program: members may differ in it."""
    return eqx.field(converter=float, default=default)


def constant(default: float) -> Any:
    """A number that is fixed when the program is compiled."""
    return eqx.field(static=True, converter=float, default=default)


def sizes(*default: int) -> Any:
    """Sizes of layers, fixed when the program is compiled."""
    return eqx.field(static=True, converter=tuple, default=default)


def numbers(*default: float) -> Any:
    """Several numbers, fixed when the program is compiled; one alone becomes a tuple of one."""
    return eqx.field(static=True, converter=_floats, default=default)


def _floats(values: float | Iterable[float]) -> tuple[float, ...]:
    return tuple(map(float, values if isinstance(values, Iterable) else (values,)))


def require(instance: Any, names: str, holds: Callable[[Any], bool], wanted: str) -> None:
    """Raises QfolioError for the first of the settings that does not hold."""
    for name in names.split():
        value = getattr(instance, name)
        if isinstance(value, str | int | float | tuple) and not holds(value):  # not while traced
            raise QfolioError(f"{name} is {value}; it must be {wanted}.")


def require_static(instance: Any) -> None:
    """Raises QfolioError if a whole number is declared as an input of the program.

    Whole numbers are counts, and counts shape the program.
    """
    for field in dataclasses.fields(instance):
        if field.type in (int, "int") and not field.metadata.get("static"):
            raise QfolioError(
                f"{field.name} of {type(instance).__name__} is a whole number, which shapes the "
                f"program; declare it as {field.name}: int = static(…), from qfolio.core.fields."
            )


def require_sizes(instance: Any, name: str = "hidden") -> None:
    holds = lambda x: len(x) > 0 and min(x) >= 1 and max(x) < 2**31  # noqa: E731
    require(instance, name, holds, "one or more layer sizes")
