"""Writing a report: one self-contained HTML page, its figures and its animation."""

import base64
import io
import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from PIL import Image

from qfolio.report import figures, palette
from qfolio.report.animation import pendulum_gif
from qfolio.report.data import Curve, ReportData
from qfolio.statistics import interquartile_mean

_NUMBER_WORDS = (
    *("No", "One", "Two", "Three", "Four", "Five", "Six"),
    *("Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve"),
)
_COLUMNS = ("return_per_seed", "regret_per_seed", "overestimation_per_seed")
_THIN_SPACE = "\N{NARROW NO-BREAK SPACE}"


def write_report(folder: Path, data: ReportData) -> None:
    """Write report.html, learning_curve.png, value.png and episode.gif into a folder.

    The page needs no other file and no network. The figure value.png is left out when there are
    no maps, and the animation when there is no episode; files of these names from an earlier
    report are then removed, so that a folder never mixes two reports.

    Args:
        folder: Where to write; made if missing.
        data: What to report.

    Raises:
        OSError: A file cannot be written.
        ValueError: The shapes of the episode do not fit together.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures.learning_curve(folder / "learning_curve.png", data)
    if data.maps is None:
        (folder / "value.png").unlink(missing_ok=True)
    else:
        figures.value(folder / "value.png", data)
    animation = folder / "episode.gif"
    if data.episode is None:
        animation.unlink(missing_ok=True)
    else:
        episode = data.episode
        pendulum_gif(animation, episode.states, episode.torques, episode.rewards)
    gif = animation.read_bytes() if data.episode is not None else None
    (folder / "report.html").write_text(render_page(data, gif), encoding="utf-8")


def render_page(data: ReportData, gif: bytes | None = None) -> str:
    """Return the text of the page, with the bytes of the animation if there is one."""
    source = resources.files(__package__).joinpath("template.html").read_text(encoding="utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(number=number, percent=percent)
    return environment.from_string(source).render(
        data=data,
        summary=data.summary,
        palette=palette,
        seeds=len(data.summary["return_per_seed"]),
        verdict=verdict(data.summary),
        facts=_facts(data.summary),
        biases=[(curve.label, _last(curve)) for curve in (data.curve, data.comparison) if curve],
        agents=_agents(data.summary),
        means=[float(np.mean(data.summary[column])) for column in _COLUMNS],
        settings=setting_groups(data.config),
        gif=None if gif is None else _data_uri("image/gif", gif),
        still=None if gif is None else _data_uri("image/png", _first_frame(gif)),
        learning=_svgs(figures.draw_learning_curve, data, figures.LEAD),
        value=None if data.maps is None else _svgs(figures.draw_value, data, figures.WIDE),
        overestimation=_svgs(figures.draw_overestimation, data, figures.WIDE),
    )


def verdict(summary: dict[str, Any]) -> str:
    """Return the result in one or two plain sentences."""
    count = len(summary["return_per_seed"])
    word = _NUMBER_WORDS[count] if count < len(_NUMBER_WORDS) else str(count)
    agents = f"{word} agent{'s' if count != 1 else ''}"
    mean, optimum = number(summary["return_mean"]), number(summary["optimum"])
    regret = float(np.mean(summary["regret_per_seed"]))
    interval = ""
    if count > 1:
        low, high = (number(end) for end in summary["return_ci95"])
        interval = f" (95{_THIN_SPACE}% interval {low} to {high})"
    side = "below" if regret >= 0 else "above"
    share = percent(abs(regret))
    distance = f"{share} {side} the exact optimum of {optimum}"
    if share == percent(0):
        distance = f"equal to the exact optimum of {optimum} within a tenth of a percent"
    sentence = f"{agents} reached a mean return of {mean}{interval}, {distance}."
    if count == 1:
        sentence += " A single seed says nothing about the spread, so no interval is given."
    return sentence


def number(value: float, digits: int = 1, *, sign: bool = False) -> str:
    """Return a number with a true minus sign and thin spaces between thousands."""
    text = f"{value:{'+' if sign else ''},.{digits}f}"
    if not text.strip("+-0.,"):
        text = text.lstrip("+-")
    return text.replace(",", _THIN_SPACE).replace("-", "\N{MINUS SIGN}")


def percent(fraction: float) -> str:
    """Return a fraction as a percentage with one decimal."""
    return f"{number(100 * fraction)}{_THIN_SPACE}%"


def setting_groups(config: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return all settings by group: the plain ones first, then one group per nested dictionary."""
    plain = {key: value for key, value in config.items() if not isinstance(value, dict)}
    nested = {key: value for key, value in config.items() if isinstance(value, dict)}
    groups = {"general": plain, **nested} if plain else nested
    return [(str(name), _flat(group)) for name, group in groups.items()]


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


def _facts(summary: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the key figures: name, value and a remark."""
    several = len(summary["return_per_seed"]) > 1
    spread = "one seed, no interval"
    if several:
        low, high = (number(end) for end in summary["return_ci95"])
        spread = f"95{_THIN_SPACE}%: {low} to {high}"
    together = "all seeds together" if several else "while training"
    return [
        ("Return", number(summary["return_mean"]), spread),
        ("Exact optimum", number(summary["optimum"]), "on the same starts"),
        ("Regret", percent(float(np.mean(summary["regret_per_seed"]))), "of the optimum"),
        (
            "Training time",
            duration(summary["seconds_train"]),
            f"and {duration(summary['seconds_compile'])} to compile",
        ),
        ("Steps per second", amount(summary["steps_per_second"]), together),
        (
            "Environment steps",
            amount(summary["env_steps"]),
            f"{amount(summary['episodes'])} episodes per seed",
        ),
    ]


def duration(seconds: float) -> str:
    """Return a time span in the unit that suits it."""
    if seconds < 10:
        return f"{seconds:.1f}{_THIN_SPACE}s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [(hours, "h"), (minutes, "min"), (rest, "s")]
    kept = [f"{count}{_THIN_SPACE}{unit}" for count, unit in parts if count]
    return " ".join(kept[:2])


def amount(count: float) -> str:
    """Return a large whole number with three or more digits that matter."""
    if count >= 1e6:
        return f"{number(count / 1e6, 2)} million"
    return number(count, 0)


def _agents(summary: dict[str, Any]) -> list[tuple[int, float, float, float]]:
    rows = zip(*(summary[column] for column in _COLUMNS), strict=True)
    return [(index, *row) for index, row in enumerate(rows, start=1)]


def _last(curve: Curve) -> float:
    return float(interquartile_mean(curve.overestimation[-1]))


def _svgs(draw: figures.Draw, data: ReportData, width: float) -> dict[str, Markup]:
    return {
        "wide": Markup(figures.inline_svg(draw, data, width)),
        "narrow": Markup(figures.inline_svg(draw, data, figures.NARROW)),
    }


def _first_frame(gif: bytes) -> bytes:
    buffer = io.BytesIO()
    Image.open(io.BytesIO(gif)).save(buffer, format="PNG")
    return buffer.getvalue()


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
