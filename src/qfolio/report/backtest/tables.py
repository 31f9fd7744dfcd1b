"""The rows of the page's tables, as text."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Literal

import numpy as np

from qfolio.core.statistics import FEWEST_SEEDS
from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.portfolio.backtest.statistics.differences import Difference
from qfolio.portfolio.backtest.statistics.estimates import MEASURED, Measured
from qfolio.portfolio.backtest.statistics.measures import growth_at, monthly
from qfolio.portfolio.backtest.statistics.sampled import Measure
from qfolio.portfolio.backtest.statistics.verdict import comparable, luck, shown, telling, wiped_out
from qfolio.portfolio.backtest.trading_terms import PROPORTIONAL
from qfolio.report.axis import Axis
from qfolio.report.backtest.data import BacktestData, best_word, main_names
from qfolio.report.backtest.facts import basis_points
from qfolio.report.rendering import number, percent, shade

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

_MEASURED: dict[Measured, str] = {
    "growth": "Log growth less",
    "sharpe": "Sharpe less",
    "volatility": "Volatility relative to",
}

RELATIVE_HEADINGS = {
    "active_return": "Active return",
    "tracking_error": "Tracking error",
    "information_ratio": "Information ratio",
    "beta": "Beta",
    "up_capture": "Up capture",
    "down_capture": "Down capture",
    "active_share": "Active share",
}

_PERCENT = (
    *("growth", "volatility", "drawdown", "cost_drag"),
    *("active_return", "tracking_error", "up_capture", "down_capture", "active_share"),
)

MULTIPLES = (0, 1, 2, 5, 10)
"""Multiples of the costs at which growth is shown."""

_Year = tuple[int, list[tuple[str, str]]]


def statistics_rows(name: str, data: BacktestData) -> list[dict[str, Any]]:
    """A strategy's figures with their intervals, as text and as bars on an axis for each column."""
    return [
        _cell(data.assessment.strategies[name].measures, key, "measures", data) for key in HEADINGS
    ]


def relative_rows(name: str, data: BacktestData) -> list[dict[str, Any]]:
    """A strategy's figures relative to the reference, likewise; dashes for the reference itself."""
    return [
        _cell(data.assessment.strategies[name].relative, key, "relative", data)
        for key in RELATIVE_HEADINGS
    ]


def _cell(
    measures: dict[str, Measure],
    key: str,
    table: Literal["measures", "relative"],
    data: BacktestData,
) -> dict[str, Any]:
    measure = measures.get(key)
    if measure is None or math.isnan(measure.mean):
        return {"value": "–", "time": "", "seeds": "", "bar": None}

    written = partial(_written, key)
    column = (getattr(data.assessment.strategies[n], table).get(key) for n in main_names(data))
    return {
        "value": written(measure.mean),
        "time": " … ".join(map(written, measure.over_time)),
        "seeds": " … ".join(map(written, _over_seeds(measure))),
        "bar": _interval(measure.mean, measure.over_time, [each for each in column if each]),
    }


def _written(key: str, value: float) -> str:
    """A measure as text; key: its name."""
    return percent(value) if key in _PERCENT else number(value, 1 if key == "turnover" else 2)


def _interval(
    value: float, interval: tuple[float, float], column: list[Measure]
) -> tuple[float, float, float] | None:
    """Left end, width and middle of an interval, in percent of the axis of its column.

    The axis is that of the main strategies; others may be cut off at its ends.
    """
    ends = [end for each in column for end in each.over_time if math.isfinite(end)]
    if not ends or not all(map(math.isfinite, (value, *interval))):
        return None
    return Axis(min(ends), max(ends)).span(value, interval)


def _over_seeds(measure: Measure) -> tuple[float, ...]:
    """The ends of the interval over seeds, or of the seeds' range if there are too few."""
    if measure.over_seeds is not None:
        return measure.over_seeds
    values = measure.per_seed
    return (min(values), max(values)) if 1 < len(values) < FEWEST_SEEDS else ()


def difference_headings(data: BacktestData) -> list[str]:
    """The column headings of ``difference_rows``."""
    return [
        f"{_MEASURED[key]} {name}{remark}"
        for _, name, remark, keys in _comparisons(data)
        for key in keys
    ]


def difference_rows(name: str, data: BacktestData) -> list[dict[str, str] | None]:
    """Differences to the reference, to its best rebalancing, and to the best baselines.

    None where there is nothing to compare, or nothing that says something; see ``comparable``.
    """
    entry = data.assessment.strategies[name]
    cells: list[dict[str, str] | None] = []
    for field, _, _, keys in _comparisons(data):
        difference: Difference | None = getattr(entry, field)
        for key in keys:
            if difference is None:
                cells.append(None)
                continue
            contrast = difference.contrasts()[key]
            if not comparable(key, contrast):
                cells.append(None)
                continue
            write, scale, digits = (number, 1, 2) if key == "sharpe" else (percent, 100, 1)
            value, *interval = shown(key, contrast)
            ends = (write(end, telling(scale * end, digits), sign=True) for end in interval)
            cells.append(
                {
                    "value": write(value, digits, sign=True),
                    "interval": " … ".join(ends),
                    "side": {"better": "better", "worse": "worse"}.get(contrast.finding or "", ""),
                    "mark": ""
                    if contrast.finding in (None, "none")
                    else "▲ "
                    if value > 0
                    else "▼ ",
                }
            )
    return cells


def _comparisons(data: BacktestData) -> list[tuple[str, str, str, tuple[Measured, ...]]]:
    """For each comparison: its field, the other strategy, a remark, and the measures shown."""
    test = data.assessment
    found = [("to_reference", test.reference, "", MEASURED)]
    if any(entry.to_rebalanced is not None for entry in test.strategies.values()):
        found.append(("to_rebalanced", test.rebalanced, " (best rebalancing)", MEASURED))
    of_best: tuple[Measured, ...] = ("growth",)
    if test.best_sharpe == test.best_baseline:
        of_best = ("growth", "sharpe")
    if test.best_baseline != test.reference:
        remark = f" ({best_word(test.best_baseline, data)})"
        found.append(("to_best_baseline", test.best_baseline, remark, of_best))
    if test.best_sharpe not in (test.reference, test.best_baseline):
        remark = " (highest Sharpe ratio)"
        found.append(("to_best_sharpe", test.best_sharpe, remark, ("sharpe",)))
    return found


def rebalancing_rows(data: BacktestData) -> list[dict[str, Any]]:
    """The reference at each rebalancing frequency, if others than its own were replayed."""
    test = data.assessment
    names = [name for name, entry in test.strategies.items() if entry.kind == "rebalancing"]
    keys = ("growth", "volatility", "sharpe", "turnover", "cost_drag")
    return [
        {
            "name": name,
            "best": name == test.rebalanced,
            "cells": [_written(key, test.strategies[name].measures[key].mean) for key in keys],
        }
        for name in (test.reference, *names)
        if names
    ]


def cost_kinds(data: BacktestData) -> list[str]:
    """The kinds of costs, if there are several."""
    kinds = list(dict.fromkeys(kind for s in data.strategies.values() for kind in s.costs))
    return kinds if len(kinds) > 1 else []


def cost_rows(names: list[str], data: BacktestData) -> list[tuple[str, list[str]]]:
    """Costs per year of each strategy by kind, and their sum; income is negative."""
    rows, kinds = [], cost_kinds(data)
    for name in names:
        costs = data.strategies[name].costs
        values = [costs.get(kind, math.nan) for kind in kinds] + [sum(costs.values())]
        shown = values if costs else [math.nan] * len(values)
        rows.append((name, ["–" if math.isnan(x) else percent(x, 2) for x in shown]))
    return rows


def dearer_table(data: BacktestData) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Multiples of the costs as headings, and growth at each; no rows if nothing costs anything."""
    one = data.config["cost"]
    plain = one > 0 and data.config["cost_model"] == PROPORTIONAL
    headings = [basis_points(k * one) if plain else f"{k:g} ×" for k in MULTIPLES]
    year = data.assessment.periods_per_year
    rows = [
        (name, [growth_at(k, series.returns, series.cost, year) for k in MULTIPLES])
        for name in main_names(data)
        for series in (data.strategies[name],)
        if series.weighted and series.cost.any()
    ]
    return headings, [(name, list(map(percent, growth))) for name, growth in rows]


def capacity_table(data: BacktestData) -> tuple[list[str], list[tuple[str, list[str]]]] | None:
    """Amounts of capital as headings, and growth at each; None if no cost depends on capital."""
    if data.capacity is None:
        return None
    headings = [number(capital, 0) for capital in data.capacity.capitals]
    rows = data.capacity.growth.items()
    return headings, [(name, [percent(x) for x in growth]) for name, growth in rows]


def luck_rows(names: list[str], data: BacktestData) -> list[dict[str, Any]]:
    """The Sharpe ratio of each strategy beside what luck explains, as texts by column."""
    rows = []
    for name in names:
        entry = data.assessment.strategies[name]
        test = entry.sharpe_test
        active = entry.active_test
        # Probabilities are rounded down: 94.96 must not read as 95.0.
        certain, deflated, skilled = (
            percent(math.floor(1000 * p) / 1000) if math.isfinite(p) else "–"
            for p in (test.probabilistic, test.deflated, active.deflated if active else math.nan)
        )
        rows.append(
            {
                "name": name,
                "sentence": luck(name, data.assessment)
                if entry.kind in JUDGED and not wiped_out(entry)
                else None,
                "sharpe": number(entry.measures["sharpe"].mean, 2),
                "certain": certain,
                "threshold": number(test.threshold, 2),
                "deflated": deflated,
                "information": number(active.ratio, 2) if active else "–",
                "skilled": skilled,
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
        return number(100 * value), shade(value / scale)

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
    keys = ("train_first", "train_last", "test_first", "test_last")
    days = np.array([[fold[key] for key in keys] for fold in folds], dtype="datetime64[s]")
    days = days.astype(float)
    places = 100 * (days - days.min()) / max(np.ptp(days), 1)
    return [
        {**fold, "train": (a, b - a), "test": (c, d - c)}
        for fold, (a, b, c, d) in zip(folds, places.round(2).tolist(), strict=True)
    ]
