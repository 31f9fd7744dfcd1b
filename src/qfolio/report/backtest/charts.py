"""The data of the page's charts, thinned so that a browser draws them quickly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qfolio.report import palette
from qfolio.report.backtest.data import BacktestData, StrategySeries, faint_names
from qfolio.report.backtest.looks import SYMBOLS, Look
from qfolio.report.backtest.paths import across_seeds, cost_share, median_drawdown, wealth_paths
from qfolio.report.data import Floats
from qfolio.report.rendering import number, percent

POINTS = 1500
"""Most points of a line; longer tests are thinned evenly."""

AREAS = 300
"""Most points of a weights chart; each is a mean over consecutive days."""

NAMED = 10
"""How many assets a weights chart names; the others are drawn as one."""


def chart_data(names: list[str], looks: dict[str, Look], data: BacktestData) -> dict[str, Any]:
    """Return the data of the page's script, in the order of the names."""
    days = len(data.dates)
    # The last day of every block; the start comes before them.
    ends = np.arange(days - 1, -1, -days_per_point(days))[::-1]
    start = data.dates[:1] - min(np.timedelta64(1, "D"), *np.diff(data.dates[:2]))
    months, firsts = np.unique(data.dates.astype("datetime64[M]"), return_index=True)
    blocks = np.arange(0, days, math.ceil(days / AREAS))
    return {
        "themes": {"light": palette.LIGHT, "dark": palette.DARK},
        "dates": _texts(np.concatenate([start, data.dates[ends]])),
        "hidden": [place for place, name in enumerate(names) if name in faint_names(data)],
        "months": _texts(months.astype("datetime64[D]")),
        "strategies": [
            {
                "colour": looks[name].colour,
                "width": looks[name].width,
                "dash": looks[name].dash,
                "symbol": None if (place := looks[name].symbol) is None else SYMBOLS[place],
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
    # The deepest drawdown since the point before, so that thinning hides no trough.
    deepest = np.maximum.reduceat(median_drawdown(series), np.append(0, ends[:-1] + 1))
    several = len(series.returns) > 1
    return {
        "wealth": _compact(middle, positive=True),
        "band": {"low": _compact(low, positive=True), "high": _compact(high, positive=True)}
        if several
        else None,
        "drawdown": _compact(np.append(0, -deepest)),
        "cost": _compact(np.append(0, cost_share(series)[ends])),
        "turnover": _compact(np.add.reduceat(series.turnover.mean(axis=0), months)),
    }


def _areas(
    weights: list[Floats], assets: tuple[str, ...], blocks: NDArray[np.intp]
) -> list[dict[str, Any]]:
    """Return, for each strategy, its weights by block of days: cash, the largest, and the rest.

    An asset has the same colour in all charts; colours repeat when there are too few.
    """
    colours: dict[int, str] = {}
    result = []
    for table in weights:
        mean = table.mean(axis=0)
        ranked = (np.argsort(-mean[1:], kind="stable") + 1).tolist()
        # A single remaining asset is named instead of called others.
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


def days_per_point(days: int) -> int:
    """Days per point of a line."""
    return math.ceil(days / POINTS)


def _texts(dates: NDArray[np.datetime64]) -> list[str]:
    """Dates as text for plotly and readers, with the time of day if there is one."""
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


def latest_values(lines: dict[str, Any]) -> dict[str, str]:
    """The final values, which legends show until the pointer selects a date."""
    wealth = lines["wealth"][-1] or 0
    return {
        "wealth": number(wealth, 0 if wealth >= 100 else 1 if wealth >= 10 else 2),
        **{key: percent(lines[key][-1]) for key in ("drawdown", "cost", "turnover")},
    }
