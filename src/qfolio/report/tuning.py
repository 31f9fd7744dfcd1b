"""The report of a hyperparameter search: one self-contained page and its figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from qfolio.core.statistics import mean_interval
from qfolio.experiments.tuning import search
from qfolio.experiments.tuning.journal import Trial, best_of
from qfolio.experiments.tuning.search import Dimension, Value
from qfolio.experiments.tuning.sensitivity import Effect, Sensitivity, sensitivity, short, verdicts
from qfolio.report import palette
from qfolio.report.data import decimals
from qfolio.report.figures.style import LEAD, NARROW, WIDE, new_figure, save_png, svgs
from qfolio.report.rendering import counted, number, over_seeds, percent, render, setting_groups
from qfolio.report.words import agent_name, words_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from qfolio.experiments.tuning.run import Tuning

SHADES = 5
"""Shades of trials from the first to the last, or from the worst to the best."""

TOP = 10
"""Rows of the table of the best trials."""


def _mix(share: float) -> str:
    """A colour between the two ends of the shades."""
    ends = [[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in (palette.HAIRLINE, palette.ACCENT)]
    mixed = [round(a + share * (b - a)) for a, b in zip(*ends, strict=True)]
    return "#" + "".join(f"{part:02x}" for part in mixed)


_SHARES = np.linspace(0.22, 1, SHADES)
_SHADES = [_mix(share) for share in _SHARES]


@dataclass(frozen=True)
class Sweep:
    """The data of a search's report."""

    config: dict[str, Any]
    space: list[Dimension]
    trials: list[Trial]
    own: dict[str, Value]  # the preset's values
    summary: dict[str, Any]  # of the final comparison
    found: Sensitivity | None
    command: str

    @property
    def title(self) -> str:
        agent, task = self.config["agent"], self.config["task"]
        return f"Hyperparameters of {agent_name(agent)} {words_of(task).where}"

    @property
    def verdicts(self) -> list[str]:
        return [*verdicts(self.found, self.trials), self.comparison]

    @property
    def comparison(self) -> str:
        """Whether the best configuration beats the preset, in a sentence."""
        best, preset = (
            np.array([math.nan if x is None else x for x in self.summary[row]])
            for row in ("return_per_seed", "preset_return_per_seed")
        )
        gains = best - preset
        seeds = counted(len(gains), "fresh seed").lower()
        if not np.isfinite(gains).all():
            failed = "best" if not np.isfinite(best).all() else "preset"
            return (
                f"With {seeds}, training diverged for the {failed}, which settles the comparison."
            )
        digits = decimals(self.summary["optimum"] or best.mean())
        found = best_of(self.trials)
        if found is not None and found.is_preset:
            return (
                f"None of {len(self.trials)} configurations did better than the preset itself, "
                f"which returns {number(preset.mean(), digits)} with {seeds} and the graded starts."
            )
        says = (
            f"With {seeds} and the graded starts the best of {len(self.trials)} configurations "
            f"returns {number(best.mean(), digits)}, the preset {number(preset.mean(), digits)}"
        )
        if len(gains) == 1:
            return f"{says}; a single seed allows no further conclusion."
        interval = mean_interval(gains)
        gap = f"{number(gains.mean(), digits, sign=True)}"
        spread = over_seeds(gains, interval, lambda gain: number(gain, digits, sign=True))
        if interval is None:
            return f"{says} ({gap}; {spread}): too few seeds for a verdict."
        low, high = interval
        kind = "better" if low > 0 else "worse" if high < 0 else "no clear difference"
        return f"{says}: {kind} ({gap}; {spread})."


def sweep(work: Tuning, summary: dict[str, Any], command: str) -> Sweep:
    """The data of the report, from a search and its final comparison."""
    trials = work.journal.trials()
    return Sweep(
        config=msgspec.to_builtins(work.config),
        space=work.space,
        trials=trials,
        own={dim.name: search.own_value(work.agent, dim) for dim in work.space},
        summary=summary,
        found=sensitivity(work.space, trials, summary["optimum_tuned_on"]),
        command=command,
    )


def write_tuning_report(folder: Path, data: Sweep) -> None:
    """Writes report.html and, if there are enough trials, its figures as PNG files."""
    figures = {"sensitivity.png": (draw_sensitivity, LEAD), "pair.png": (draw_pair, WIDE)}
    for name, (draw, width) in figures.items():
        if data.found is None or (draw is draw_pair and len(data.space) < 2):
            (folder / name).unlink(missing_ok=True)
        else:
            save_png(folder / name, draw, data, width)
    (folder / "report.html").write_text(render_page(data), encoding="utf-8")


def render_page(data: Sweep) -> str:
    """Return the text of the page."""
    pair = data.found is not None and len(data.space) > 1
    return render(
        "tuning.html",
        data=data,
        config=data.config,
        found=data.found,
        far=_far(data.config),
        facts=_facts(data),
        effects=[_row(effect, data) for effect in data.found.effects] if data.found else [],
        finals=_finals(data),
        names=[dim.name for dim in data.space],
        top=_top(data),
        sensitivity=_svgs(draw_sensitivity, data, LEAD) if data.found else None,
        pair=_svgs(draw_pair, data, WIDE) if pair else None,
        settings=setting_groups(data.config),
    )


def draw_sensitivity(data: Sweep, width: float) -> Figure:
    """Draw every trial over each of its settings, and the model's prediction along it."""
    assert data.found is not None
    effects = data.found.effects
    most = 4 if len(effects) in (4, 7, 8) else 3
    columns = min(len(effects), most) if width > NARROW else 1
    rows = -(-len(effects) // columns)
    figure = new_figure(width, rows * (2.75 if width > NARROW else 2.5) + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    heights = data.found.outcome.height([trial.value for trial in data.trials])
    marks: dict[str, Any] = {}
    for panel, effect in zip(axes.flat, effects, strict=False):
        marks = _draw_effect(panel, data, effect, heights)
        panel.set_title(f"{effect.dimension.name}  {percent(effect.share, 0)}", pad=7)
    for panel in axes.flat[len(effects) :]:
        panel.set_visible(False)
    _height_ticks(axes[0, 0], data.found)
    for panel in axes[:, 0]:
        panel.set_ylabel(_height_name(data))
    figure.legend(
        list(marks.values()),
        list(marks),
        loc="outside upper left",
        ncols=6 if width > NARROW else 2,
        labelcolor=palette.MUTED,
        columnspacing=1.4,
        handletextpad=0.4,
        borderpad=0.3,
    )
    return figure


def draw_pair(data: Sweep, width: float) -> Figure:
    """Draw the trials over the two most important settings, shaded by rank."""
    assert data.found is not None
    across, up = (effect.dimension for effect in data.found.effects[:2])
    figure = new_figure(width, 0.78 * width if width > NARROW else 1.05 * width)
    axes = figure.subplots()
    heights = data.found.outcome.height([trial.value for trial in data.trials])
    ranks = heights.argsort().argsort() / max(1, len(heights) - 1)
    shades = [_SHADES[min(SHADES - 1, int(rank * SHADES))] for rank in ranks]
    order = heights.argsort()
    x, y = _places(data, across), _places(data, up)
    axes.scatter(
        x[order], y[order], s=44, c=[shades[i] for i in order], linewidths=0.5,
        edgecolors=palette.PAPER, clip_on=False, zorder=3,
    )  # fmt: skip
    marks: dict[str, Any] = {}
    for name, shade in (("worst fifth", _SHADES[0]), ("best fifth", _SHADES[-1])):
        (marks[name],) = axes.plot([], [], "o", markersize=6, color=shade, markeredgewidth=0)
    marks |= _draw_special(axes, data, x, y)
    axes.grid()
    for axis, dim in ((axes.xaxis, across), (axes.yaxis, up)):
        axis.set_ticks(*_ticks(dim, few=width <= NARROW))
        axis.set_label_text(dim.name)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    figure.legend(
        list(marks.values()),
        list(marks),
        loc="outside upper left",
        ncols=4 if width > NARROW else 2,
        labelcolor=palette.MUTED,
        columnspacing=1.4,
        handletextpad=0.4,
        borderpad=0.3,
    )
    return figure


def _draw_effect(
    axes: Axes, data: Sweep, effect: Effect, heights: NDArray[np.float64]
) -> dict[str, Any]:
    """Draw one setting; return the marks by name."""
    dim = effect.dimension
    axes.grid(axis="y")
    half = 0.5 / len(dim.choices) if dim.choices else 0.0
    if dim.choices:
        for place in effect.places[effect.robust]:
            axes.axvspan(place - half, place + half, color=palette.HAIRLINE, alpha=0.55, lw=0)
    else:
        axes.axvspan(*effect.range, color=palette.HAIRLINE, alpha=0.55, linewidth=0)
    x = _places(data, dim)
    failed = np.array([math.isnan(trial.value) for trial in data.trials])
    shades = [_SHADES[min(SHADES - 1, i * SHADES // len(x))] for i in range(len(x))]
    marks: dict[str, Any] = {}
    for name, shade in (("first trials", _SHADES[0]), ("last trials", _SHADES[-1])):
        (marks[name],) = axes.plot([], [], "o", markersize=5, color=shade, markeredgewidth=0)
    kept = np.flatnonzero(~failed)
    colours = [shades[i] for i in kept]
    axes.scatter(x[kept], heights[kept], s=24, c=colours, linewidths=0, clip_on=False, zorder=3)
    if failed.any():
        cross = axes.plot(x[failed], heights[failed], "x", color=palette.MUTED, clip_on=False)
        cross[0].set_markersize(5)
        marks["diverged"] = cross[0]
    line: dict[str, Any] = {"color": palette.INK, "linewidth": 1.6, "zorder": 4}
    if dim.choices:
        for place, height in zip(effect.places, effect.heights, strict=True):
            drawn = axes.plot([place - half, place + half], [height] * 2, **line)
    else:
        drawn = axes.plot(effect.places, effect.heights, **line)
    marks["expected, all else as in the best quarter"] = drawn[0]
    marks |= _draw_special(axes, data, x, heights)
    axes.set_xticks(*_ticks(dim))
    axes.set_xlim(-0.02, 1.02)
    return marks


def _draw_special(
    axes: Axes, data: Sweep, x: NDArray[np.float64], y: NDArray[np.float64]
) -> dict[str, Any]:
    """Mark the preset and the best trial."""
    style: dict[str, Any] = {"clip_on": False, "zorder": 6}
    marks: dict[str, Any] = {}
    best = best_of(data.trials)
    for index, trial in enumerate(data.trials):
        place = x[index : index + 1], y[index : index + 1]
        if trial.is_preset:
            (marks["preset"],) = axes.plot(
                *place, "D", markersize=6.5, color=palette.SECOND, markeredgewidth=0.8,
                markeredgecolor=palette.PAPER, **style,
            )  # fmt: skip
        if best is not None and trial.number == best.number:
            (marks["best"],) = axes.plot(
                *place, "o", markersize=9, markerfacecolor="none", markeredgewidth=1.4,
                markeredgecolor=palette.INK, **style,
            )  # fmt: skip
    return dict(sorted(marks.items(), reverse=True))


def _places(data: Sweep, dim: Dimension) -> NDArray[np.float64]:
    """The positions of all trials on the scale of a setting; choices are spread a little."""
    places = np.array([dim.position(trial.values[dim.name]) for trial in data.trials])
    if dim.choices:
        spread = np.array([trial.number * 0.618034 % 1 - 0.5 for trial in data.trials])
        places += 0.55 * spread / len(dim.choices)
    return places


def _ticks(dim: Dimension, few: bool = False) -> tuple[list[float], list[str]]:
    """Positions and labels of round values on a setting's scale."""
    if dim.choices:
        return [dim.position(choice) for choice in dim.choices], list(dim.choices)
    if dim.scale == "linear":
        from matplotlib.ticker import MaxNLocator

        found = MaxNLocator(4).tick_values(dim.low, dim.high)
        values = [float(value) for value in found if dim.covers(float(value))]
        return [dim.position(value) for value in values], [f"{value:g}" for value in values]
    near_one = dim.scale == "near-one"
    ends = (1 - dim.high, 1 - dim.low) if near_one else (dim.low, dim.high)
    powers = range(math.floor(math.log10(ends[0])), math.ceil(math.log10(ends[1])) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        round_ones = [float(f"{step}e{power}") for power in powers for step in steps]
        kept = [x for x in round_ones if ends[0] * 0.999 <= x <= ends[1] * 1.001]
        if len(kept) <= (4 if few else 5):
            break
    values = sorted(float(f"{1 - x:.10g}") for x in kept) if near_one else kept
    return [dim.position(value) for value in values], [f"{value:g}" for value in values]


def _far(config: dict[str, Any]) -> str:
    unit = "steps" if config["episodes"] is None else "episodes"
    return f"{number(config[unit], 0)} {unit}"


def _height_name(data: Sweep) -> str:
    return "return" if data.summary["optimum_tuned_on"] is None else "regret (higher is better)"


def _height_ticks(axes: Axes, found: Sensitivity) -> None:
    """Set ticks at round regrets; if the optimum is unknown, keep those of the returns."""
    if found.outcome.optimum is None:
        axes.locator_params(axis="y", nbins=5)
        return
    low, high = axes.get_ylim()
    worst, best = found.outcome.loss([low, high])
    for steps in ((1, 2, 5), (1, 3), (1,)):
        values = [float(f"{step}e{power}") for power in range(-4, 6) for step in steps]
        kept = [value for value in values if best <= value <= worst]
        if len(kept) <= 7:
            break
    texts = [percent(value, max(0, -math.floor(math.log10(value)) - 2)) for value in kept]
    axes.set_yticks([-math.log10(value) for value in kept], texts)


def _facts(data: Sweep) -> list[tuple[str, str, str]]:
    """Return the key figures: name, value and a remark."""
    best = best_of(data.trials)
    assert best is not None
    digits = decimals(data.summary["optimum"] or best.value)
    failed = sum(math.isnan(trial.value) for trial in data.trials)
    config = data.config
    trained = [x for x in data.summary["return_per_seed"] if x is not None]
    seeds = len(data.summary["seeds"])
    note = f"retrained, {seeds} seeds, graded starts"
    if data.summary["optimum"] is not None:
        note = f"retrained, {seeds} seeds; optimum {number(data.summary['optimum'], digits)}"
    hour = 3600 / float(np.mean([trial.seconds for trial in data.trials]))
    return [
        ("Trials", number(len(data.trials), 0), f"{config['seeds']} seeds each, {failed} diverged"),
        ("Best found", number(best.value, digits), f"trial {best.number + 1}, on tuning starts"),
        ("Best, graded", number(float(np.mean(trained)), digits) if trained else "–", note),
        ("Trials an hour", number(hour, 0), f"{config['batch']} at once, one process"),
    ]


def _row(effect: Effect, data: Sweep) -> dict[str, Any]:
    """Return a setting's row of the table; places are percentages of its scale."""
    dim = effect.dimension
    best = best_of(data.trials)
    assert best is not None
    assert data.found is not None
    values = {"best": best.values[dim.name], "preset": data.own[dim.name]}
    shown = {
        name: value if isinstance(value, str) else short(value) for name, value in values.items()
    }
    if dim.choices:
        kept = [c for c, good in zip(dim.choices, effect.robust, strict=True) if good]
        half = 50 / len(dim.choices)
        spans = [(100 * place - half, 2 * half) for place in effect.places[effect.robust]]
        robust = " | ".join(kept)
        searched = " | ".join(dim.choices)
    else:
        low, high = effect.range
        spans = [(100 * low, 100 * (high - low))]
        robust = f"{short(dim.at(low))} to {short(dim.at(high))}"
        searched = f"{short(dim.low)} to {short(dim.high)}"
    inside = {name: 100 * dim.position(v) for name, v in values.items() if dim.covers(v)}
    return {
        "name": dim.name,
        "share": percent(effect.share, 0),
        "bar": 100 * effect.share / max(e.share for e in data.found.effects),
        "searched": searched,
        "robust": robust,
        "spans": spans,
        "places": inside,
        **shown,
    }


def _finals(data: Sweep) -> list[tuple[str, list[str]]]:
    """Return a row for the best and one for the preset: mean, spread, worst seed, regret."""
    optimum = data.summary["optimum"]
    rows = []
    for name, key in (("Best", "return_per_seed"), ("Preset", "preset_return_per_seed")):
        returns = np.array([math.nan if x is None else x for x in data.summary[key]])
        if not np.isfinite(returns).all():
            rows.append((name, ["diverged", "–", "–", "–"]))
            continue
        digits = decimals(optimum or returns.mean())
        spread = over_seeds(returns, mean_interval(returns), partial(number, digits=digits))
        regret = "–" if optimum is None else percent((optimum - returns.mean()) / abs(optimum), 1)
        cells = [number(returns.mean(), digits), spread, number(returns.min(), digits), regret]
        rows.append((name, cells))
    return rows


def _top(data: Sweep) -> list[tuple[str, str, list[str]]]:
    """Return the best trials, and the preset at any rank: rank, return and settings."""
    ranked = sorted(data.trials, key=lambda trial: -np.nan_to_num(trial.value, nan=-np.inf))
    digits = decimals(data.summary["optimum_tuned_on"] or ranked[0].value)
    rows = []
    for rank, trial in enumerate(ranked, 1):
        if rank <= TOP or trial.is_preset:
            values = [trial.values[dim.name] for dim in data.space]
            cells = [value if isinstance(value, str) else short(value) for value in values]
            name = f"{rank} (preset)" if trial.is_preset else str(rank)
            rows.append((name, number(trial.value, digits), cells))
    return rows


def _svgs(draw: Callable[[Sweep, float], Figure], data: Sweep, width: float) -> dict[str, Markup]:
    return {kind: Markup(_shaded(svg)) for kind, svg in svgs(draw, data, width).items()}


def _shaded(svg: str) -> str:
    """Makes the shades follow the page's light or dark scheme, as its other colours do."""
    ends: Sequence[str] = ("var(--accent)", "var(--hairline)")
    for share, shade in list(zip(_SHARES, _SHADES, strict=True))[:-1]:
        svg = svg.replace(shade, f"color-mix(in srgb, {ends[0]} {100 * share:.0f}%, {ends[1]})")
    return svg
