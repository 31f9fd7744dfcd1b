"""Paths of a strategy over the days of the test, summarized over its seeds, and their numbers."""

import math

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.measures import drawdown
from qfolio.report.backtest.data import StrategySeries


def wealth_paths(series: StrategySeries) -> Floats:
    """Wealth after each day, from 1 at the start, of shape (seeds, days)."""
    return np.asarray(np.cumprod(1 + series.returns, axis=1))


def across_seeds(values: Floats) -> tuple[Floats, Floats, Floats]:
    """The median, the least and the greatest over the seeds."""
    return np.median(values, axis=0), values.min(axis=0), values.max(axis=0)


def median_drawdown(series: StrategySeries) -> Floats:
    """Median drawdown over the seeds after each day; positive, of shape (days,)."""
    return np.asarray(np.median(drawdown(series.returns), axis=0))


def cost_share(series: StrategySeries) -> Floats:
    """Cumulative cost as a share of wealth, the mean over the seeds, of shape (days,)."""
    return np.asarray((1 - np.cumprod(1 - series.cost, axis=1)).mean(axis=0))


def texts(dates: NDArray[np.datetime64]) -> list[str]:
    """Dates as text for plotly and readers, with the time of day if there is one."""
    whole = (dates == dates.astype("datetime64[D]")).all()
    texts = np.datetime_as_string(dates, unit="D" if whole else "m").tolist()
    return [text.replace("T", " ") for text in texts]


def compact(values: Floats, digits: int = 4, *, positive: bool = False) -> list[float | None]:
    """Numbers with few digits; None for those that cannot be drawn."""
    return [
        float(f"{value:.{digits}g}")
        if math.isfinite(value) and (value > 0 or not positive)
        else None
        for value in values.tolist()
    ]
