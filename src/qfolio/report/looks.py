"""The looks of strategies and agents: each has the same line and marker in every figure."""

from __future__ import annotations

from dataclasses import dataclass

from qfolio.report import palette

_DASHES = ("", "8 3", "2 3")


@dataclass(frozen=True)
class Look:
    """The style of a line, and its marker."""

    color: str  # a key of palette.LIGHT and palette.DARK
    dash: str = ""  # lengths as in SVG; '' is solid
    width: float = 1.8
    marker: palette.Marker = palette.UNMARKED

    @staticmethod
    def of_agent(place: int, width: float = 1.8) -> Look:
        """The look of an agent; those beyond the last color reuse colors with dashed lines."""
        return Look(
            f"agent-{place % palette.AGENTS + 1}",
            _DASHES[place // palette.AGENTS % len(_DASHES)],
            width,
            palette.MARKERS[place % len(palette.MARKERS)],
        )
