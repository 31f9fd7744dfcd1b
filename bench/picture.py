"""The picture on the front page: wealth of tilts beside their anchor, on several tables.

    python bench/picture.py "20 US stocks=runs/default" "17 US industries=runs/industries"

Each argument is a panel: its title, and the folder of a finished backtest of tilts.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from qfolio.core.files import read_json
from qfolio.report import palette
from qfolio.report.figures.style import new_figure, save_png
from qfolio.report.rendering import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "edge.png"
AGENT = "tilts-together"
WIDTH = 8.4  # inches


class Panel(NamedTuple):
    """A table's name, the wealth of both on it, and how much faster that of tilts grew.

    seeds: those of tilts, which trade together.
    """

    title: str
    tilts: pd.Series
    equal_weight: pd.Series  # at the speed of rebalancing that grew most
    difference: str
    seeds: int


def panel(title: str, folder: Path) -> Panel:
    returns = pd.read_csv(folder / "returns.csv", index_col="date", parse_dates=True)
    compared = read_json(folder / "summary.json")["strategies"][AGENT]["to_rebalanced"]
    value, low, high = (
        percent(growth, 1, sign=True)
        for growth in (compared["growth"]["value"], *compared["growth"]["interval"])
    )
    wealth = (1 + returns).cumprod()
    difference = f"{value} a year\n95%: {low} to {high}"
    seeds = read_json(folder / "config.json")["seeds"]
    return Panel(title, wealth[AGENT], wealth[compared["reference"]], difference, seeds)


def draw_panels(panels: list[Panel], width: float) -> Figure:
    figure = new_figure(width, 3.3)
    charts = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, part in zip(charts, panels, strict=True):
        _draw(axes, part)
    charts[0].set_ylabel("wealth after costs, log scale")
    figure.legend(
        *charts[0].get_legend_handles_labels(),
        loc="outside lower left",
        ncols=2,
        labelcolor=palette.INK,
    )
    return figure


def _draw(axes: Axes, part: Panel) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.ticker import LogLocator, NullFormatter

    days = part.tilts.index
    first, last = days[0].year, days[-1].year
    axes.fill_between(
        days, part.equal_weight, part.tilts, color=palette.ACCENT, alpha=0.12, linewidth=0
    )
    axes.plot(
        days, part.equal_weight, color=palette.INK, linewidth=1.0,
        label="equal weight at its best speed of rebalancing",
    )  # fmt: skip
    axes.plot(
        days, part.tilts, color=palette.ACCENT, linewidth=1.4, label=f"tilts, {part.seeds} seeds"
    )
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=9))
    axes.yaxis.set_major_formatter(lambda tick, _: f"{tick:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(axis="y", which="minor", length=0)
    locator = AutoDateLocator(maxticks=5)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    axes.set_title(f"{part.title}, {first} to {last}", fontweight="bold")
    axes.text(0.04, 0.96, part.difference, transform=axes.transAxes, va="top", color=palette.ACCENT)
    axes.grid(axis="y")
    axes.margins(x=0)


if __name__ == "__main__":
    parts = [argument.partition("=") for argument in sys.argv[1:]]
    save_png(PICTURE, draw_panels, [panel(title, Path(at)) for title, _, at in parts], WIDTH)
