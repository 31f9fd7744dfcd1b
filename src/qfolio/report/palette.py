"""The colors and marks shared by figures, animation and page.

Blue and orange are distinct for every common form of color blindness. The page replaces these
colors with its own variables, so that figures follow its light or dark scheme.
"""

from typing import NamedTuple

PAPER = "#ffffff"
INK = "#1c2530"
MUTED = "#66707c"
HAIRLINE = "#dfe3e8"
ACCENT = "#0b63a5"
SECOND = "#c4570a"

PATH = "#f28c3c"
VALUE_MAP = ["#0a1a2f", "#0c3d6b", "#1f72b0", "#7db8d8", "#f7f1e1"]
TORQUE_MAP = [SECOND, "#e5a878", "#f6f3ee", "#86b5d9", ACCENT]

LIGHT = {
    "paper": "#fdfdfb",
    "wash": "#f5f5f1",
    "ink": INK,
    "muted": MUTED,
    "faint": "#98a1ab",
    "hairline": HAIRLINE,
    "accent": ACCENT,
    "second": SECOND,
    "agent-1": ACCENT,
    "agent-2": SECOND,
    "agent-3": "#1b7a5a",
    "agent-4": "#7a3f98",
    "agent-5": "#a8324e",
    "agent-6": "#7a6200",
}
DARK = {
    "paper": "#14181d",
    "wash": "#1b2027",
    "ink": "#e7eaee",
    "muted": "#98a3af",
    "faint": "#6b7683",
    "hairline": "#2d343d",
    "accent": "#66b0ee",
    "second": "#f0935a",
    "agent-1": "#66b0ee",
    "agent-2": "#f0935a",
    "agent-3": "#5ac79c",
    "agent-4": "#c49ae6",
    "agent-5": "#f08ba0",
    "agent-6": "#d8bd4c",
}
"""The page's variables in its light and its dark scheme."""

CSS_VARIABLES = {
    PAPER: "--paper",
    INK: "--ink",
    MUTED: "--muted",
    HAIRLINE: "--hairline",
    ACCENT: "--accent",
    SECOND: "--second",
    **{LIGHT[f"agent-{n}"]: f"--agent-{n}" for n in (3, 4, 5, 6)},
}
"""The page's variable for each color of a figure."""

AGENTS = 6
"""Number of colors for agents; further agents reuse them with dashed lines."""


def mix(first: str, second: str, share: float) -> str:
    """The color at a share of the way from the first to the second."""
    ends = [[int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in (first, second)]
    mixed = [round(a + share * (b - a)) for a, b in zip(*ends, strict=True)]
    return "#" + "".join(f"{part:02x}" for part in mixed)


class Marker(NamedTuple):
    """A marker in the notations of those that draw it."""

    matplotlib: str = ""
    plotly: str = ""
    svg: str = ""  # a path in a box 30 wide and 10 high


UNMARKED = Marker()

MARKERS = (
    Marker("o", "circle", "M11,5a4,4 0 1,0 8,0a4,4 0 1,0 -8,0"),
    Marker("s", "square", "M11.5,1.5h7v7h-7z"),
    Marker("D", "diamond", "M15,0l5,5l-5,5l-5,-5z"),
    Marker("^", "triangle-up", "M15,.5l4.5,8h-9z"),
    Marker("v", "triangle-down", "M15,9.5l4.5,-8h-9z"),
    Marker("p", "pentagon", "M15,.5l4.6,3.4l-1.8,5.4h-5.6l-1.8,-5.4z"),
)
"""Markers of agents."""
