"""The style of all figures, and their output as PNG or inline SVG."""

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

from qfolio.core.files import write_bytes
from qfolio.report import palette
from qfolio.report.rendering import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure


T = TypeVar("T")
Panels = NDArray[np.object_]

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


def inline_svg(draw: Callable[[T, float], Figure], data: T, width: float) -> str:
    """Return a figure as an SVG element for a page.

    Texts stay texts in the font of the page, colors refer to the variables of the page
    (see palette.CSS_VARIABLES), and the element has no fixed size.

    Args:
        draw: One of the draw_ functions.
        data: The data to draw.
        width: Width in inches at which text has its natural size.
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
    for color, variable in palette.CSS_VARIABLES.items():
        body = body.replace(color, f"var({variable})")
    return f'<svg {box.group()} aria-hidden="true">{body}'


def svgs(draw: Callable[[T, float], Figure], data: T, width: float) -> dict[str, Markup]:
    """Return a figure for wide pages and for phones, as ``parts.html`` takes it."""
    sizes = {"wide": width, "narrow": NARROW}
    return {kind: Markup(inline_svg(draw, data, size)) for kind, size in sizes.items()}


def save_png(path: Path, draw: Callable[[T, float], Figure], data: T, width: float) -> None:
    """Save a function's figure of some data in the style of all figures."""
    png = io.BytesIO()
    _save(draw, data, width, png, format="png", dpi=160, facecolor=palette.PAPER)
    write_bytes(path, png.getvalue())


def _save(
    draw: Callable[[T, float], Figure],
    data: T,
    width: float,
    target: IO[bytes] | IO[str],
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


def legend_above(figure: Figure, marks: dict[str, Any], columns: int = 3) -> None:
    """Put a legend above a figure: an artist by each name, its mark not too faint nor too large."""
    from matplotlib.lines import Line2D

    legend = figure.legend(
        list(marks.values()),
        list(marks),
        loc="outside upper left",
        ncols=columns,
        labelcolor=palette.MUTED,
        columnspacing=1.6 if figure.get_figwidth() > NARROW else 1.0,
        handletextpad=0.6,
        borderpad=0.3,
    )
    for handle in legend.legend_handles:
        if not isinstance(handle, Line2D):
            continue
        handle.set_alpha(max(0.7, handle.get_alpha() or 1.0))
        handle.set_markersize(min(10, handle.get_markersize()))


def end_label(axes: Axes, x: float, y: float, text: str) -> None:
    """Write a label to the right of a line's end."""
    axes.annotate(
        text, (x, y), xytext=(4, 0), textcoords="offset points", va="center", color=palette.MUTED
    )


def colors(name: str, colors: list[str]) -> Colormap:
    """Return a color map that runs evenly through some colors."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(name, colors)


def dashes(lengths: str, width: float) -> Any:
    """Return the style of a line from dash lengths as in SVG; "" is solid.

    width: the line's width, the unit of matplotlib's lengths.
    """
    return (0, tuple(float(part) / width for part in lengths.split())) if lengths else "solid"


def percent_axis(axis: Any) -> None:
    """Give a logarithmic axis of fractions a few ticks, in percent."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 50 * low else (1,), numticks=8))
    axis.set_major_formatter(lambda tick, _: percent_tick(tick))
    axis.set_minor_formatter(NullFormatter())
    axis.set_tick_params(which="minor", length=0)


def percent_tick(tick: float) -> str:
    """A fraction as the label of a tick, with as many digits as needed: 0.1%, 2.5%, 5%."""
    return percent(tick, next(n for n in range(16) if math.isclose(round(tick, 2 + n), tick)))


def short_tick(tick: float) -> str:
    """A number as the label of a tick: 200k, 5M."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(tick) >= size:
            return f"{tick / size:g}{letter}"
    return f"{tick:g}"
