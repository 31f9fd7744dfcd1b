"""The space of a hyperparameter search: its settings, their ranges and their scales."""

import dataclasses
import itertools
import math
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from qfolio.core import settings
from qfolio.core.errors import QfolioError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

    from qfolio.core.mdp import Agent, Task

Value = float | str
"""Value of a searched setting: a number, or a choice as text."""

USUAL = {
    "learning_rate": "1e-4..1e-2",
    "discount": "0.9..0.999",
    "tau": "1e-3..1",
    "epsilon_decay": "0.9..0.999",
    "huber_delta": "0.1..10",
    "reward_scale": "0.01..10",
    "input_gain": "0.5..50",
    "max_grad_norm": "0.1..10",
    "gae_lambda": "0.8..0.99",
    "entropy_coef": "1e-4..0.1",
    "clip_range": "0.05..0.5",
    "exploration_noise": "0.01..1",
    "initial_temperature": "0.01..1",
}
"""Settings that are searched by default, if an agent has them. A range surrounds the agent's own
value; these ranges apply if that value is 0, 1 or infinite and so gives no scale."""

AROUND = 10.0
"""A default range goes from the agent's value divided by this to the value times this."""

PROGRAMS = 64
"""Maximum number of combinations of settings that shape the program, each compiled separately."""


@dataclasses.dataclass(frozen=True)
class Dimension:
    """One searched setting: a range on a scale, or choices.

    scale: "linear", "log", "near-one" (the logarithm of 1 − value) or "choice".
    """

    name: str
    scale: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.choices:
            return "|".join(self.choices)
        prefix = "" if self.scale == _scale(self.low, self.high) else f"{self.scale}:"
        return f"{prefix}{self.low}..{self.high}"

    @property
    def key(self) -> str:
        """The setting's name in the journal."""
        return f"1-{self.name}" if self.scale == "near-one" else self.name

    def distribution(self) -> "BaseDistribution":
        """What Optuna draws stored values from."""
        from optuna.distributions import CategoricalDistribution, FloatDistribution

        if self.choices:
            return CategoricalDistribution(self.choices)
        ends = (self.low, self.high)
        if self.scale == "near-one":
            ends = (_missing(self.high), _missing(self.low))
        return FloatDistribution(*ends, log=self.scale != "linear")

    def value(self, stored: Value) -> Value:
        """The setting for a value in the journal, rounded to four significant digits."""
        if isinstance(stored, str):
            return stored
        short = float(f"{stored:.4g}")
        value = _missing(short) if self.scale == "near-one" else short
        return min(max(value, self.low), self.high)

    def stored(self, value: Value) -> Value:
        """The value in the journal for a value of the setting."""
        return _missing(value) if self.scale == "near-one" else value  # type: ignore[arg-type]

    def position(self, value: Value) -> float:
        """Position of a value on the scale, from 0 at the low end to 1 at the high end."""
        if isinstance(value, str):
            return (self.choices.index(value) + 0.5) / len(self.choices)
        if self.scale == "linear":
            return (value - self.low) / (self.high - self.low)
        ends = [self.low, value, self.high]
        if self.scale == "near-one":
            ends = [1 / _missing(end) for end in ends]
        low, here, high = map(math.log, ends)
        return (here - low) / (high - low)

    def at(self, position: float) -> float:
        """The value at a position on the scale."""
        if self.scale == "linear":
            return self.low + position * (self.high - self.low)
        ends = (self.low, self.high)
        if self.scale == "near-one":
            ends = (_missing(self.low), _missing(self.high))
        there = math.exp(math.log(ends[0]) + position * math.log(ends[1] / ends[0]))
        return _missing(there) if self.scale == "near-one" else there

    def covers(self, value: Value) -> bool:
        """Whether a value is one of the choices or lies within the range."""
        if self.choices or isinstance(value, str):
            return value in self.choices
        return self.low <= value <= self.high

    def around(self, value: float) -> "Dimension":
        """The dimension with a range around a value; unchanged if that value gives no scale."""
        whole = 1.0 if self.high <= 1 else math.inf  # shares do not exceed 1
        if self.scale == "near-one" and 0 < value < 1:
            missing = _missing(value)
            ends = (_missing(min(missing * AROUND, 1 - 1e-3)), _missing(missing / AROUND))
        elif self.scale == "log" and 0 < value < math.inf:
            ends = (value / AROUND, min(value * AROUND, whole))
        else:
            return self
        low, high = (float(f"{end:.10g}") for end in ends)
        return dataclasses.replace(self, low=low, high=high)


def parse(assignments: Iterable[str], kind: type["Agent"]) -> list[Dimension]:
    """``["name=low..high", "name=a|b", …]`` as dimensions of an agent's settings."""
    space: dict[str, Dimension] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip().replace("-", "_")
        if not (name and equals and text.strip()):
            raise QfolioError(
                "--search takes name=low..high or name=a|b|c, for example "
                f"learning_rate=1e-4..1e-2; not {assignment!r}."
            )
        if name in space:
            raise QfolioError(f"--search names {name} twice.")
        space[name] = dimension(name, text.strip(), kind)
    return list(space.values())


def dimension(name: str, text: str, kind: type["Agent"]) -> Dimension:
    """Parses one dimension; raises QfolioError if the text is not a valid range or list."""
    prefix, colon, rest = text.partition(":")
    scale, body = (prefix.strip(), rest) if colon else ("", text)
    low, dots, high = body.partition("..")
    if not dots:
        parts = [] if colon or "|" not in body else body.split("|")
        choices = [_canonical(kind, name, choice.strip()) for choice in parts]
        if not choices or len(set(choices)) < len(choices):
            raise QfolioError(
                f"{name}={text} leaves nothing to search; give a range (low..high) or different "
                "choices (a|b|c), or fix it with --set."
            )
        return Dimension(name, "choice", choices=tuple(choices))
    if scale not in ("", "log", "linear", "near-one"):
        raise QfolioError(
            f"{name}={text}: there is no scale {scale!r}; there are log, linear and near-one."
        )
    ends = [settings.convert(kind, {name: end.strip()})[name] for end in (low, high)]
    if name not in numbers(kind):
        raise QfolioError(
            f"{name} shapes the program, so each value is compiled separately; list the values: "
            f"{name}={settings.written(ends[0])}|{settings.written(ends[1])}."
        )
    bottom, top = ends
    if not (bottom < top and math.isfinite(bottom) and math.isfinite(top)):
        raise QfolioError(
            f"{name}={text} is not a range; the first number must be below the second, both finite."
        )
    scale = scale or _scale(bottom, top)
    if (scale == "log" and bottom <= 0) or (scale == "near-one" and top >= 1):
        limit = "above 0" if scale == "log" else "below 1"
        raise QfolioError(f"{name}={text}: on the scale {scale} both ends must be {limit}.")
    return Dimension(name, scale, bottom, top)


def usual(agent: "Agent") -> list[Dimension]:
    """The dimensions that are searched by default."""
    kind = type(agent)
    names = [name for name in USUAL if name in numbers(kind)]
    return [dimension(n, USUAL[n], kind).around(getattr(agent, n)) for n in names]


def numbers(kind: type["Agent"]) -> list[str]:
    """Settings that are program inputs, so that members of a population may differ in them."""
    hints = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    return [f.name for f in fields if hints[f.name] is float and not f.metadata.get("static")]


def require_buildable(agent: "Agent", task: "Task", space: Sequence[Dimension]) -> list["Agent"]:
    """An agent of each program; raises QfolioError if an end of a range or a choice is invalid."""
    kind, base = type(agent), settings.describe(agent)
    if not space:
        raise QfolioError(
            f"{kind.__name__} has no setting that is searched by default; name some with --search."
        )
    for dim in space:
        for value in dim.choices or (dim.low, dim.high):
            settings.build(kind, {**base, dim.name: value}).fitted(task)
    shaping = [dim for dim in space if dim.choices and dim.name not in numbers(kind)]
    programs = math.prod(len(dim.choices) for dim in shaping)
    if programs > PROGRAMS:
        raise QfolioError(
            f"{' × '.join(dim.name for dim in shaping)} make {programs} programs to compile; give "
            f"fewer choices, at most {PROGRAMS} combinations."
        )
    names = [dim.name for dim in shaping]
    every = itertools.product(*(dim.choices for dim in shaping))
    built = (settings.build(kind, base | dict(zip(names, each, strict=True))) for each in every)
    return [agent.fitted(task) for agent in built]


def own_value(agent: "Agent", dim: Dimension) -> Value:
    """An agent's value of a searched setting."""
    value = getattr(agent, dim.name)
    return settings.written(value) if dim.choices else float(value)


def positions(space: Sequence[Dimension], values: Mapping[str, Value]) -> np.ndarray:
    """Position of a configuration on each scale."""
    return np.clip([dim.position(values[dim.name]) for dim in space], 0.0, 1.0)


def _scale(low: float, high: float) -> str:
    """The scale of a range: logarithmic if its ends, or 1 minus them, are a factor of 10 apart."""
    if low > 0 and high / low >= 10:
        return "log"
    if high < 1 and _missing(low) / _missing(high) >= 10:
        return "near-one"
    return "linear"


def _missing(share: float) -> float:
    """1 minus a share, without floating-point noise in its digits."""
    return float(f"{1 - share:.10g}")


def _canonical(kind: type["Agent"], name: str, choice: str) -> str:
    return settings.written(settings.convert(kind, {name: choice})[name])
