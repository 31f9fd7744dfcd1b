"""The axes of pages: positions on them, in percent of their length, and their ticks."""

import math
from typing import NamedTuple


class Axis(NamedTuple):
    """An axis from one number to another."""

    low: float
    high: float

    def at(self, value: float) -> float:
        """The position of a value; beyond the ends of the axis, that of the end."""
        share = (value - self.low) / (self.high - self.low) if self.high > self.low else 0.5
        return round(100 * min(max(share, 0.0), 1.0), 2)

    def span(self, value: float, interval: tuple[float, float]) -> tuple[float, float, float]:
        """Left end and width of a value's interval, and the position of the value."""
        left, right = map(self.at, interval)
        return left, round(right - left, 2), self.at(value)


def ticks_around(low: float, high: float) -> tuple[list[float], int]:
    """Round numbers around an interval and zero, and the decimals that they need in percent."""
    ticks = _ticks(min(low, 0), max(high, 0))
    return ticks, _digits(ticks)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers around an interval that contains zero, at most six."""
    width = max(high - low, 1e-4)
    power = 10 ** math.floor(math.log10(width))
    step = next(k * power for k in (0.2, 0.5, 1, 2, 5, 10) if width / (k * power) <= 4)
    return [k * step for k in range(math.ceil(low / step - 0.5), math.floor(high / step + 0.5) + 1)]


def _digits(ticks: list[float]) -> int:
    """The decimals with which these fractions are exact percentages."""
    return next(
        (d for d in range(5) if all(abs(100 * t - round(100 * t, d)) < 1e-9 for t in ticks)), 5
    )
