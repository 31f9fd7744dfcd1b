"""The data of the page's charts, thinned so that a browser draws them quickly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.tearsheet import rolling_beta, rolling_sharpe
from qfolio.report import palette
from qfolio.report.backtest.data import BacktestData, StrategySeries, faint_names
from qfolio.report.backtest.holdings import holdings
from qfolio.report.backtest.paths import (
    across_seeds,
    compact,
    cost_share,
    median_drawdown,
    texts,
    wealth_paths,
)
from qfolio.report.looks import Look
from qfolio.report.rendering import number, percent

POINTS = 1500
"""Maximum number of points of a line; longer tests are thinned evenly."""


def chart_data(names: list[str], looks: dict[str, Look], data: BacktestData) -> dict[str, Any]:
    """Return the data of the page's script, in the order of the names."""
    days = len(data.dates)
    # The last day of every block, preceded by the start.
    ends = np.arange(days - 1, -1, -days_per_point(days))[::-1]
    _, firsts = np.unique(data.trades.astype("datetime64[M]"), return_index=True)
    window = rolling_window(data)
    return {
        "themes": {"light": palette.LIGHT, "dark": palette.DARK},
        "dates": texts(np.concatenate([data.trades[:1], data.dates[ends]])),
        "hidden": [place for place, name in enumerate(names) if name in faint_names(data)],
        "months": texts(data.trades[firsts]),
        "strategies": [
            {
                "color": looks[name].color,
                "width": looks[name].width,
                "dash": looks[name].dash,
                "symbol": looks[name].marker.plotly,
                **_lines(data.strategies[name], ends, firsts),
                **(_rolling(name, data, ends, window) if window else {}),
            }
            for name in names
        ],
        "weights": holdings(names, data),
    }


def rolling_window(data: BacktestData) -> int:
    """Rolling window of a year, in periods; 0 if the test is shorter than a year and a half."""
    year = max(2, round(data.assessment.periods_per_year))
    return year if 2 * len(data.dates) >= 3 * year else 0


def _rolling(
    name: str, data: BacktestData, ends: NDArray[np.intp], window: int
) -> dict[str, list[float | None]]:
    """Rolling Sharpe ratio and beta to the reference, means over the seeds, as they are shown."""
    returns, year = data.strategies[name].returns, data.assessment.periods_per_year
    reference = data.strategies[data.assessment.reference].returns[0]
    excess = returns - data.risk_free
    both = rolling_sharpe(excess, window, year), rolling_beta(returns, reference, window)
    sharpe, beta = (np.append(np.nan, values.mean(axis=0)[ends]).round(2) for values in both)
    return {"sharpe": compact(sharpe), "beta": compact(beta)}


def _lines(
    series: StrategySeries, ends: NDArray[np.intp], months: NDArray[np.intp]
) -> dict[str, Any]:
    middle, low, high = (np.append(1, line[ends]) for line in across_seeds(wealth_paths(series)))
    # The deepest drawdown since the point before, so that thinning hides no trough.
    deepest = np.maximum.reduceat(median_drawdown(series), np.append(0, ends[:-1] + 1))
    several = len(series.returns) > 1
    return {
        "wealth": compact(middle, 5, positive=True),
        "band": {"low": compact(low, positive=True), "high": compact(high, positive=True)}
        if several
        else None,
        "drawdown": compact(np.append(0, -deepest)),
        "cost": compact(np.append(0, cost_share(series)[ends])),
        "turnover": compact(_monthly_turnover(series, months), 5),
    }


def _monthly_turnover(series: StrategySeries, months: NDArray[np.intp]) -> Floats:
    """Turnover of each month without the first trade, the mean over the seeds.

    That trade buys from cash. It is so much larger than all others that they would look like zero.
    NaN for a month without any other day, and where only returns are known.
    """
    traded = series.turnover.copy()
    traded[np.arange(len(traded)), (traded > 0).argmax(axis=1)] = np.nan
    known = np.logical_or.reduceat(~np.isnan(traded), months, axis=1)
    sums = np.add.reduceat(np.nan_to_num(traded), months, axis=1)
    return np.asarray(np.where(known, sums, np.nan).mean(axis=0))


def days_per_point(days: int) -> int:
    """Days per point of a line."""
    return math.ceil(days / POINTS)


def latest_values(lines: dict[str, Any]) -> dict[str, str]:
    """The final values, which legends show until the pointer selects a date."""
    wealth = lines["wealth"][-1] or 0
    rolling = {key: lines.get(key, [None])[-1] for key in ("sharpe", "beta")}
    return {
        **{key: "–" if value is None else number(value, 2) for key, value in rolling.items()},
        "wealth": number(wealth, 0 if wealth >= 100 else 1 if wealth >= 10 else 2),
        **{
            key: "–" if (value := lines[key][-1]) is None else percent(value)
            for key in ("drawdown", "cost", "turnover")
        },
    }
