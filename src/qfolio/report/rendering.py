"""Rendering shared by all pages: templates, styles, and the format of numbers and settings."""

import json
import math
import re
from collections.abc import Callable, Collection, Sequence
from importlib import resources
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined

from qfolio.core.text import figure, plural
from qfolio.report import palette

THIN_SPACE = "\N{NARROW NO-BREAK SPACE}"

_NUMBER_WORDS = (
    *("No", "One", "Two", "Three", "Four", "Five", "Six"),
    *("Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve"),
)


def source(name: str) -> str:
    """Return the text of a file in ``templates``."""
    return resources.files(__package__).joinpath("templates", name).read_text(encoding="utf-8")


def render(template: str, **context: Any) -> str:
    """Return the text of a page; the context is escaped, unless it is Markup."""
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(source),
    )
    environment.filters.update(number=number, percent=percent)
    environment.globals.update(bands=bands, plural=plural)
    return environment.get_template(template).render(palette=palette, **context)


def number(value: float, digits: int = 1, *, sign: bool = False) -> str:
    """Return a number with a typographic minus sign and commas between thousands."""
    return figure(value, f"{'+' if sign else ''},.{digits}f")


def typeset(text: str) -> str:
    """Return a text with typographic minus signs, apostrophes and spaces before seconds."""
    text = re.sub(r"(?<![\w.])-(?=\d)", "\N{MINUS SIGN}", text.replace("'", "’"))
    return re.sub(r"(?<=\d) (?=s\b)", THIN_SPACE, text)


def years(first: str, last: str) -> str:
    """The calendar years between two dates, such as "1990 to 2022", or the one year of both."""
    return first[:4] if first[:4] == last[:4] else f"{first[:4]} to {last[:4]}"


def percent(fraction: float, digits: int = 1, *, sign: bool = False) -> str:
    """Return a fraction as a percentage."""
    if math.isnan(fraction):
        return "–"
    return f"{number(100 * fraction, digits, sign=sign)}%"


def shade(share: float) -> str:
    """The class of a table's cell, in five shades of more (up to 1) or less (down to −1)."""
    level = min(math.ceil(5 * abs(share) - 1e-9), 5)
    return f"{'gain' if share > 0 else 'loss'}{level}" if level else ""


def over_seeds(
    values: Collection[float],
    interval: Sequence[float] | None,
    write: Callable[[float], str],
) -> str:
    """Return the spread of results over seeds: a 95% interval, or the range if seeds are few."""
    if len(values) == 1:
        return "one seed"
    if interval is None:
        return f"{len(values)} seeds, {write(min(values))} to {write(max(values))}"
    return f"95% interval {write(interval[0])} to {write(interval[1])}"


def bands(seeds: int) -> str:
    """Return a description of the bands of learning curves; see ``core.statistics.band``."""
    from qfolio.core.statistics import FEWEST_SEEDS  # loads numpy, which the board does without

    if seeds < FEWEST_SEEDS:
        return "from the worst to the best seed"
    return "95% bootstrap intervals over seeds"


def large(count: float) -> str:
    """Return a large whole number with at least three significant digits."""
    if count >= 1e6:
        return f"{number(count / 1e6, 2)} million"
    return number(count, 0)


def counted(count: int, noun: str) -> str:
    """Return a count in words to begin a sentence, for example 'Two agents'."""
    word = _NUMBER_WORDS[count] if count < len(_NUMBER_WORDS) else str(count)
    return f"{word} {plural(noun, count)}"


def duration(seconds: float) -> str:
    """Return a time span in the unit that suits it."""
    if seconds < 10:
        return f"{seconds:.1f}{THIN_SPACE}s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [(hours, "h"), (minutes, "min"), (rest, "s")]
    kept = [f"{count}{THIN_SPACE}{unit}" for count, unit in parts if count]
    return " ".join(kept[:2])


def setting_groups(config: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return all settings by group: the plain ones first, then one group per nested dictionary."""
    plain = {key: value for key, value in config.items() if not isinstance(value, dict)}
    nested = {key: value for key, value in config.items() if isinstance(value, dict)}
    groups = {"general": plain, **nested} if plain else nested
    return [(str(name), _flat(group)) for name, group in groups.items()]


def changed_settings(changes: dict[str, tuple[Any, Any]]) -> list[tuple[str, str]]:
    """Return changed settings as pairs: the name, and the text "value instead of old value".

    The old value is None if there is none.
    """
    now, other = (_flat({name: pair[i] for name, pair in changes.items()}) for i in (0, 1))
    return [
        (name, text if before == "null" else f"{text} instead of {before}")
        for (name, text), (_, before) in zip(now, other, strict=True)
    ]


def _flat(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, dict):
            rows += _flat(value, f"{prefix}{key}.")
        else:
            plain = value is None or isinstance(value, bool | int | float | list | tuple)
            text = json.dumps(value, default=str, ensure_ascii=False) if plain else str(value)
            rows.append((f"{prefix}{key}", text))
    return rows
