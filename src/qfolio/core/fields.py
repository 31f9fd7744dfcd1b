"""How agents and tasks declare and check their settings."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.settings import SCALARS, converted

T = TypeVar("T")

FIXED = {"int": "is a whole number", "bool": "is true or false", "str": "is text"}
"""Types of settings that shape the program, by name, and what is said of these."""


def static(default: Any) -> Any:
    """A setting that is fixed when the program is compiled: members of a population share it."""
    return _field(default, static=True)


def number(default: float) -> Any:
    """A number that is an input of the program: members of a population may differ in it."""
    return _field(default, float)


def constant(default: float) -> Any:
    """A number that is fixed when the program is compiled."""
    return _field(default, float, static=True)


def sizes(*default: int) -> Any:
    """Layer sizes, fixed when the program is compiled."""
    return _field(default, tuple[int, ...], static=True)


def numbers(*default: float) -> Any:
    """Several numbers, fixed when the program is compiled; a single number becomes a tuple."""
    return _field(default, tuple[float, ...], static=True)


def _field(default: Any, kind: Any = None, *, static: bool = False) -> Any:
    """A setting that takes the values that ``settings.converted`` takes, and those of a program.

    kind: its type (default: the annotation; values of other types than ``SCALARS`` are not judged).
    """

    def convert(value: Any) -> Any:
        wanted = kind or SCALARS.get(getattr(field.type, "__name__", field.type))
        if wanted is None or value is field.default or isinstance(value, jax.core.Tracer):
            return value  # repr leaves defaults out
        return converted(field.name, wanted, value)

    if isinstance(default, np.generic):
        default = default.item()  # as JSON has it
    field = eqx.field(converter=convert, static=static, default=default)
    return field


class Group(Generic[T]):
    """Some settings of an instance, in a named tuple whose fields have their names.

    A field keeps its default if the instance has no setting of its name.
    """

    def __init__(self, kind: Callable[..., T]) -> None:
        self.kind, self.names = kind, tuple(inspect.signature(kind).parameters)

    def __get__(self, instance: Any, owner: Any = None) -> T:
        if instance is None:
            raise AttributeError("settings are those of an instance")
        names = (name for name in self.names if hasattr(instance, name))
        return self.kind(**{name: getattr(instance, name) for name in names})


def require(instance: Any, names: str, holds: Callable[[Any], bool], wanted: str) -> None:
    """Raises QfolioError for the first setting for which ``holds`` is false.

    names: of the settings, separated by spaces. wanted: what the value must be, for the message.
    """
    for name in names.split():
        value = getattr(instance, name)
        if isinstance(value, str | int | float | tuple) and not holds(value):  # not while traced
            if isinstance(value, tuple):
                value = ", ".join(map(str, value)) or "empty"
            raise QfolioError(f"{name} is {value}; it must be {wanted}.")


def require_counts(instance: Any, names: str, least: int = 1) -> None:
    """Raises QfolioError for the first setting that is below ``least`` or does not fit 32 bits.

    names: of the settings, separated by spaces.
    """
    require(instance, names, lambda x: least <= x < 2**31, f"from {least} to 2³¹ − 1")


def require_static(instance: Any) -> None:
    """Raises QfolioError if a setting is not ``static`` but has to be, or a default is undeclared.

    Integers are counts, and counts shape the compiled program, as do words and choices; it takes
    only numbers and arrays, not functions beside these, as in a network. A subclass that gives an
    inherited setting a value without its type would change nothing.
    """
    name = type(instance).__name__
    for field in dataclasses.fields(instance):
        fixed, kind = field.metadata.get("static"), str(getattr(field.type, "__name__", field.type))
        leaves = [] if fixed else jax.tree.leaves(getattr(instance, field.name))
        others = [_kind(leaf) for leaf in leaves if not eqx.is_array_like(leaf)]
        if not fixed and (kind in FIXED or others):
            advice = f"declare it as {field.name}: {kind} = static(…), from qfolio.core.fields"
            if others and any(isinstance(leaf, jax.Array | np.ndarray) for leaf in leaves):
                advice = "keep its arrays, as from eqx.partition, and make the rest in a method"
            raise QfolioError(
                f"{field.name} of {name} {FIXED.get(kind) or others[0]}, which shapes the program; "
                f"{advice}."
            )
        first = next((each for each in type(instance).__mro__ if field.name in vars(each)), None)
        if first and field.name not in inspect.get_annotations(first):
            raise QfolioError(
                f"{field.name} of {name} is a setting, whose default needs its type; declare it as "
                f"{field.name}: {kind} = {'static' if fixed else 'number'}(…), from "
                "qfolio.core.fields."
            )


def _kind(leaf: Any) -> str:
    """What is said of a field with a leaf that is neither a number nor an array."""
    return "holds a function" if callable(leaf) else f"is of type {type(leaf).__name__}"


def require_sizes(instance: Any, name: str = "hidden") -> None:
    """Raises QfolioError unless a setting holds one or more layer sizes of at least 1."""
    holds = lambda x: len(x) > 0 and min(x) >= 1 and max(x) < 2**31  # noqa: E731
    require(instance, name, holds, "one or more layer sizes from 1 to 2³¹ − 1")
