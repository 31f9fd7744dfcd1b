"""Settings as text and JSON: from ``name=value`` to an object's fields, and back."""

import dataclasses
import json
import math
import typing
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from qfolio.core.errors import QfolioError
from qfolio.core.text import listed, near

T = TypeVar("T")

SCALARS = {"bool": bool, "int": int, "float": float, "str": str}
"""Types of settings that are one value, by name."""


def describe(instance: Any) -> dict[str, Any]:
    """The settings of an agent or task as JSON values; infinities become "inf" and "-inf"."""
    return {name: _described(getattr(instance, name)) for name in _types(type(instance))}


def defaults(kind: type, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of an object of which only some are chosen, as ``describe`` gives them.

    Those without a default are left out unless they are chosen.
    """
    lacking = _lacking(kind, chosen)
    if not lacking:
        return describe(build(kind, chosen))
    values = {field.name: field.default for field in dataclasses.fields(kind)}
    values |= convert(kind, chosen)
    return {name: _described(values[name]) for name in _types(kind) if name not in lacking}


def _lacking(kind: type, chosen: Mapping[str, Any]) -> list[str]:
    """Settings without a default that are not chosen."""
    types = _types(kind)
    return [
        field.name
        for field in dataclasses.fields(kind)
        if field.name in types
        and field.name not in chosen
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]


def _described(value: Any) -> Any:
    """A setting as a JSON value; JSON has no infinity."""
    if isinstance(value, tuple):
        return list(map(_described, value))
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def names(kind: type) -> set[str]:
    """Names of the settings of an agent or task."""
    return set(_types(kind))


def _types(kind: type) -> dict[str, Any]:
    """Types of the settings; fields that hold arrays are not settings."""
    hints = typing.get_type_hints(kind)
    kinds = (*SCALARS.values(), tuple[int, ...], tuple[float, ...])
    return {f.name: hints[f.name] for f in dataclasses.fields(kind) if hints[f.name] in kinds}


def written(value: Any) -> str:
    """A setting's value in the format of ``--set``."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return str(value)


def build(kind: type[T], settings: Mapping[str, Any]) -> T:
    """An agent or task with these fields set; the rest keep their defaults.

    Values are JSON values or text. Raises QfolioError for names and values that do not fit, and if
    a setting without a default is not set.
    """
    if lacking := _lacking(kind, settings):
        raise QfolioError(
            f"{kind.__name__} needs {listed(lacking)}; give {lacking[0]} a default in its class, "
            f"or set it, as in --set {lacking[0]}=1."
        )
    return kind(**convert(kind, settings))


def convert(kind: type, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of an agent or task as values of the right types; see ``build``."""
    types = _types(kind)
    known = sorted(types)
    for name in settings:
        if name not in known:
            raise QfolioError(f"{kind.__name__} has no setting {name!r}; {near(name, known)}")
    return {name: converted(name, types[name], value) for name, value in settings.items()}


def parse(
    assignments: Iterable[str],
    option: str = "--set",
    example: str = "discount=0.99",
) -> dict[str, str]:
    """``["name=value", …]`` as a dictionary; hyphens in names become underscores.

    In "agent.name=value" the agent keeps its hyphens. Raises QfolioError for anything else, and for
    a name that is given twice, with the option that they were given to.
    """
    pairs = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not (name.strip() and equals and value.strip()):
            raise QfolioError(
                f"{option} takes name=value, for example {example}; not {assignment!r}."
            )
        agent, dot, setting = name.strip().rpartition(".")
        whole = agent + dot + setting.replace("-", "_")
        if whole in pairs:
            raise QfolioError(f"{option} names {whole} twice; give it one value.")
        pairs[whole] = value.strip()
    return pairs


def divide(chosen: Mapping[str, T], *kinds: type) -> list[dict[str, T]]:
    """Splits settings by class; each goes to the one of ``kinds`` that has it.

    Raises QfolioError if none has, or several have.
    """
    parts: list[dict[str, T]] = [{} for _ in kinds]
    for name, value in chosen.items():
        found = [i for i, kind in enumerate(kinds) if name in names(kind)]
        if len(found) > 1:
            raise QfolioError(
                f"{listed([kinds[i].__name__ for i in found])} both have a setting {name!r}, "
                "so that --set cannot tell whose it is; rename one of them."
            )
        if not found:
            owners = listed([kind.__name__ for kind in kinds], "nor")
            advice = near(name, sorted(set().union(*map(names, kinds))))
            raise QfolioError(f"neither {owners} has a setting {name!r}; {advice}")
        parts[found[0]][name] = value
    return parts


def called(text: str) -> tuple[str, dict[str, str]]:
    """The name and the settings of a part that is written as ``name(setting=value, …)``.

    Raises QfolioError if it is written differently.
    """
    name, bracket, rest = text.strip().partition("(")
    if not bracket:
        return name, {}
    inside = rest.removesuffix(")").strip()
    pairs = [part.partition("=") for part in inside.split(",")] if inside else []
    chosen = {setting.strip(): value.strip() for setting, _, value in pairs}
    if not (name and rest.endswith(")") and all(chosen) and all(chosen.values())):
        raise QfolioError(f"{text!r} must be written like itemized(fixed=5, spread=0.0004).")
    return name.strip(), chosen


def converted(name: str, kind: Any, value: Any) -> Any:
    """A setting's value, which may be text, as one of its type.

    Raises QfolioError if it does not fit.
    """
    try:
        if kind is bool:
            return {"true": True, "false": False}[str(value).lower()]
        if kind is int:
            number = float(value)
            if isinstance(value, bool) or number != int(number):
                raise ValueError
            return int(number)
        if kind is float:
            number = float(value)
            if isinstance(value, bool) or math.isnan(number):
                raise ValueError
            return number
        if kind is str:
            if not isinstance(value, str):
                raise ValueError
            return value
        item_kind = typing.get_args(kind)[0]
        if isinstance(value, str):  # tuple[int, ...]: 256,256
            value = value.strip("()[] ").rstrip(",").split(",")
        elif item_kind is float and isinstance(value, int | float):
            value = [value]
        return tuple(converted(name, item_kind, item) for item in value)
    except (ValueError, TypeError, KeyError, OverflowError, QfolioError):
        examples = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
        examples[tuple[float, ...]] = "numbers separated by commas, for example 0.9,0.98"
        wanted = examples.get(kind, "whole numbers separated by commas, for example 256,256")
        raise QfolioError(
            f"{name} is {json.dumps(value, default=str)}; it must be {wanted}."
        ) from None
