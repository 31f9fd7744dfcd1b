"""The page of ``qfolio follow``: live wealth, the backtest's band, and evidence against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from qfolio.report import palette
from qfolio.report.figures.style import NARROW, legend_above, new_figure, svgs
from qfolio.report.rendering import number, percent, render, typeset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 8.6
"""Width of the figure in inches, on wide pages."""


@dataclass(frozen=True)
class LiveRows:
    """The data of the page's figures: an entry for each row, growth relative to the start.

    band: quantiles at 2.5%, 50% and 97.5%, of shape (3, rows). alarm: level of evidence that
    raises the alarm.
    """

    dates: np.ndarray
    growth: np.ndarray
    benchmark: np.ndarray
    benchmark_name: str
    band: np.ndarray
    evidence: np.ndarray
    alarm: float


def render_following(
    title: str,
    sentences: Sequence[str],
    rows: LiveRows,
    measures: Mapping[str, Mapping[str, float]],
) -> str:
    """Return the text of the page.

    Args:
        title: Its heading.
        sentences: The findings; the first ones appear at the top.
        rows: The data to draw; at least one row.
        measures: Growth, growth per year, volatility, Sharpe ratio and drawdown, by name; NaN
            where there are too few rows.
    """
    table = [
        (name, [number(x, 2) if key == "sharpe" else percent(x) for key, x in found.items()])
        for name, found in measures.items()
    ]
    chart = svgs(draw_following, rows, WIDTH)
    said = [*map(typeset, sentences)]
    return render("follow.html", title=title, sentences=said, table=table, chart=chart)


def draw_following(rows: LiveRows, width: float) -> Figure:
    """Draw wealth with its band above; below, evidence with its alarm level on a log axis."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    few = width <= NARROW
    figure = new_figure(width, 4.6 if few else 5.0)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.3))
    low, middle, high = 100 * (rows.band - 1)
    days = rows.dates.astype("datetime64[s]").astype(object)
    shade = above.fill_between(days, low, high, color=palette.HAIRLINE, linewidth=0)
    (median,) = above.plot(days, middle, color=palette.MUTED, linewidth=0.8, linestyle="--")
    (other,) = above.plot(days, 100 * (rows.benchmark - 1), color=palette.SECOND, linewidth=1.1)
    (live,) = above.plot(days, 100 * (rows.growth - 1), color=palette.ACCENT, linewidth=1.6)
    above.set_title("Growth since the first trade, after costs, %")
    above.grid(axis="y")
    below.plot(days, rows.evidence, color=palette.INK, linewidth=1.1)
    below.axhline(rows.alarm, color=palette.SECOND, linewidth=0.9)
    below.set_yscale("log")
    highest = max(2 * rows.alarm, 1.2 * float(rows.evidence.max()))
    below.set_ylim(min(0.5, float(rows.evidence.min())), highest)
    below.set_yticks([1, rows.alarm], ["1", f"{rows.alarm:g}"])
    below.minorticks_off()
    below.set_title(f"Evidence against the backtest; alarm at {rows.alarm:g}")
    # With fewer, no step fits between 18 and 24 months, and matplotlib warns.
    ticks = AutoDateLocator(minticks=2, maxticks=5 if few else 8)
    below.xaxis.set_major_locator(ticks)
    below.xaxis.set_major_formatter(ConciseDateFormatter(ticks))
    marks = {"live": live, rows.benchmark_name: other, "backtest, median": median, "95%": shade}
    legend_above(figure, marks)
    return figure
