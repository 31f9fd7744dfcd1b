"""Figures of a market: targets of the learned policies and the best one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from qfolio.report import palette
from qfolio.report.data import (
    ReportData,
    Responses,
    Weights,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

from qfolio.report.figures.style import (
    NARROW,
    end_label,
    legend_above,
    new_figure,
)


def draw_policy(data: ReportData, width: float) -> Figure:
    """Draw the targets of the learned policies and the best one in a market.

    Raises ValueError without them.
    """
    drawn = data.market.policy if data.market else None
    if drawn is None:
        raise ValueError("the policy figure needs the policies of a market")
    if isinstance(drawn, Weights):
        return _draw_weights(drawn, width)
    return _draw_responses(drawn, width)


def _draw_responses(drawn: Responses, width: float) -> Figure:
    """Draw targets over holdings: weights by scene, or positions in all scenes."""
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
            end_label(panel, drawn.held[-1], drawn.exact[scene, -1], name)
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
        panel.set_ylabel(f"target {noun}")
    legend_above(figure, lines)
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
    """Draw the diagonal, where target and holding are equal, and the no-trade region.

    place: where on the diagonal to write its label, if at all.
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
    if min(drawn.exact.min(), drawn.learned.min()) >= 0:
        axes.set_xlim(left=0)
    axes.grid(axis="x")
    axes.set_xlabel("weight")
    legend_above(figure, marks)
    return figure
