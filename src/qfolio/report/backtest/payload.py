"""The numbers that the page's charts draw, few enough to be drawn at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qfolio.portfolio.backtest.measures import drawdown
from qfolio.report import palette
from qfolio.report.data import Floats

if TYPE_CHECKING:
    pass

from qfolio.report.backtest.data import BacktestData, StrategySeries

POINTS = 1500
"""Most points that a line of the page is drawn with; more days are thinned out evenly."""

AREAS = 300
"""Most points of the areas that show weights; each is the mean over some days in a row."""

NAMED = 10
"""How many assets the picture of a strategy's weights names; the others are taken together."""

_DASHES = ("6 3", "2 2", "7 2 2 2", "9 3", "2 4", "7 2 2 2 2 2", "4 4")

_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon")


@dataclass(frozen=True)
class Look:
    """How a strategy is drawn, in every figure alike: agents strong, baselines thin and grey."""

    colour: str  # a key of palette.LIGHT and palette.DARK
    width: float
    dash: str  # lengths as in SVG; '' is solid
    symbol: int | None  # place in _SYMBOLS; none for baselines


def looks_of(names: list[str], data: BacktestData) -> dict[str, Look]:
    looks, agents, others = {}, 0, 0
    for name in names:
        if data.strategies[name].kind == "agent":
            dash = "" if agents < palette.AGENTS else "8 3"
            colour = f"agent-{agents % palette.AGENTS + 1}"
            looks[name] = Look(colour, 2.2, dash, agents % len(_SYMBOLS))
            agents += 1
        elif name == data.assessment.reference:
            looks[name] = Look("muted", 1.5, "", None)
        elif name == data.assessment.best_baseline:
            looks[name] = Look("muted", 1.5, _DASHES[0], None)
        else:
            others += 1
            looks[name] = Look("faint", 1.1, _DASHES[others % len(_DASHES)], None)
    return looks


def chart_data(names: list[str], looks: dict[str, Look], data: BacktestData) -> dict[str, Any]:
    """Return the numbers of the charts, few enough to be drawn at once."""
    days = len(data.dates)
    # The last day of every stretch, and before them all the start.
    ends = np.arange(days - 1, -1, -days_per_point(days))[::-1]
    start = data.dates[:1] - min(np.timedelta64(1, "D"), *np.diff(data.dates[:2]))
    months, firsts = np.unique(data.dates.astype("datetime64[M]"), return_index=True)
    blocks = np.arange(0, days, math.ceil(days / AREAS))
    return {
        "themes": {"light": palette.LIGHT, "dark": palette.DARK},
        "dates": _texts(np.concatenate([start, data.dates[ends]])),
        "months": _texts(months.astype("datetime64[D]")),
        "strategies": [
            {
                "colour": looks[name].colour,
                "width": looks[name].width,
                "dash": looks[name].dash,
                "symbol": None if (place := looks[name].symbol) is None else _SYMBOLS[place],
                **_lines(data.strategies[name], ends, firsts),
            }
            for name in names
        ],
        "weights": {
            "dates": _texts(data.dates[np.append(blocks[1:], days) - 1]),
            "series": _areas(
                [data.strategies[name].weights for name in names], data.assets, blocks
            ),
        },
    }


def _lines(
    series: StrategySeries, ends: NDArray[np.intp], months: NDArray[np.intp]
) -> dict[str, Any]:
    middle, low, high = (np.append(1, line[ends]) for line in across_seeds(wealth_paths(series)))
    # The deepest fall since the point before, so that thinning hides no trough.
    deepest = np.maximum.reduceat(fall_below_peak(series), np.append(0, ends[:-1] + 1))
    several = len(series.returns) > 1
    return {
        "wealth": _compact(middle, positive=True),
        "band": {"low": _compact(low, positive=True), "high": _compact(high, positive=True)}
        if several
        else None,
        "drawdown": _compact(np.append(0, -deepest)),
        "cost": _compact(np.append(0, _paid(series)[ends])),
        "turnover": _compact(np.add.reduceat(series.turnover.mean(axis=0), months)),
    }


def _areas(
    weights: list[Floats], assets: tuple[str, ...], blocks: NDArray[np.intp]
) -> list[dict[str, Any]]:
    """Return, for each strategy, its weights by block of days: cash, the largest, and the rest.

    An asset has the same colour wherever it is named, as long as there are colours.
    """
    colours: dict[int, str] = {}
    result = []
    for table in weights:
        mean = table.mean(axis=0)
        ranked = (np.argsort(-mean[1:], kind="stable") + 1).tolist()
        # One asset left over is better named than called others.
        count = NAMED if len(ranked) > NAMED + 1 else len(ranked)
        top, rest = ranked[:count], ranked[count:]
        for asset in top:
            colours.setdefault(asset, palette.ASSETS[len(colours) % len(palette.ASSETS)])
        groups = [[0], *([asset] for asset in top), *([rest] if rest else [])]
        by_block = np.add.reduceat(table, blocks, axis=0)
        by_block /= by_block.sum(axis=1, keepdims=True)
        result.append(
            {
                "names": ["Cash", *(assets[asset - 1] for asset in top)]
                + [f"{len(rest)} others"] * bool(rest),
                "colours": ["cash", *(colours[asset] for asset in top)] + ["hairline"] * bool(rest),
                "values": [_compact(by_block[:, group].sum(axis=1), 3) for group in groups],
                "average": [float(mean[group].sum()) for group in groups],
            }
        )
    return result


def wealth_paths(series: StrategySeries) -> Floats:
    """Wealth after each day, from 1 at the start, of shape (seeds, days)."""
    return np.cumprod(1 + series.returns, axis=1)


def across_seeds(values: Floats) -> tuple[Floats, Floats, Floats]:
    """The median, the least and the greatest over the seeds."""
    return np.median(values, axis=0), values.min(axis=0), values.max(axis=0)


def fall_below_peak(series: StrategySeries) -> Floats:
    """How far the wealth lies below its peak so far: the median over the seeds, positive."""
    return np.asarray(np.median(drawdown(series.returns), axis=0))


def _paid(series: StrategySeries) -> Floats:
    """By what share the costs so far have made the wealth smaller, the mean over the seeds."""
    return np.asarray((1 - np.cumprod(1 - series.cost, axis=1)).mean(axis=0))


def days_per_point(days: int) -> int:
    """How many days there are to a point of a line."""
    return math.ceil(days / POINTS)


def _texts(dates: NDArray[np.datetime64]) -> list[str]:
    """Dates as plotly and people read them, with the time of day where there is one."""
    whole = (dates == dates.astype("datetime64[D]")).all()
    texts = np.datetime_as_string(dates, unit="D" if whole else "m").tolist()
    return [text.replace("T", " ") for text in texts]


def _compact(values: Floats, digits: int = 4, *, positive: bool = False) -> list[float | None]:
    """Numbers with few digits; None for those that cannot be drawn."""
    return [
        float(f"{value:.{digits}g}")
        if math.isfinite(value) and (value > 0 or not positive)
        else None
        for value in values.tolist()
    ]
