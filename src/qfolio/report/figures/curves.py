"""Learning curves: greedy returns and overestimation over training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from qfolio.core.statistics import band, interquartile_mean
from qfolio.report import palette
from qfolio.report.data import (
    Curve,
    Floats,
    Numbers,
    ReportData,
    decimals,
)
from qfolio.report.rendering import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

from qfolio.report.figures.style import LEAD, NARROW, WIDE, Target, new_figure, save_png


def learning_curve(target: Target, data: ReportData) -> None:
    """Save the greedy return over training, with a close view near the optimum, as PNG."""
    save_png(target, draw_learning_curve, data, LEAD)


def overestimation(target: Target, data: ReportData) -> None:
    """Save the overestimation of action values over training as PNG."""
    save_png(target, draw_overestimation, data, WIDE)


def draw_learning_curve(data: ReportData, width: float) -> Figure:
    """Draw the greedy return over training, and a close-up near the optimum if useful.

    In a market, the comparison is drawn instead of training returns.
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


def draw_overestimation(data: ReportData, width: float) -> Figure:
    """Draw how far the action values lie above the realised returns."""
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
    axes.set_title("Action value minus realised return", pad=26 if beside else 40)
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
    """Draw runs of shape (P, S): a thin line per seed, the interquartile mean, its band."""
    points, seeds = runs.shape
    marker = "o" if points == 1 else None
    if kind is not None:
        label = (
            f"{kind}, one seed" if seeds == 1 else f"{kind}, interquartile mean of {seeds} seeds"
        )
    if seeds > 1:
        alpha = max(0.1, min(0.35, 4 / seeds))
        axes.plot(episodes, runs, color=colour, linewidth=0.7, alpha=alpha, marker=marker)
        low, high = band(runs)
        axes.fill_between(episodes, low, high, color=colour, alpha=0.2, linewidth=0)
    middle = interquartile_mean(runs)
    # A single point must not vanish behind the edge or the legend.
    order, clip = (2, True) if points > 1 else (6, False)
    (line,) = axes.plot(episodes, middle, color=colour, linewidth=2, marker=marker, label=label)
    line.set(zorder=order, clip_on=clip)


def _draw_training(axes: Axes, data: ReportData) -> None:
    """Draw the median return of the exploring agents in about 60 bins of episodes."""
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
    """Cut returns far below zero off the scale, which untrained agents can have in a market."""
    low, high = axes.get_ylim()
    floor = min(0.0, optimum) - 2 * abs(optimum)
    if low < floor:
        axes.set_ylim(floor, min(high, optimum + abs(optimum)))
        _line_label(axes, floor, "beginning off the scale", color=palette.MUTED)


def _near_optimum(data: ReportData) -> tuple[float, float, float] | None:
    """Return the left, lower and upper ends of the close view, or None if none is needed."""
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


def _settled_range(curves: list[Curve]) -> tuple[float, float, bool]:
    """Return limits for everything after the first fifth, and whether something lies outside."""
    everything = np.concatenate([curve.overestimation.ravel() for curve in curves])
    settled = [curve.overestimation[len(curve.overestimation) // 5 :].ravel() for curve in curves]
    kept = np.concatenate([*settled, [0.0]])
    margin = max(0.12 * float(np.ptp(kept)), 1e-3)
    low, high = float(kept.min()) - margin, float(kept.max()) + margin
    return low, high, bool(everything.min() < low or everything.max() > high)
