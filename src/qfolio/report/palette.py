"""The colours shared by figures, animation and page.

Blue and orange stay apart for every common form of colour blindness. The page renames these
colours to its own variables, which is how the figures follow its light or dark scheme.
"""

PAPER = "#ffffff"
INK = "#1c2530"
MUTED = "#66707c"
HAIRLINE = "#dfe3e8"
ACCENT = "#0b63a5"
SECOND = "#c4570a"

CSS_VARIABLES = {
    PAPER: "--paper",
    INK: "--ink",
    MUTED: "--muted",
    HAIRLINE: "--hairline",
    ACCENT: "--accent",
    SECOND: "--second",
}

PATH = "#f28c3c"
VALUE_MAP = ["#0a1a2f", "#0c3d6b", "#1f72b0", "#7db8d8", "#f7f1e1"]
TORQUE_MAP = [SECOND, "#e5a878", "#f6f3ee", "#86b5d9", ACCENT]
