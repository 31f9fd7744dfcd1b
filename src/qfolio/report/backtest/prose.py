"""What the page says: verdicts, key figures and tables, as text."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from qfolio.portfolio.backtest.assessment import Difference
from qfolio.portfolio.backtest.measures import monthly
from qfolio.report.rendering import THIN_SPACE, number, percent

if TYPE_CHECKING:
    pass

from qfolio.report.backtest.data import BacktestData

_Year = tuple[int, list[tuple[str, str]]]
_PERCENT = ("growth", "volatility", "drawdown", "cost_drag")
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


# What is said --------------------------------------------------------------------------------


def verdict_rows(names: list[str], data: BacktestData) -> dict[str, Any]:
    """Return each agent's sentences, and where on a common axis (in %) its intervals lie."""
    test = data.assessment
    agents: list[tuple[str, list[Difference]]] = []
    for name in names:
        entry = test.strategies[name]
        if entry.kind == "agent":
            pair = (entry.to_reference, entry.to_best_baseline)
            kept = {each.reference: each for each in pair if each is not None}
            agents.append((name, list(kept.values())))
    ends = [
        end
        for _, differences in agents
        for each in differences
        for end in (each.growth, *each.growth_interval)
        if math.isfinite(end)
    ]
    low, high = min(ends, default=0.0), max(ends, default=0.0)
    ticks = _ticks(min(low, 0), max(high, 0))
    low, high = min(low, ticks[0]), max(high, ticks[-1])
    margin = 0.04 * (high - low) or 1.0  # any, where there is nothing to show

    def place(value: float) -> float:
        share = (value - low + margin) / (high - low + 2 * margin)
        return round(100 * min(max(share, 0.0), 1.0), 2)

    def row(each: Difference) -> dict[str, Any]:
        finding, middle, numbers = each.verdict.rpartition(": the difference in ")
        left, right = (place(end) for end in each.growth_interval)
        known = not any(map(math.isnan, (each.growth, *each.growth_interval)))
        return {
            "finding": finding,
            "numbers": middle.removeprefix(":") + numbers,
            "span": (left, round(right - left, 2), place(each.growth)) if known else None,
            "label": f"{percent(each.growth, sign=True)}, 95 % interval "
            + " to ".join(percent(end, sign=True) for end in each.growth_interval),
        }

    return {
        "agents": [(name, [row(each) for each in differences]) for name, differences in agents],
        "ticks": [(percent(tick, _digits(ticks), sign=True), place(tick)) for tick in ticks],
        "zero": place(0),
    }


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers around an interval that contains zero, at most six."""
    width = max(high - low, 1e-4)
    power = 10 ** math.floor(math.log10(width))
    step = next(k * power for k in (0.2, 0.5, 1, 2, 5, 10) if width / (k * power) <= 4)
    return [k * step for k in range(math.ceil(low / step - 0.5), math.floor(high / step + 0.5) + 1)]


def _digits(ticks: list[float]) -> int:
    """How many decimals tell these fractions apart as percentages."""
    return next(
        (d for d in range(5) if all(abs(100 * t - round(100 * t, d)) < 1e-9 for t in ticks)), 5
    )


def key_facts(data: BacktestData) -> list[tuple[str, str, str]]:
    """Return the key figures of the test: name, value and a remark."""
    test, settings, unit = data.assessment, data.config, unit_of(data.assessment.periods_per_year)
    agents = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    facts = [
        (
            "Tested over",
            f"{number(test.periods / test.periods_per_year)} years",
            f"{test.first_date[:4]} to {test.last_date[:4]}",
        ),
        ("Assets", number(len(data.assets), 0), "and cash, long only"),
    ]
    if "cost" in settings:
        facts.append(("Cost", _basis_points(settings["cost"]), "of the value traded"))
    if "lag" in settings:
        facts.append(("Lag", _counted(settings["lag"], unit), "decision to trade"))
    if data.folds:
        remark = "walk-forward"
        if "train" in settings and "test" in settings:
            remark = f"train {settings['train']}, test {settings['test']}"
        facts.append(("Folds", str(len(data.folds)), remark))
    facts.append(("Trials", str(test.trials), _seeds(agents)))
    return facts


def _counted(count: int, noun: str) -> str:
    return f"{number(count, 0)} {noun}{'' if count == 1 else 's'}"


def unit_of(periods_per_year: float) -> str:
    """What a period is called."""
    known = {"day": (240, 370), "week": (48, 54), "month": (11, 13)}
    fitting = (name for name, (low, high) in known.items() if low <= periods_per_year <= high)
    return next(fitting, "period")


def _seeds(agents: list[int]) -> str:
    """For each agent its number of seeds, in words."""
    if len(set(agents)) == 1:
        return f"{_counted(len(agents), 'agent')} × {_counted(agents[0], 'seed')}"
    return f"{_counted(len(agents), 'agent')}, {_counted(sum(agents), 'seed')} in all"


def _basis_points(fraction: float) -> str:
    return f"{1e4 * fraction:.6g}{THIN_SPACE}bp"


def account(data: BacktestData) -> dict[str, Any]:
    """Return what the account of the test needs to know; None for what the settings do not say."""
    test, settings = data.assessment, data.config
    seeds = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    return {
        "cost": _basis_points(settings["cost"]) if "cost" in settings else None,
        **{key: settings.get(key) for key in ("lag", "train", "test", "expanding", "cap")},
        "seeds": _seeds(seeds),
        "beside": test.trials - sum(seeds),
    }


def latest_values(lines: dict[str, Any]) -> dict[str, str]:
    """The values at the end, which the legends show until a pointer asks for others."""
    wealth = lines["wealth"][-1] or 0
    return {
        "wealth": number(wealth, 0 if wealth >= 100 else 1 if wealth >= 10 else 2),
        **{key: percent(lines[key][-1]) for key in ("drawdown", "cost", "turnover")},
    }


def statistics_rows(name: str, data: BacktestData) -> list[dict[str, str]]:
    entry = data.assessment.strategies[name]

    def written(key: str, value: float) -> str:
        return percent(value) if key in _PERCENT else number(value, 1 if key == "turnover" else 2)

    return [
        {
            "value": written(key, measure.mean),
            "time": " … ".join(written(key, end) for end in measure.over_time),
            "seeds": " … ".join(written(key, end) for end in measure.over_seeds or ()),
        }
        for key, measure in ((key, entry.measures[key]) for key in HEADINGS)
    ]


def difference_rows(name: str, data: BacktestData) -> list[dict[str, str] | None]:
    """Growth and Sharpe ratio less those of the reference, and of the best baseline."""
    entry = data.assessment.strategies[name]
    cells: list[dict[str, str] | None] = []
    for each in (entry.to_reference, entry.to_best_baseline):
        if each is None:
            cells += [None, None]
            continue
        for value, (low, high), write, scale, digits in (
            (each.growth, each.growth_interval, percent, 100, 1),
            (each.sharpe, each.sharpe_interval, number, 1, 2),
        ):
            ends = (write(end, _telling(scale * end, digits), sign=True) for end in (low, high))
            cells.append(
                {
                    "value": write(value, digits, sign=True),
                    "interval": " … ".join(ends),
                    "side": "higher" if low > 0 else "lower" if high < 0 else "",
                }
            )
    return cells


def _telling(value: float, digits: int) -> int:
    """How many decimals it takes, if more than usual, until a small number does not look like 0."""
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
                "agent": entry.kind == "agent",
                "sentence": test.sentence,
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
    """Return for each strategy its returns by month, the mean over the seeds, with shades."""
    tables = []
    for name in names:
        years, table = monthly(data.strategies[name].returns, data.dates)
        empty = np.isnan(table).all(axis=-1, keepdims=True)
        whole = np.where(empty, np.nan, np.nanprod(1 + table, axis=-1, keepdims=True) - 1)
        tables.append((years, np.concatenate([table, whole], axis=-1).mean(axis=0)))
    sizes = np.abs([table[:, :12] for _, table in tables])
    scale = float(np.nanquantile(sizes, 0.95)) or 1.0  # of all, so that shades can be compared

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
    """Return the folds with the places of their stretches on the whole span, in %."""
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
