"""Tasks and agents in configurations: by name and settings."""

import dataclasses
import hashlib
import inspect
from collections.abc import Mapping
from datetime import date, timedelta
from enum import Enum
from functools import partial
from typing import Any

import jax
import numpy as np

from qfolio.core import settings
from qfolio.core.errors import QfolioError, require_type
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import Kind, build, name_of
from qfolio.core.text import quote

OTHERS = "other fields"
"""The key of digests of the fields that are no settings; no field can have this name."""

WHERE = {
    "task": "as in qfolio.Run.open(folder, task=…)",
    "agent": "as agent=…, or in agents={…} of a backtest",
}
"""How to give what a folder does not hold where the folder is opened."""

PLAIN = (str, bytes, int, float, complex, range, date, timedelta, Enum, type(None))
"""Types whose values a representation tells apart, in any process."""


def describe(task: Task, agent: Agent) -> dict[str, Any]:
    """A task and an agent by name and settings, under the keys of configurations."""
    return {
        "task": name_of(task),
        "task_settings": recorded(task),
        "agent": name_of(agent),
        "agent_settings": recorded(agent),
    }


def recorded(instance: Task | Agent) -> dict[str, Any]:
    """The settings of a task or an agent, with digests of its other fields if it is given some."""
    found = settings.describe(instance)
    others = _others(instance)
    return found | {OTHERS: others} if others else found


def plain(described: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a task or an agent alone, without digests of its other fields."""
    return {name: value for name, value in described.items() if name != OTHERS}


def task_of(name: str, described: dict[str, Any], given: Task | None = None) -> Task:
    """The task of a configuration; imports no module that only the configuration names.

    given: the task itself, if it cannot be restored. Raises QfolioError if it is another one, or if
    it is not given and the settings alone make another one.
    """
    task: Task = _part("task", Task, "a task, such as qfolio.Pendulum()", name, described, given)
    return task


def agent_of(name: str, described: dict[str, Any], given: Agent | None = None) -> Agent:
    """The agent of a configuration; see ``task_of``."""
    agent: Agent = _part("agent", Agent, "an agent, such as qfolio.DQN()", name, described, given)
    return agent


def require_described(whole: str, *parts: Task | Agent) -> None:
    """Raises QfolioError unless names and settings alone make these tasks and agents again.

    whole: the work that keeps no more of them, such as "A comparison".
    """
    for part in parts:
        kind: Kind = "task" if isinstance(part, Task) else "agent"
        name, described = name_of(part), recorded(part)
        takes = f"{whole} takes only what a name and settings describe"
        try:
            lost = _differing(build(kind, name, plain(described)), described)
        except QfolioError:
            raise QfolioError(
                f"{takes}, and these do not make the {kind} {name}; define its class outside of "
                "functions, with a default for each field."
            ) from None
        for field in lost:
            raise QfolioError(
                f"{takes}, but {field} of the {kind} {name} is no setting, and not its default; "
                "make it the default of a class of its own."
            )


def _part(
    kind: Kind, base: type, wanted: str, name: str, described: dict[str, Any], given: Any
) -> Any:
    values = plain(described)
    if given is None:
        found = build(kind, name, values)
        for field in _differing(found, described):
            raise QfolioError(
                f"{field} of the {kind} {name} is no setting, so no folder holds it, and it was "
                f"not its default; give the {kind} itself where the folder is opened, "
                f"{WHERE[kind]}."
            )
        return found
    require_type(kind, given, base, wanted)
    for key, now, stored in (
        (kind, name_of(given), name),
        (f"{kind}_settings", settings.describe(given), values),
    ):
        if now != stored:
            raise QfolioError(
                f"{key} is {quote(now)}, but what the folder holds was trained with "
                f"{quote(stored)}; give that {kind}."
            )
    for field in _differing(given, described):
        raise QfolioError(
            f"{field} of the {kind} is not what the folder was trained with; give that {kind}."
        )
    return given


def _differing(instance: Any, described: dict[str, Any]) -> list[str]:
    """The fields that are no settings, and not as described; earlier folders describe none."""
    now = _others(instance)
    return [name for name, old in described.get(OTHERS, {}).items() if now.get(name) != old]


def _others(instance: Any) -> dict[str, str]:
    """Digests of the fields that are no settings, by name.

    There are none if the class takes only settings: its other fields follow from these.
    """
    known = settings.names(type(instance))
    if known.issuperset(inspect.signature(type(instance)).parameters):
        return {}
    others = [each.name for each in dataclasses.fields(instance) if each.name not in known]
    return {name: _digest(repr(_content(getattr(instance, name))).encode()) for name in others}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _content(value: Any) -> Any:
    """Text, or tuples of it, which is the same for equal values, also in another process.

    Numbers, text, dates, ranges, arrays and data frames with their labels are told apart, as are
    dataclasses, partial functions and collections of such. Of a class or function it says the name
    only, and of anything else that of its class.
    """
    if isinstance(value, type):
        return value.__qualname__
    if isinstance(value, np.generic) and value.dtype.kind not in "mM":  # dates have their units
        value = value.item()
    if dataclasses.is_dataclass(value):
        each = ((f.name, _content(getattr(value, f.name))) for f in dataclasses.fields(value))
        return type(value).__qualname__, *each
    if isinstance(value, Mapping):
        return tuple(sorted((_content((key, each)) for key, each in value.items()), key=repr))
    if isinstance(value, set | frozenset):
        return tuple(sorted(map(_content, value), key=repr))
    if isinstance(value, list | tuple):
        return tuple(map(_content, value))
    if isinstance(value, partial):
        return _content((value.func, value.args, value.keywords))
    if isinstance(value, PLAIN):
        return repr(value)
    if isinstance(value, jax.Array) and jax.numpy.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if hasattr(value, "__array__"):  # of numpy, jax, pandas, …
        array = np.asarray(value)
        labels = _content(getattr(value, "axes", None) or getattr(value, "columns", ()))
        if not array.dtype.hasobject:
            return array.dtype.str, array.shape, _digest(array.tobytes()), *labels
        if array.ndim:
            return _content(array.tolist()), *labels
    return getattr(value, "__qualname__", type(value).__qualname__)
