"""Maps of the pendulum's states: the learned value and policy beside the exact ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from qfolio.core.arrays import AnyFloats
from qfolio.report import palette
from qfolio.report.data import Episode, Maps, ReportData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

from qfolio.report.figures.style import NARROW, Panels, colors, new_figure


def draw_value(data: ReportData, width: float) -> Figure:
    """Draw the learned and the exact policy, and the values if there are any, over the states.

    Raises ValueError without maps.
    """
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
    torques = colors("torque", palette.TORQUE_MAP)
    limit = max(2.0, np.abs(maps.policy).max(), np.abs(maps.exact_policy).max())
    for panel, table in zip(axes[-1], (maps.policy, maps.exact_policy), strict=True):
        image = _draw_map(panel, maps, table, torques, -limit, limit, "nearest")
    _color_bar(figure, image, axes[-1], "torque (N m)")
    for panel, name in zip(axes.flat, names, strict=True):
        panel.set_title(name, pad=6)
    _map_ticks(axes, few=width <= NARROW)
    if data.episode is not None:
        _draw_path(axes[0, 0], data.episode)
    return figure


def _draw_values(axes: Panels, maps: Maps, learned: AnyFloats) -> None:
    both = np.stack([learned, maps.exact_value])
    low, high = float(both.min()), float(both.max())
    values = colors("value", palette.VALUE_MAP)
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
    _color_bar(axes[0].figure, image, axes, "value")


def _draw_map(
    axes: Axes,
    maps: Maps,
    table: AnyFloats,
    colors: Colormap,
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
        cmap=colors,
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


def _color_bar(figure: Figure, image: AxesImage, axes: Panels, label: str) -> None:
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
