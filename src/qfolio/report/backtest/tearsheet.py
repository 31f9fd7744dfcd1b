"""The page's tear sheet: figures, drawdowns, tails and contributions of the main strategies."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.text import amount, plural
from qfolio.portfolio.backtest.folds import spell
from qfolio.portfolio.backtest.statistics.measures import before_costs
from qfolio.portfolio.backtest.statistics.tearsheet import (
    alpha,
    contributions,
    falls,
    figures,
    leverage,
)
from qfolio.report.axis import Axis
from qfolio.report.backtest.data import BacktestData, StrategySeries
from qfolio.report.backtest.facts import unit_of
from qfolio.report.backtest.why import bars
from qfolio.report.rendering import number, percent

DRAWDOWNS = 5
"""Number of drawdowns listed."""

LISTED = 12
"""Number of assets whose contributions are listed; those of the others are added up."""

BINS = 41
"""Number of bars of a histogram; the outermost ones hold all returns beyond."""

PERIODS = {"day": "daily", "week": "weekly", "month": "monthly"}
"""Units as adjectives."""


def tear_sheet(names: list[str], data: BacktestData) -> dict[str, Any]:
    """Return the tear sheet of some strategies; means over the seeds, where there are several."""
    year, unit = data.assessment.periods_per_year, unit_of(data.assessment.periods_per_year)
    found = [_means(name, data, year) for name in names]
    edges = _edges([data.strategies[name].returns for name in names])
    reference = data.strategies[data.assessment.reference].returns
    return {
        "names": names,
        "groups": _groups(found, unit, year, data.assessment.reference),
        "every": PERIODS.get(unit, "single"),
        "each": [
            {
                "name": name,
                "several": len(data.strategies[name].returns) > 1,
                "drawdowns": _drawdowns(data.strategies[name], data),
                "histogram": _histogram(data.strategies[name].returns, reference, edges, of),
                "assets": _assets(data.strategies[name], data, year),
            }
            for name, of in zip(names, found, strict=True)
        ],
    }


def _means(name: str, data: BacktestData, year: float) -> dict[str, float]:
    """Figures of a strategy; ratios over what cash earns are those of its assessment."""
    series, test, cash = data.strategies[name], data.assessment, data.risk_free
    rival = data.strategies[test.reference]
    reference = before_costs(rival.returns, rival.cost).mean(axis=0) - cash
    each = [
        {**figures(row, data.dates, year), "alpha": alpha(row - cash, reference, year)}
        for row in series.returns
    ]
    gross, net = leverage(series.weights)
    return {
        **{key: float(np.mean([found[key] for found in each])) for key in each[0]},
        **{key: test.strategies[name].measures[key].mean for key in ("sharpe", "sortino")},
        "gross": gross,
        "net": net,
    }


def _groups(
    found: list[dict[str, float]], unit: str, per_year: float, reference: str
) -> list[tuple[str, list[Any]]]:
    """Groups of rows: a name, and a cell for each strategy.

    Figures of months and years are left out where single periods are as long.
    """
    # Without short positions, the net exposure is the gross one.
    short = any(each["gross"] - each["net"] > 1e-6 for each in found)
    every = PERIODS.get(unit, "of a period")

    def row(name: str, key: str, form: str) -> tuple[str, list[str]]:
        return name, [_written(each[key], form) for each in found]

    def rows(shown: bool, *of: tuple[str, str, str]) -> list[tuple[str, list[str]]]:
        return [row(*each) for each in of if shown]

    monthly, yearly = partial(rows, per_year > 13), partial(rows, per_year > 1)

    return [
        (
            "Return",
            [
                row("Growth a year (CAGR)", "growth", "%"),
                row("Total return", "total", "%"),
                row(f"Best {unit}", "best", "+%"),
                row(f"Worst {unit}", "worst", "+%"),
                *monthly(("Best month", "best_month", "+%"), ("Worst month", "worst_month", "+%")),
                *yearly(("Best year", "best_year", "+%"), ("Worst year", "worst_year", "+%")),
                row(f"{unit.capitalize()}s with a gain", "hit_rate", "%"),
                *monthly(("Months with a gain", "hit_rate_month", "%")),
                row(f"Longest winning streak, {unit}s", "winning", "0"),
                row(f"Longest losing streak, {unit}s", "losing", "0"),
            ],
        ),
        (
            "Risk",
            [
                row("Volatility a year", "volatility", "%"),
                row("Deepest drawdown", "drawdown", "%"),
                row("Longest drawdown, years", "longest", "1"),
                row("Time below a peak", "time_below", "%"),
                row("Ulcer index", "ulcer", "%"),
                row(f"Value at risk, 95%, {every}", "var", "%2"),
                row(f"CVaR, 95%, {every}", "cvar", "%2"),
                *monthly(
                    ("Value at risk, 95%, monthly", "var_month", "%"),
                    ("CVaR, 95%, monthly", "cvar_month", "%"),
                ),
                row("Skewness", "skewness", "2"),
                row("Kurtosis (normal: 3)", "kurtosis", "1"),
                row("Gross leverage", "gross", "2"),
                *([row("Net exposure", "net", "2")] if short else []),
            ],
        ),
        (
            "Return for the risk",
            [
                row("Sharpe ratio", "sharpe", "2"),
                row("Sortino ratio", "sortino", "2"),
                row("Calmar ratio", "calmar", "2"),
                row(f"Alpha a year, beside {reference} before costs", "alpha", "+%2"),
                row("Stability (R²)", "stability", "2"),
                row("Profit factor (omega ratio)", "omega", "2"),
                row(
                    f"Gain-to-pain ratio, {every if per_year <= 13 else 'monthly'}",
                    "gain_to_pain",
                    "2",
                ),
                row("Tail ratio", "tail_ratio", "2"),
                row("Payoff (mean gain over mean loss)", "payoff", "2"),
                row("Kelly fraction", "kelly", "2"),
            ],
        ),
    ]


def _written(value: float, form: str) -> str:
    if "%" in form:
        return percent(value, 2 if "2" in form else 1, sign="+" in form)
    return number(value, int(form))


def _drawdowns(series: StrategySeries, data: BacktestData) -> list[list[str]]:
    """The deepest drawdowns; of several seeds, those of their mean return."""
    days = data.dates

    def spelled(place: int | None) -> str:
        if place is None:
            return "not yet"
        return spell(data.trades[0] if place < 0 else days[place], days)

    unit = unit_of(data.assessment.periods_per_year)
    return [
        [
            spelled(fall.start),
            spelled(fall.trough),
            spelled(fall.end),
            percent(fall.depth),
            f"{number(fall.length, 0)} {plural(unit, fall.length)}",
        ]
        for fall in falls(series.returns.mean(axis=0), DRAWDOWNS)
    ]


def _edges(returns: list[Floats]) -> Floats:
    """The histograms' common bins, around zero."""
    sizes = np.concatenate([np.abs(table).ravel() for table in returns])
    reach = float(np.quantile(sizes, 0.99)) or 0.01
    return np.linspace(-reach, reach, BINS + 1)


def _histogram(
    returns: Floats, reference: Floats, edges: Floats, found: dict[str, float]
) -> dict[str, Any]:
    """Bars of the returns and the outline of the reference's, in percent of the highest.

    found: the figures of the strategy, among them its value at risk.
    """

    def shares(values: Floats) -> Floats:
        counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
        return np.asarray(100 * counts / values.size)

    own, other = shares(returns), shares(reference)
    highest = float(max(own.max(), other.max()))
    width = 100 / BINS
    steps = [
        f"{x:.4g},{100 - 100 * height / highest:.4g}"
        for i, height in enumerate(other.tolist())
        for x in (i * width, (i + 1) * width)
    ]
    reach = float(edges[-1])
    axis = Axis(-reach, reach)
    var, cvar = found["var"], found["cvar"]
    known = not math.isnan(var)
    return {
        "bars": [
            (round(i * width, 3), round(100 * height / highest, 2))
            for i, height in enumerate(own.tolist())
        ],
        "width": round(0.86 * width, 3),
        "outline": " ".join(steps),
        "reach": percent(reach),
        "highest": percent(highest / 100, 0),
        "marks": [(axis.at(-cvar), "CVaR"), (axis.at(-var), "VaR")] if known else [],
        "label": f"95% of the returns are above {percent(-var, 2)}; "
        f"the mean of the others is {percent(-cvar, 2)}"
        if known
        else f"{amount(returns.shape[-1], 'return')}, too few for a value at risk",
    }


def _assets(series: StrategySeries, data: BacktestData, year: float) -> list[dict[str, Any]]:
    """Contributions to the mean return per year, largest first, then the rest and the sum."""
    parts, rest = contributions(series.returns, series.weights, data.moves, year)
    order = np.argsort(-np.abs(parts), kind="stable").tolist()
    count = LISTED if len(order) > LISTED + 1 else len(order)
    rows = [(data.assets[i], float(parts[i])) for i in order[:count]]
    rows.sort(key=lambda row: -row[1])
    if others := order[count:]:
        rows.append((f"{number(len(others), 0)} others", float(parts[others].sum())))
    rows.append(("Costs and interest", rest))
    largest = max(abs(value) for _, value in rows)
    digits = 2 if largest < 0.01 else 1
    total = float(parts.sum()) + rest
    if not math.isfinite(total):
        return []
    places = bars([value for _, value in rows])
    shown = [
        {"name": name, "bar": place, "value": percent(value, digits, sign=True)}
        for (name, value), place in zip(rows, places, strict=True)
    ]
    return [*shown, {"name": "Mean return a year", "bar": None, "value": percent(total, digits)}]
