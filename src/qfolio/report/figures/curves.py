"""Learning curves: greedy returns, their regret and the overestimation over training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from qfolio.core.arrays import AnyFloats
from qfolio.core.statistics import band, interquartile_mean, regret
from qfolio.report import palette
from qfolio.report.data import Curve, Numbers, ReportData, decimals
from qfolio.report.rendering import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

from qfolio.report.figures.style import (
    NARROW,
    new_figure,
    percent_axis,
    percent_tick,
    short_tick,
)

LEAST_REGRET = 1e-4
"""Regret that counts as zero: logarithmic scales end there."""

DECADES = 5
"""Maximum number of decades on a scale of regrets; larger regrets are off the scale."""


def draw_learning_curve(data: ReportData, width: float) -> Figure:
    """Draw the greedy return over training, and its regret if the optimum is known.

    In a market, the comparison run is drawn instead of training returns.
    """
    panels = 2 if np.isfinite(data.optimum) and data.optimum else 1
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
    _line_axes(whole, name.capitalize(), data)
    for curve, color in curves:
        _draw_runs(whole, curve.done, curve.returns, color, kind, curve.label)
    _draw_training(whole, data)
    whole.set_xlim(left=0)
    _draw_optimum(whole, data)
    if data.market and data.optimum:
        _cut_beginning(whole, data.optimum)
    whole.legend(loc="best", labelcolor=palette.MUTED)
    if panels == 2:
        _draw_regret(axes.flat[1], data, curves)
    return figure


def draw_overestimation(data: ReportData, width: float) -> Figure:
    """Draw how far the action values lie above the realized returns."""
    figure = new_figure(width, 3.5 if width > NARROW else 3.2)
    axes = figure.subplots()
    _line_axes(axes, "", data)
    curves = [data.curve] if data.comparison is None else [data.curve, data.comparison]
    for curve, color in zip(curves, (palette.ACCENT, palette.SECOND), strict=False):
        _draw_runs(axes, curve.done, curve.overestimation, color, None, curve.label)
    axes.axhline(0, color=palette.INK, linewidth=0.9, dashes=(4, 3))
    _line_label(axes, 0, "unbiased", below=True)
    low, high, clipped = _settled_range(curves)
    axes.set_xlim(left=0)
    axes.set_ylim(low, high)
    # On a phone, long names do not fit beside each other.
    beside = width > NARROW or sum(len(curve.label) for curve in curves) < 32
    axes.set_title("Action value minus realized return", pad=26 if beside else 40)
    if clipped:
        _line_label(axes, high, "beginning off the scale", below=True, color=palette.MUTED)
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=2 if beside else 1,
        labelcolor="linecolor",
        borderpad=0.3,
        columnspacing=1.4,
    )
    return figure


def _line_axes(axes: Axes, title: str, data: ReportData) -> None:
    axes.grid(axis="y")
    axes.set_title(title)
    axes.set_xlabel("training episodes" if data.unit == "episodes" else "environment steps")
    axes.locator_params(nbins=6)
    if data.curve.done[-1] >= 10_000:
        axes.xaxis.set_major_formatter(lambda tick, _: short_tick(tick))
    axes.margins(x=0)


def _draw_runs(
    axes: Axes,
    done: Numbers,
    runs: AnyFloats,
    color: str,
    kind: str | None = None,
    label: str | None = None,
    least: float = -np.inf,
) -> None:
    """Draw runs of shape (P, S): a thin line per seed, the interquartile mean, its band.

    Values below ``least`` are drawn at ``least``.
    """
    points, seeds = runs.shape
    marker = "o" if points == 1 else None
    if kind is not None:
        label = (
            f"{kind}, one seed" if seeds == 1 else f"{kind}, interquartile mean of {seeds} seeds"
        )
    if seeds > 1:
        alpha = max(0.1, min(0.35, 4 / seeds))
        thin = np.maximum(runs, least)
        axes.plot(done, thin, color=color, linewidth=0.7, alpha=alpha, marker=marker)
        low, high = (np.maximum(end, least) for end in band(runs))
        axes.fill_between(done, low, high, color=color, alpha=0.2, linewidth=0)
    middle = np.maximum(interquartile_mean(runs), least)
    # A single point must not vanish behind the edge or the legend.
    order, clip = (2, True) if points > 1 else (6, False)
    (line,) = axes.plot(done, middle, color=color, linewidth=2, marker=marker, label=label)
    line.set(zorder=order, clip_on=clip)


def _draw_training(axes: Axes, data: ReportData) -> None:
    """Draw the median return of the exploring agents in about 60 bins of episodes."""
    if data.training_done.size == 0:
        return
    edges = np.linspace(data.training_done.min(), data.training_done.max() + 1, 61)
    bins = np.digitize(data.training_done, edges)
    used = np.unique(bins)
    centers = [data.training_done[bins == number].mean() for number in used]
    medians = [np.median(data.training_returns[bins == number]) for number in used]
    axes.plot(
        centers,
        medians,
        color=palette.MUTED,
        linewidth=1,
        alpha=0.55,
        label="while training and exploring, median",
        zorder=1.5,
    )


def _draw_optimum(axes: Axes, data: ReportData) -> None:
    if np.isnan(data.optimum):  # not known
        return
    name = f"exact optimum {number(data.optimum, decimals(data.optimum))}"
    axes.axhline(data.optimum, color=palette.INK, linewidth=0.9, dashes=(4, 3), label=name)


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


def _draw_regret(axes: Axes, data: ReportData, curves: list[tuple[Curve, str]]) -> None:
    """Draw the regret, as a share of the optimum, on a logarithmic scale."""
    _line_axes(axes, "Regret, on a logarithmic scale", data)
    regrets = []
    for curve, color in curves:
        missed = regret(curve.returns, data.optimum)
        assert missed is not None  # or there would be no panel for it
        _draw_runs(axes, curve.done, missed, color, least=LEAST_REGRET)
        regrets.append(missed)
    least = max(min(interquartile_mean(missed).min() for missed in regrets), LEAST_REGRET)
    worst = max(missed.max() for missed in regrets)
    top = min(max(worst, 10 * least), 10**DECADES * least)
    axes.set_yscale("log")
    axes.set_ylim(least / 1.3, top * 1.3)
    percent_axis(axes.yaxis)
    axes.set_xlim(left=0)
    if least == LEAST_REGRET:
        text = f"{percent_tick(LEAST_REGRET)} or less"
        _line_label(axes, least, text, color=palette.MUTED)
    if worst > top:
        _line_label(axes, top, "beginning off the scale", below=True, color=palette.MUTED)


def _settled_range(curves: list[Curve]) -> tuple[float, float, bool]:
    """Return limits for everything after the first fifth, and whether something lies outside."""
    everything = np.concatenate([curve.overestimation.ravel() for curve in curves])
    settled = [curve.overestimation[len(curve.overestimation) // 5 :].ravel() for curve in curves]
    kept = np.concatenate([*settled, [0.0]])
    margin = max(0.12 * float(np.ptp(kept)), 1e-3)
    low, high = float(kept.min()) - margin, float(kept.max()) + margin
    return low, high, bool(everything.min() < low or everything.max() > high)
