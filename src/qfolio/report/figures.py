"""The figures of a report, each drawn once and saved as a PNG file or as SVG text for the page."""

from __future__ import annotations

import io
import math
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from qfolio.core.statistics import bootstrap_interval, interquartile_mean
from qfolio.report import palette
from qfolio.report.data import (
    Curve,
    Episode,
    Floats,
    Maps,
    Numbers,
    ReportData,
    Responses,
    Weights,
    decimals,
)
from qfolio.report.rendering import number, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

T = TypeVar("T")
Draw = Callable[[ReportData, float], "Figure"]
Panels = NDArray[np.object_]
Target = str | Path | IO[bytes]

LEAD = 10.5
WIDE = 7.2
NARROW = 3.75
"""Widths in inches: across the page, in its broad column, and on a phone."""

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": palette.INK,
    "text.parse_math": False,
    "axes.edgecolor": palette.MUTED,
    "axes.linewidth": 0.6,
    "axes.labelcolor": palette.MUTED,
    "axes.titlecolor": palette.INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "axes.titlepad": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "axes.axisbelow": True,
    "grid.color": palette.HAIRLINE,
    "grid.linewidth": 0.6,
    "xtick.color": palette.MUTED,
    "ytick.color": palette.MUTED,
    "xtick.major.width": 0.6,
    "xtick.major.size": 3,
    "ytick.major.size": 0,
    "lines.solid_capstyle": "round",
    "lines.solid_joinstyle": "round",
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.facecolor": palette.PAPER,
    "legend.edgecolor": "none",
    "legend.fancybox": False,
    "legend.handlelength": 1.4,
    "legend.borderaxespad": 0.2,
    "svg.fonttype": "none",
    "svg.hashsalt": "qfolio",
    "path.simplify": True,
}

# Matplotlib keeps its style in one global dictionary: only one thread may change it at a time.
_style_lock = threading.Lock()


def learning_curve(target: Target, data: ReportData) -> None:
    """Save the greedy return over training, with a close view near the optimum, as PNG."""
    save_png(target, draw_learning_curve, data, LEAD)


def value(target: Target, data: ReportData) -> None:
    """Save maps of the learned and the exact value and policy as PNG.

    Raises:
        ValueError: The data has no maps.
    """
    save_png(target, draw_value, data, WIDE)


def policy(target: Target, data: ReportData) -> None:
    """Save what the learned policies want beside what is best as PNG.

    Raises:
        ValueError: The data has no policy of a market.
    """
    save_png(target, draw_policy, data, WIDE)


def overestimation(target: Target, data: ReportData) -> None:
    """Save the overestimation of action values over training as PNG."""
    save_png(target, draw_overestimation, data, WIDE)


def inline_svg(draw: Callable[[T, float], Figure], data: T, width: float) -> str:
    """Return a figure as an SVG element to be put into a page.

    Texts stay texts in the font of the page, colours refer to the variables of the page
    (see palette.CSS_VARIABLES), and the element has no fixed size.

    Args:
        draw: One of the draw_ functions of this module.
        data: What to draw.
        width: Width in inches at which the letters have their natural size.
    """
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    _save(draw, data, width, buffer, format="svg", dpi=160, transparent=True, metadata=nothing)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    box = re.search(r'viewBox="[^"]*"', svg)
    assert box is not None
    body = svg[svg.index(">") + 1 :]
    # Several figures share a page, so their identifiers must differ.
    name = f"{draw.__name__.removeprefix('draw_')}-{round(width * 100)}-"
    body = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}", body)
    body = re.sub(r"font: ([^;\"]*?)([\d.]+px)[^;\"]*", r"font-size: \2", body)
    for colour, variable in palette.CSS_VARIABLES.items():
        body = body.replace(colour, f"var({variable})")
    return f'<svg {box.group()} aria-hidden="true">{body}'


def svgs(draw: Callable[[T, float], Figure], data: T, width: float) -> dict[str, Markup]:
    """Return a figure for wide pages and for phones, as ``parts.html`` takes it."""
    sizes = {"wide": width, "narrow": NARROW}
    return {kind: Markup(inline_svg(draw, data, size)) for kind, size in sizes.items()}


def draw_learning_curve(data: ReportData, width: float) -> Figure:
    """Draw the greedy return over training, and once more near the optimum where that helps.

    In a market, where training returns are not drawn, the comparison is.
    """
    window = _near_optimum(data)
    panels = 1 if window is None else 2
    figure = new_figure(width, 3.7 if width > NARROW or panels == 1 else 6.4)
    if width > NARROW:
        axes = figure.subplots(1, panels, squeeze=False, width_ratios=[1.25, 1][:panels])
    else:
        axes = figure.subplots(panels, 1, squeeze=False)
    name = data.market.measure if data.market else "return"
    curves = [(data.curve, palette.ACCENT)]
    if data.market and data.comparison:
        curves.append((data.comparison, palette.SECOND))
    kind = None if data.market else "greedy"
    whole = axes.flat[0]
    _line_axes(whole, f"{name.capitalize()} over the whole run", "training episodes")
    for curve, colour in curves:
        _draw_runs(whole, curve.episodes, curve.returns, colour, kind, curve.label)
    _draw_training(whole, data)
    whole.set_xlim(left=0)
    _draw_optimum(whole, data, label=panels == 1)
    if data.market:
        _cut_beginning(whole, data.optimum)
    whole.legend(loc="best", labelcolor=palette.MUTED)
    if window is not None:
        close = axes.flat[1]
        _line_axes(close, "The same near the optimum", "training episodes")
        for curve, colour in curves:
            _draw_runs(close, curve.episodes, curve.returns, colour)
        left, low, high = window
        close.set_xlim(left, data.curve.episodes[-1])
        close.set_ylim(low, high)
        _draw_optimum(close, data, label=True)
    return figure


def draw_value(data: ReportData, width: float) -> Figure:
    """Draw the learned and the exact policy, and value if there is one, over the states."""
    maps = data.maps
    if maps is None:
        raise ValueError("the value figure needs maps of the state space")
    rows = 1 if maps.value is None else 2
    figure = new_figure(width, (0.98 if width > NARROW else 1.2) * width * rows / 2)
    axes = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False)
    names = ["Learned policy", "Exact policy"]
    if maps.value is not None:
        _draw_values(axes[0], maps, maps.value)
        names = ["Learned value", "Exact value", *names]
    torques = _colours("torque", palette.TORQUE_MAP)
    limit = max(2.0, np.abs(maps.policy).max(), np.abs(maps.exact_policy).max())
    for panel, table in zip(axes[-1], (maps.policy, maps.exact_policy), strict=True):
        image = _draw_map(panel, maps, table, torques, -limit, limit, "nearest")
    _colour_bar(figure, image, axes[-1], "torque (N m)")
    for panel, name in zip(axes.flat, names, strict=True):
        panel.set_title(name, pad=6)
    _map_ticks(axes, few=width <= NARROW)
    if data.episode is not None:
        _draw_path(axes[0, 0], data.episode)
    return figure


def _draw_values(axes: Panels, maps: Maps, learned: Floats) -> None:
    low = min(learned.min(), maps.exact_value.min())
    high = max(learned.max(), maps.exact_value.max())
    values = _colours("value", palette.VALUE_MAP)
    for panel, table in zip(axes, (learned, maps.exact_value), strict=True):
        image = _draw_map(panel, maps, table, values, low, high, "bilinear")
        levels = np.linspace(low, high, 9)[1:-1]
        panel.contour(
            maps.theta,
            maps.theta_dot,
            table.T,
            levels=levels,
            colors="#fffffe",
            linewidths=0.5,
            alpha=0.35,
            linestyles="solid",
        )
    _colour_bar(axes[0].figure, image, axes, "value")


def draw_policy(data: ReportData, width: float) -> Figure:
    """Draw what the learned policies want in a market, and what is best."""
    drawn = data.market.policy if data.market else None
    if drawn is None:
        raise ValueError("the policy figure needs the policies of a market")
    if isinstance(drawn, Weights):
        return _draw_weights(drawn, width)
    return _draw_responses(drawn, width)


def draw_overestimation(data: ReportData, width: float) -> Figure:
    """Draw how far the action values lie above the returns that really followed."""
    figure = new_figure(width, 3.5 if width > NARROW else 3.2)
    axes = figure.subplots()
    _line_axes(axes, "", "training episodes")
    curves = [data.curve] if data.comparison is None else [data.curve, data.comparison]
    for curve, colour in zip(curves, (palette.ACCENT, palette.SECOND), strict=False):
        _draw_runs(axes, curve.episodes, curve.overestimation, colour, None, curve.label)
    axes.axhline(0, color=palette.INK, linewidth=0.9, dashes=(4, 3))
    _line_label(axes, 0, "unbiased", below=True)
    low, high, clipped = _settled_range(curves)
    axes.set_xlim(left=0)
    axes.set_ylim(low, high)
    # On a phone, long names do not fit beside each other.
    beside = width > NARROW or sum(len(curve.label) for curve in curves) < 32
    axes.set_title("Action value less the return that followed", pad=26 if beside else 40)
    if clipped:
        _line_label(axes, high, "beginning off the scale", below=True, color=palette.MUTED)
    axes.legend(
        *(),
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=2 if beside else 1,
        labelcolor="linecolor",
        borderpad=0.3,
        columnspacing=1.4,
    )
    return figure


def save_png(target: Target, draw: Callable[[T, float], Figure], data: T, width: float) -> None:
    """Save what a function draws from some data in the style of all figures."""
    _save(draw, data, width, target, format="png", dpi=160, facecolor=palette.PAPER)


def _save(
    draw: Callable[[T, float], Figure],
    data: T,
    width: float,
    target: Target | IO[str],
    **options: Any,
) -> None:
    import matplotlib as mpl

    with _style_lock, mpl.rc_context(_STYLE):
        draw(data, width).savefig(target, **options)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, without pyplot and its global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06, wspace=0.04, hspace=0.04)
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _line_axes(axes: Axes, title: str, label: str) -> None:
    axes.grid(axis="y")
    axes.set_title(title)
    axes.set_xlabel(label)
    axes.locator_params(nbins=6)
    axes.margins(x=0)


def _draw_runs(
    axes: Axes,
    episodes: Numbers,
    runs: Floats,
    colour: str,
    kind: str | None = None,
    label: str | None = None,
) -> None:
    """Draw runs of shape (P, S): a thin line per seed, the interquartile mean and its band."""
    points, seeds = runs.shape
    marker = "o" if points == 1 else None
    if kind is not None:
        label = (
            f"{kind}, one seed" if seeds == 1 else f"{kind}, interquartile mean of {seeds} seeds"
        )
    if seeds > 1:
        alpha = max(0.1, min(0.35, 4 / seeds))
        axes.plot(episodes, runs, color=colour, linewidth=0.7, alpha=alpha, marker=marker)
        low, high = bootstrap_interval(runs)
        axes.fill_between(episodes, low, high, color=colour, alpha=0.2, linewidth=0)
    middle = interquartile_mean(runs)
    # A single point must not vanish behind the edge or the legend.
    order, clip = (2, True) if points > 1 else (6, False)
    (line,) = axes.plot(episodes, middle, color=colour, linewidth=2, marker=marker, label=label)
    line.set(zorder=order, clip_on=clip)


def _draw_training(axes: Axes, data: ReportData) -> None:
    """Draw the median return of the exploring agents in some 60 bins of episodes."""
    if data.training_episodes.size == 0:
        return
    edges = np.linspace(data.training_episodes.min(), data.training_episodes.max() + 1, 61)
    bins = np.digitize(data.training_episodes, edges)
    used = np.unique(bins)
    centres = [data.training_episodes[bins == number].mean() for number in used]
    medians = [np.median(data.training_returns[bins == number]) for number in used]
    axes.plot(
        centres,
        medians,
        color=palette.MUTED,
        linewidth=1,
        alpha=0.55,
        label="while training and exploring, median",
        zorder=1.5,
    )


def _draw_optimum(axes: Axes, data: ReportData, *, label: bool) -> None:
    if np.isnan(data.optimum):  # not known
        return
    axes.axhline(data.optimum, color=palette.INK, linewidth=0.9, dashes=(4, 3))
    if label:
        text = f"exact optimum {number(data.optimum, decimals(data.optimum))}"
        _line_label(axes, data.optimum, text)


def _line_label(
    axes: Axes, height: float, text: str, *, below: bool = False, color: str = palette.INK
) -> None:
    axes.annotate(
        text,
        (1, height),
        xycoords=("axes fraction", "data"),
        xytext=(-2, -4 if below else 3),
        textcoords="offset points",
        ha="right",
        va="top" if below else "bottom",
        color=color,
    )


def _cut_beginning(axes: Axes, optimum: float) -> None:
    """Leave off the scale what lies far below zero, where a market can throw beginners."""
    low, high = axes.get_ylim()
    floor = min(0.0, optimum) - 2 * abs(optimum)
    if low < floor:
        axes.set_ylim(floor, min(high, optimum + abs(optimum)))
        _line_label(axes, floor, "beginning off the scale", color=palette.MUTED)


def _near_optimum(data: ReportData) -> tuple[float, float, float] | None:
    """Return the left, lower and upper ends of the close view, or None where none is needed."""
    if np.isnan(data.optimum):
        return None
    returns, episodes = data.curve.returns, data.curve.episodes
    late = returns[len(returns) // 2 :]
    # One failed seed must not decide the scale.
    low = min(float(np.quantile(late, 0.1)), data.optimum)
    high = max(float(late.max()), data.optimum)
    margin = max(0.15 * (high - low), 0.01 * abs(data.optimum), 1e-6)
    low, high = low - margin, high + 1.5 * margin
    whole = max(returns.max(), data.optimum) - returns.min()
    inside = np.flatnonzero(interquartile_mean(returns) >= low)
    if high - low > whole / 3 or inside.size == 0 or inside[0] + 1 >= len(episodes):
        return None
    return float(episodes[inside[0]]), low, high


def _draw_responses(drawn: Responses, width: float) -> Figure:
    """Draw what is wanted over what is held: weights by scene, or all scenes of a position."""
    count = len(drawn.scenes) if drawn.weights else 1
    columns = min(2, count)
    rows = -(-count // columns)
    side = width / columns if columns > 1 else 0.66 * width if width > NARROW else 0.9 * width
    figure = new_figure(width, rows * side + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for panel in axes.flat[count:]:
        panel.set_visible(False)
    for scene, name in enumerate(drawn.scenes):
        panel = axes.flat[scene if drawn.weights else 0]
        lines = _draw_scene(panel, drawn, scene)
        if not drawn.weights:
            _end_label(panel, drawn.held[-1], drawn.exact[scene, -1], name)
        elif count > 1:
            panel.set_title(name, pad=6)
    noun = "weight" if drawn.weights else "position"
    place = float(np.quantile(drawn.held, 0.72 if columns == 1 else 0.58))
    for panel in axes.flat:
        panel.grid()
        panel.set_xlim(drawn.held[0], drawn.held[-1])
        panel.locator_params(nbins=5)
        if drawn.weights:
            ticks = np.linspace(0, 1, 3 if columns > 1 and width <= NARROW else 5)
            panel.set(xticks=ticks, yticks=ticks, ylim=(-0.03, 1.03))
        _draw_no_trade(panel, drawn, place if panel is axes[0, 0] else None)
    for panel in axes[-1]:
        panel.set_xlabel(f"{noun} held")
    for panel in axes[:, 0]:
        panel.set_ylabel(f"{noun} wanted")
    _legend_above(figure, lines, few=width <= NARROW)
    return figure


def _draw_scene(axes: Axes, drawn: Responses, scene: int) -> dict[str, Any]:
    """Draw a thin line per seed, their mean and the exact policy; return them by name."""
    learned, held = drawn.learned[:, scene], drawn.held
    seeds = len(learned)
    lines = {}
    if seeds > 1:
        alpha = max(0.15, min(0.45, 3 / seeds))
        thin = axes.plot(held, learned.T, color=palette.ACCENT, linewidth=0.8, alpha=alpha)
        lines["each seed"] = thin[0]
    name = f"mean of {seeds} seeds" if seeds > 1 else "learned"
    (lines[name],) = axes.plot(held, learned.mean(0), color=palette.ACCENT, linewidth=2)
    (lines["exact"],) = axes.plot(
        held, drawn.exact[scene], color=palette.INK, linewidth=1.1, dashes=(4, 3)
    )
    return lines


def _draw_no_trade(axes: Axes, drawn: Responses, place: float | None) -> None:
    """Draw the diagonal, where what is wanted is what is held, and the region of no trade.

    place: where on the diagonal to write what it is.
    """
    low, high = drawn.held[0], drawn.held[-1]
    axes.plot([low, high], [low, high], color=palette.MUTED, linewidth=0.8, zorder=1.5)
    if place is not None:
        axes.text(
            place,
            place - 0.015 * (high - low),
            "no trade",
            color=palette.MUTED,
            rotation=45,
            rotation_mode="anchor",
            transform_rotates_text=True,
            va="top",
        )
    if drawn.region is not None:
        axes.axvspan(*drawn.region, color=palette.HAIRLINE, alpha=0.6, linewidth=0, zorder=0.5)


def _draw_weights(drawn: Weights, width: float) -> Figure:
    """Draw weights that never change: a dot per seed, their mean, and the exact weight."""
    count, seeds = len(drawn.names), len(drawn.learned)
    figure = new_figure(width, 0.62 * count + 1.2)
    axes = figure.subplots()
    rows = np.arange(count)
    marks: dict[str, Any] = {}
    dot: dict[str, Any] = {
        "marker": "o",
        "linestyle": "",
        "color": palette.ACCENT,
        "markeredgewidth": 0,
    }
    if seeds > 1:
        strip = 0.24 + np.linspace(-0.06, 0.06, seeds)  # below the mean
        places = rows[:, None] + np.broadcast_to(strip, (count, seeds))
        (marks["each seed"],) = axes.plot(
            drawn.learned.T.ravel(), places.ravel(), markersize=4, alpha=0.55, **dot
        )
    name = f"mean of {seeds} seeds" if seeds > 1 else "learned"
    (marks[name],) = axes.plot(drawn.learned.mean(0), rows, markersize=8, clip_on=False, **dot)
    (marks["exact"],) = axes.plot(
        drawn.exact, rows, "|", color=palette.INK, markersize=24, markeredgewidth=1.6, clip_on=False
    )
    axes.set_yticks(rows, drawn.names)
    axes.set_ylim(count - 0.5, -0.5)
    axes.set_xlim(left=0)
    axes.grid(axis="x")
    axes.set_xlabel("weight")
    _legend_above(figure, marks, few=width <= NARROW)
    return figure


def _legend_above(figure: Figure, marks: dict[str, Any], *, few: bool) -> None:
    from matplotlib.lines import Line2D

    legend = figure.legend(
        list(marks.values()),
        list(marks),
        loc="outside upper left",
        ncols=3,
        labelcolor=palette.MUTED,
        columnspacing=1.0 if few else 1.6,
        handletextpad=0.6,
        borderpad=0.3,
    )
    for handle in legend.legend_handles:
        if not isinstance(handle, Line2D):
            continue
        handle.set_alpha(max(0.7, handle.get_alpha() or 1.0))
        handle.set_markersize(min(10, handle.get_markersize()))


def _end_label(axes: Axes, x: float, y: float, text: str) -> None:
    axes.annotate(
        text, (x, y), xytext=(4, 0), textcoords="offset points", va="center", color=palette.MUTED
    )


def _settled_range(curves: list[Curve]) -> tuple[float, float, bool]:
    """Return limits for everything after the first fifth, and whether something lies outside."""
    everything = np.concatenate([curve.overestimation.ravel() for curve in curves])
    settled = [curve.overestimation[len(curve.overestimation) // 5 :].ravel() for curve in curves]
    kept = np.concatenate([*settled, [0.0]])
    margin = max(0.12 * float(np.ptp(kept)), 1e-3)
    low, high = float(kept.min()) - margin, float(kept.max()) + margin
    return low, high, bool(everything.min() < low or everything.max() > high)


def _colours(name: str, colours: list[str]) -> Colormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(name, colours)


def percent_axis(axis: Any) -> None:
    """Give a logarithmic axis of fractions a few ticks, in percent."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 50 * low else (1,), numticks=8))
    axis.set_major_formatter(lambda tick, _: percent_tick(tick))
    axis.set_minor_formatter(NullFormatter())
    axis.set_tick_params(which="minor", length=0)


def percent_tick(tick: float) -> str:
    """A fraction as the label of a tick, with the digits that it has: 0.1 %, 2.5 %, 5 %."""
    return percent(tick, next(n for n in range(16) if math.isclose(round(tick, 2 + n), tick)))


def short_tick(tick: float) -> str:
    """A number as the label of a tick: 200k, 5M."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(tick) >= size:
            return f"{tick / size:g}{letter}"
    return f"{tick:g}"


def _draw_map(
    axes: Axes,
    maps: Maps,
    table: Floats,
    colours: Colormap,
    low: float,
    high: float,
    interpolation: str,
) -> AxesImage:
    limits = [
        (a[0], a[-1], (a[-1] - a[0]) / (2 * len(a) - 2)) for a in (maps.theta, maps.theta_dot)
    ]
    extent = [end for a, b, half in limits for end in (a - half, b + half)]
    image = axes.imshow(
        table.T,
        origin="lower",
        extent=(extent[0], extent[1], extent[2], extent[3]),
        aspect="auto",
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation=interpolation,
    )
    axes.set_xlim(maps.theta[0], maps.theta[-1])
    axes.set_ylim(maps.theta_dot[0], maps.theta_dot[-1])
    axes.spines["bottom"].set_visible(False)
    return image


def _map_ticks(axes: Panels, *, few: bool) -> None:
    ticks = {-2: "−π", -1: "−π/2", 0: "0", 1: "π/2", 2: "π"}
    kept = {k: text for k, text in ticks.items() if not few or k % 2 == 0}
    axes[0, 0].set_xticks([k * np.pi / 2 for k in kept], list(kept.values()))
    for panel in axes[-1]:
        panel.set_xlabel("angle (rad)" if few else "angle θ (rad), upright = 0")
    for panel in axes[:, 0]:
        panel.set_ylabel("speed (rad/s)" if few else "angular speed (rad/s)")


def _colour_bar(figure: Figure, image: AxesImage, axes: Panels, label: str) -> None:
    from matplotlib.ticker import MaxNLocator

    bar = figure.colorbar(
        image, ax=list(axes), aspect=22, pad=0.02, ticks=MaxNLocator(5, steps=[1, 2, 5, 10])
    )
    bar.outline.set_visible(False)
    bar.set_label(label)


def _draw_path(axes: Axes, episode: Episode) -> None:
    angles = (episode.states[:, 0] + np.pi) % (2 * np.pi) - np.pi
    speeds = episode.states[:, 1].astype(float)
    wraps = np.flatnonzero(np.abs(np.diff(angles)) > np.pi) + 1
    # A gap where the angle jumps from one edge to the other.
    axes.plot(
        np.insert(angles, wraps, np.nan),
        np.insert(speeds, wraps, np.nan),
        color=palette.PATH,
        linewidth=1.3,
    )
    dot = {"marker": "o", "markersize": 4.5, "color": palette.PATH, "clip_on": False}
    axes.plot(angles[0], speeds[0], markerfacecolor="#fffffe", **dot)  # type: ignore[arg-type]
    axes.plot(angles[-1], speeds[-1], **dot)  # type: ignore[arg-type]
