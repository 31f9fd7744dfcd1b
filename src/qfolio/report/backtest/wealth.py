"""The figure of a backtest: wealth and drawdown."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING, Any

from qfolio.report import palette
from qfolio.report.backtest.data import BacktestData, faint_names, shown_order
from qfolio.report.backtest.looks import looks_of
from qfolio.report.backtest.paths import across_seeds, median_drawdown, wealth_paths
from qfolio.report.figures.style import dashes, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME = 30
"""Characters in a line of the legend; a long name would take the room of the chart."""


def draw_wealth(data: BacktestData, width: float) -> Figure:
    """Draw wealth on a log axis and the drawdown below it, in the light scheme.

    The other baselines are left out if they are too many to tell apart.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, PercentFormatter

    figure = new_figure(width, 5.4)
    axes = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    days = data.dates.astype("datetime64[s]")
    faint = faint_names(data)
    names = [name for name in shown_order(data) if name not in faint]
    looks = looks_of(names, data)
    handles = []
    for name in reversed(names):
        look, series = looks[name], data.strategies[name]
        color = palette.LIGHT[look.color]
        middle, low, high = across_seeds(wealth_paths(series))
        style: dict[str, Any] = {
            "color": color,
            "linewidth": 0.75 * look.width,
            "linestyle": dashes(look.dash, look.width),
        }
        if look.marker != palette.UNMARKED:
            start = (0.03 + 0.05 * palette.MARKERS.index(look.marker)) % 0.14
            marker: dict[str, Any] = {
                "marker": look.marker.matplotlib,
                "markersize": 5.5,
                "markeredgecolor": palette.PAPER,
                "markevery": (round(start * len(days)), max(1, len(days) // 7)),
            }
            if len(series.returns) > 1:
                axes[0].fill_between(days, low, high, color=color, alpha=0.15, linewidth=0)
        else:
            marker = {}
        handles += axes[0].plot(days, middle, **style, **marker, label=fill(name, NAME))
        axes[1].plot(days, -median_drawdown(series), **{**style, "linewidth": 0.5 * look.width})
    axes[0].set_yscale("log")
    axes[0].yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes[0].yaxis.set_major_formatter(FuncFormatter(lambda tick, _: f"{tick:g}"))
    axes[0].yaxis.set_minor_formatter(NullFormatter())
    axes[0].tick_params(axis="y", which="minor", length=0)
    axes[0].set_title("Wealth, starting at 1 (log scale)")
    axes[1].set_title("Drawdown")
    axes[1].yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    for panel in axes:
        panel.grid(axis="y")
        panel.margins(x=0)
    figure.legend(
        handles=handles[::-1], loc="outside right upper", labelcolor=palette.INK, handlelength=2.6
    )
    return figure
