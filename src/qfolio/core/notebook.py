"""What an object shows of itself in a notebook: small, escaped HTML that needs nothing else."""

import math
from collections.abc import Sequence
from html import escape

from qfolio.core.text import printable

ROWS = 20
"""Most rows of a table; a line says how many more there are."""

WIDTH, HEIGHT = 160, 36  # of a curve, in pixels


def card(
    title: str,
    facts: Sequence[str],
    header: Sequence[str] = (),
    rows: Sequence[Sequence[str]] = (),
    curve: Sequence[float] = (),
) -> str:
    """A title, a line of facts, a curve and a table; all texts are escaped."""
    parts = [f"<div><b>{_text(title)}</b><br><small>{' · '.join(map(_text, facts))}</small></div>"]
    points = [x for x in curve if math.isfinite(x)]
    if len(points) > 1:
        parts.append(_curve(points))
    if rows:
        parts.append(f"<table><thead>{_row(header, 'th')}</thead><tbody>")
        parts += [_row(row, "td") for row in rows[:ROWS]]
        parts.append("</tbody></table>")
    if len(rows) > ROWS:
        parts.append(f"<small>and {len(rows) - ROWS} more</small>")
    return "".join(parts)


def _text(text: str) -> str:
    return escape(printable(text))


def _row(cells: Sequence[str], kind: str) -> str:
    return "<tr>" + "".join(f"<{kind}>{_text(cell)}</{kind}>" for cell in cells) + "</tr>"


def _curve(points: Sequence[float]) -> str:
    low, high = min(points), max(points)
    across, up = WIDTH / (len(points) - 1), (HEIGHT - 4) / ((high - low) or 1.0)
    path = " ".join(
        f"{i * across:.1f},{HEIGHT - 2 - (y - low) * up:.1f}" for i, y in enumerate(points)
    )
    return (
        f'<svg width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="learning curve">'
        f'<polyline points="{path}" fill="none" stroke="#0b63a5" stroke-width="1.5"/></svg>'
    )
