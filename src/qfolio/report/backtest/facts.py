"""The key facts of a test, with its settings, seeds and trials, in words."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from qfolio.core.settings import called
from qfolio.core.statistics import FEWEST_SEEDS
from qfolio.core.text import amount
from qfolio.portfolio.backtest.statistics.assessment import Assessment
from qfolio.portfolio.backtest.trading_terms import PROPORTIONAL
from qfolio.portfolio.calendars import PERIODS, band
from qfolio.report.backtest.data import BacktestData
from qfolio.report.rendering import THIN_SPACE, number


def key_facts(data: BacktestData) -> list[str]:
    """The test's dates, assets, costs and other key facts, in a few words each."""
    test, settings, unit = data.assessment, data.config, unit_of(data.assessment.periods_per_year)
    first, last = (np.datetime64(str(date)[:10]) for date in (test.first_date, test.last_date))
    years = number(((last - first).astype(int) + 1) / 365.25)
    return [
        str(data.prices["source"]),
        f"{test.first_date} to {test.last_date} ({years} years)",
        f"{amount(len(data.assets), 'asset')} and cash",
        *_universe(data.prices),
        _cost(settings),
        f"lag of {amount(settings['lag'], unit)}",
        amount(len(data.folds), "fold"),
        amount(test.trials, "trial"),
    ]


def _cost(settings: dict[str, Any]) -> str:
    """What a trade costs, in a few words; other cost models have parts that no rate sums up."""
    rate, (kind, _) = basis_points(settings["cost"]), called(settings["cost_model"])
    if kind == PROPORTIONAL:
        return f"{rate} of the value traded"
    costs = "itemized costs" if kind == "itemized" else f"costs of {kind}"
    return f"{rate} of commission, {costs}" if settings["cost"] else costs


def _universe(prices: dict[str, Any]) -> list[str]:
    """Which assets of a table enter or leave it, in a few words each."""
    facts = []
    if late := prices.get("late_assets"):
        facts.append(f"{number(late, 0)} joined late")
    if ended := prices.get("delisted_assets"):
        facts.append(f"{number(ended, 0)} delisted, {_haircut(prices)}")
    return [*facts, "bought only while members"] if prices.get("has_members") else facts


def universe(prices: dict[str, Any]) -> list[str]:
    """How assets enter and leave a table, in sentences; else that those that left are missing."""
    said = []
    if late := prices.get("late_assets"):
        said.append(f"{amount(late, 'asset')} joined after the first row.")
    if ended := prices.get("delisted_assets"):
        said.append(
            f"{amount(ended, 'asset')} ended before the last row, and holdings became cash at "
            f"the last price, with {_haircut(prices)}."
        )
    if prices.get("has_members"):
        said.append("An asset may be bought only while its membership lasts.")
    if not ended:
        said.append(
            "A table of assets that still trade is chosen with hindsight (survivorship): without "
            "those that stopped trading, results are probably too good."
        )
    return said


def _haircut(prices: dict[str, Any]) -> str:
    lost = prices.get("haircut") or 0.0
    return f"a haircut of {100 * lost:.4g}%" if lost else "no haircut"


def unit_of(periods_per_year: float) -> str:
    """The name of a period."""
    known = {"day": (240, 370), "week": (48, 54), "month": (11, 13)}
    fitting = (name for name, (low, high) in known.items() if low <= periods_per_year <= high)
    return next(fitting, "period")


def _counts(test: Assessment) -> str:
    """The trials of this backtest in words: agents with their seeds, and ensembles separately."""
    kinds = Counter(entry.kind for entry in test.strategies.values())
    seeds = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    if len(set(seeds)) == 1:
        text = f"{amount(len(seeds), 'agent')} × {amount(seeds[0], 'seed')}"
    else:
        text = f"{amount(len(seeds), 'agent')}, {amount(sum(seeds), 'seed')} in all"
    if kinds["ensemble"]:
        text += f", {amount(kinds['ensemble'], 'ensemble')}"
    return f"{text}, {kinds['strategy']} of your own" if kinds["strategy"] else text


def basis_points(fraction: float) -> str:
    return f"{1e4 * fraction:.6g}{THIN_SPACE}bp"


def few_seeds(test: Assessment) -> bool:
    """Whether agents have several seeds, but too few for intervals over seeds."""
    seeds = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    return 1 < max(seeds, default=1) < FEWEST_SEEDS


def account(data: BacktestData) -> dict[str, Any]:
    """Return the settings that describe the test; a model only if the costs need its name."""
    test, settings = data.assessment, data.config
    return {
        "cost": basis_points(settings["cost"]),
        **{key: settings[key] for key in ("lag", "train", "test", "expanding", "cap")},
        "mandate": "; ".join(_limits(settings["mandate"] or {})),
        "model": None if settings["cost_model"] == PROPORTIONAL else settings["cost_model"],
        "calendar": _calendar(settings["calendar"], unit_of(test.periods_per_year)),
        "long_only": _long_only(data),
        "universe": " ".join(universe(data.prices)),
        "trials": _counts(test),
        "earlier": test.earlier_trials,
    }


def _long_only(data: BacktestData) -> bool:
    """Whether nobody may, and nobody does, sell short or borrow."""
    mandate = data.config["mandate"] or {}
    floor = mandate.get("assets", {}).get("floor")
    floors = list(floor.values()) if isinstance(floor, dict) else [floor]
    least = [*floors, mandate.get("cash", {}).get("min")]
    held = [series.weights for series in data.strategies.values() if series.weighted]
    return all((each or 0) >= 0 for each in least) and all(w.min() > -1e-6 for w in held)


def _calendar(calendar: str, unit: str) -> str:
    """When strategies decide, in a sentence; empty if they do so on every row."""
    if not calendar or PERIODS.get(calendar) == unit:
        return ""
    if width := band(calendar):
        return (
            f"Agents and baselines decide on every {unit}, but trade only if a weight wanted, that "
            f"of cash included, is more than {100 * width:.4g}% of the wealth from the weight "
            "held; otherwise, holdings drift."
        )
    if calendar.isdecimal():
        when = f"once in {amount(int(calendar), unit)}, counted from the table’s first row"
    else:
        when = f"on the first {unit} of each {PERIODS[calendar]}"
    return (
        f"Agents and baselines decide on the first {unit} of the test and, after it, {when}; "
        "between, holdings drift."
    )


_TERMS = ("benchmark", "costs", "trading.calendar")
"""Entries of a mandate that are no limits; the page says elsewhere what holds of them."""


def _limits(mandate: dict[str, Any], place: str = "") -> list[str]:
    """A mandate's limits as its file writes them, without the assets of groups."""
    said = []
    for key, value in mandate.items():
        if f"{place}{key}" in _TERMS:
            continue
        if isinstance(value, dict):
            said += _limits(value, f"{place}{key}.")
        elif not (place.startswith("groups.") and key == "assets"):
            values = value if isinstance(value, list | tuple) else [value]
            shown = (each if isinstance(each, str) else f"{each:g}" for each in values)
            said.append(f"{place}{key} = {', '.join(shown)}")
    return said
