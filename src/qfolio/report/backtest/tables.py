"""The rows of the page's tables, as text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from qfolio.core.statistics import FEWEST_SEEDS
from qfolio.portfolio.backtest.assessment import Measure
from qfolio.portfolio.backtest.measures import monthly
from qfolio.portfolio.backtest.verdict import luck
from qfolio.report.backtest.data import BacktestData
from qfolio.report.rendering import number, percent

HEADINGS = {
    "growth": "Growth",
    "volatility": "Volatility",
    "sharpe": "Sharpe",
    "sortino": "Sortino",
    "drawdown": "Drawdown",
    "calmar": "Calmar",
    "turnover": "Turnover",
    "cost_drag": "Cost drag",
}

_PERCENT = ("growth", "volatility", "drawdown", "cost_drag")

_Year = tuple[int, list[tuple[str, str]]]


def statistics_rows(name: str, data: BacktestData) -> list[dict[str, str]]:
    entry = data.assessment.strategies[name]

    def written(key: str, value: float) -> str:
        return percent(value) if key in _PERCENT else number(value, 1 if key == "turnover" else 2)

    return [
        {
            "value": written(key, measure.mean),
            "time": " … ".join(written(key, end) for end in measure.over_time),
            "seeds": " … ".join(written(key, end) for end in _over_seeds(measure)),
        }
        for key, measure in ((key, entry.measures[key]) for key in HEADINGS)
    ]


def _over_seeds(measure: Measure) -> tuple[float, ...]:
    """The ends of the interval over seeds, or of the seeds' range if there are too few."""
    if measure.over_seeds is not None:
        return measure.over_seeds
    values = measure.per_seed
    return (min(values), max(values)) if 1 < len(values) < FEWEST_SEEDS else ()


def difference_rows(name: str, data: BacktestData) -> list[dict[str, str] | None]:
    """Growth and Sharpe ratio minus those of the reference, and of the best baseline."""
    entry = data.assessment.strategies[name]
    cells: list[dict[str, str] | None] = []
    for each in (entry.to_reference, entry.to_best_baseline):
        if each is None:
            cells += [None, None]
            continue
        for value, (low, high), write, scale, digits, found in (
            (each.growth, each.growth_interval, percent, 100, 1, each.finding),
            (each.sharpe, each.sharpe_interval, number, 1, 2, None),
        ):
            ends = (write(end, _telling(scale * end, digits), sign=True) for end in (low, high))
            cells.append(
                {
                    "value": write(value, digits, sign=True),
                    "interval": " … ".join(ends),
                    "side": {"better": "higher", "worse": "lower"}.get(found or "", ""),
                }
            )
    return cells


def _telling(value: float, digits: int) -> int:
    """The decimals, at least ``digits``, with which a small number does not round to 0."""
    if value == 0 or not math.isfinite(value):
        return digits
    return next((d for d in range(digits, 6) if round(value, d)), digits)


def luck_rows(names: list[str], data: BacktestData) -> list[dict[str, Any]]:
    rows = []
    for name in names:
        entry = data.assessment.strategies[name]
        test = entry.sharpe_test
        # Probabilities are rounded down: 94.96 must not read as 95.0.
        certain, deflated = (
            f"{percent(math.floor(1000 * p) / 1000)}" if math.isfinite(p) else "–"
            for p in (test.probabilistic, test.deflated)
        )
        rows.append(
            {
                "name": name,
                "sentence": None if entry.kind == "baseline" else luck(name, entry),
                "sharpe": number(entry.measures["sharpe"].mean, 2),
                "certain": certain,
                "threshold": number(test.threshold, 2),
                "deflated": deflated,
                "years": number(test.minimum_years),
                "shape": f"{number(test.skewness)} / {number(test.kurtosis)}",
            }
        )
    return rows


def month_tables(names: list[str], data: BacktestData) -> list[tuple[str, list[_Year]]]:
    """Return each strategy's mean returns over the seeds by month, with shades."""
    tables = []
    for name in names:
        years, table = monthly(data.strategies[name].returns, data.dates)
        empty = np.isnan(table).all(axis=-1, keepdims=True)
        whole = np.where(empty, np.nan, np.nanprod(1 + table, axis=-1, keepdims=True) - 1)
        tables.append((years, np.concatenate([table, whole], axis=-1).mean(axis=0)))
    sizes = np.abs([table[:, :12] for _, table in tables])
    scale = (
        float(np.nanquantile(sizes, 0.95)) or 1.0
    )  # the same for all tables, so that shades compare

    def cell(value: float) -> tuple[str, str]:
        if math.isnan(value):
            return "", ""
        level = min(math.ceil(5 * abs(value) / scale - 1e-9), 5)
        shade = f"{'gain' if value > 0 else 'loss'}{level}" if level else ""
        return number(100 * value), shade

    return [
        (
            name,
            [
                (year, [cell(v) for v in row])
                for year, row in zip(years, table.tolist(), strict=True)
            ],
        )
        for name, (years, table) in zip(names, tables, strict=True)
    ]


def fold_rows(folds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the folds with start and length of their windows, in % of the whole span."""
    if not folds:
        return []
    keys = ("train_first", "train_last", "test_first", "test_last")
    days = np.array([[fold[key] for key in keys] for fold in folds], dtype="datetime64[D]")
    days = days.astype(float)
    places = 100 * (days - days.min()) / max(np.ptp(days), 1)
    return [
        {**fold, "train": (a, b - a), "test": (c, d - c)}
        for fold, (a, b, c, d) in zip(folds, places.round(2).tolist(), strict=True)
    ]
