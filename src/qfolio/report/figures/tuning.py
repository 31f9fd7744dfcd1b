"""Figures of a hyperparameter search: its progress, and the results over each setting."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from qfolio.core.arrays import Floats
from qfolio.experiments.tuning.journal import best_of
from qfolio.experiments.tuning.search import Dimension
from qfolio.experiments.tuning.sensitivity import Effect, Outcome
from qfolio.report import palette
from qfolio.report.figures.style import NARROW, legend_above, new_figure, svgs
from qfolio.report.rendering import percent
from qfolio.report.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHADES = 5
"""Shades of trials from the first to the last, or from the worst to the best."""


_SHARES = np.linspace(0.22, 1, SHADES)
_SHADES = [palette.mix(palette.HAIRLINE, palette.ACCENT, share) for share in _SHARES]


def draw_sensitivity(data: Sweep, width: float) -> Figure:
    """Draw every trial against each setting, and the model's prediction along that setting."""
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
    _height_ticks(axes[0, 0], data.found.outcome)
    for panel in axes[:, 0]:
        panel.set_ylabel(_height_name(data))
    legend_above(figure, marks, 6 if width > NARROW else 2)
    return figure


def draw_pair(data: Sweep, width: float) -> Figure:
    """Draw the trials in the plane of the two most important settings, shaded by rank."""
    assert data.found is not None
    across, up = (effect.dimension for effect in data.found.effects[:2])
    figure = new_figure(width, 0.78 * width if width > NARROW else 1.05 * width)
    axes = figure.subplots()
    heights = data.found.outcome.height([trial.value for trial in data.trials])
    # Equal results have one shade: the share of trials that are worse, and half of the equal ones.
    ranks = ((heights[:, None] > heights) + (heights[:, None] == heights) / 2).mean(1)
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
    legend_above(figure, marks, 4 if width > NARROW else 2)
    return figure


def draw_progress(data: Sweep, width: float) -> Figure:
    """Draw the trials in order, and the best result so far at each."""
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(width, 3.9 if width > NARROW else 3.6)
    axes = figure.subplots()
    values = np.array([trial.value for trial in data.trials])
    failed = np.isnan(values)
    outcome = Outcome.of(values, data.summary["optimum_tuned_on"])
    heights = outcome.height(values)
    order = np.array([trial.number + 1.0 for trial in data.trials])
    at_random = np.array([trial.at_random for trial in data.trials])
    chosen = np.array([not (trial.at_random or trial.is_preset) for trial in data.trials])
    marks: dict[str, Any] = {}
    for name, kept, shade in (
        ("drawn at random", at_random & ~failed, _SHADES[1]),
        ("chosen", chosen & ~failed, _SHADES[-1]),
    ):
        if kept.any():
            (marks[name],) = axes.plot(
                order[kept], heights[kept], "o", markersize=5, color=shade, markeredgewidth=0,
                clip_on=False, zorder=3,
            )  # fmt: skip
    if failed.any():
        (marks["diverged"],) = axes.plot(
            order[failed], heights[failed], "x", markersize=5, color=palette.MUTED, clip_on=False
        )
    best = np.maximum.accumulate(np.where(failed, -np.inf, heights))
    (marks["best so far"],) = axes.plot(
        order, np.where(np.isfinite(best), best, np.nan), color=palette.INK, linewidth=1.6,
        drawstyle="steps-post", zorder=4,
    )  # fmt: skip
    marks |= _draw_special(axes, data, order, heights)
    axes.grid(axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    axes.set_xlim(0.5, order[-1] + 0.5)
    axes.set_xlabel("trial")
    axes.set_ylabel(_height_name(data))
    low, high = axes.get_ylim()
    if outcome.optimum is not None and high - low < 1:  # room for ticks at round regrets
        axes.set_ylim((low + high - 1) / 2, (low + high + 1) / 2)
    _height_ticks(axes, outcome)
    legend_above(figure, marks, 6 if width > NARROW else 2)
    return figure


def _draw_effect(axes: Axes, data: Sweep, effect: Effect, heights: Floats) -> dict[str, Any]:
    """Draw the effect of one setting; return the marks by name."""
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
    colors = [shades[i] for i in kept]
    axes.scatter(x[kept], heights[kept], s=24, c=colors, linewidths=0, clip_on=False, zorder=3)
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


def _draw_special(axes: Axes, data: Sweep, x: Floats, y: Floats) -> dict[str, Any]:
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


def _places(data: Sweep, dim: Dimension) -> Floats:
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


def _height_name(data: Sweep) -> str:
    return "return" if not data.summary["optimum_tuned_on"] else "regret (smallest at the top)"


def _height_ticks(axes: Axes, outcome: Outcome) -> None:
    """Set ticks at round regrets; if the optimum is unknown, keep those of the returns."""
    if outcome.optimum is None:
        axes.locator_params(axis="y", nbins=5)
        return
    low, high = axes.get_ylim()
    worst, best = outcome.loss([low, high])
    for steps in ((1, 2, 5), (1, 3), (1,)):
        values = [float(f"{step}e{power}") for power in range(-4, 6) for step in steps]
        kept = [value for value in values if best <= value <= worst]
        if len(kept) <= 7:
            break
    texts = [percent(value, max(0, -math.floor(math.log10(value)) - 2)) for value in kept]
    axes.set_yticks([-math.log10(value) for value in kept], texts)


def shaded_svgs(
    draw: Callable[[Sweep, float], Figure], data: Sweep, width: float
) -> dict[str, Markup]:
    """Return a figure for wide pages and for phones, with shades of the page's scheme."""
    return {kind: Markup(_shaded(svg)) for kind, svg in svgs(draw, data, width).items()}


def _shaded(svg: str) -> str:
    """Makes the shades follow the page's light or dark scheme, as its other colors do."""
    ends: Sequence[str] = ("var(--accent)", "var(--hairline)")
    for share, shade in list(zip(_SHARES, _SHADES, strict=True))[:-1]:
        svg = svg.replace(shade, f"color-mix(in srgb, {ends[0]} {100 * share:.0f}%, {ends[1]})")
    return svg
