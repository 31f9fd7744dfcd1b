"""Key figures of a test, and its settings, seeds and trials in words."""

from __future__ import annotations

from collections import Counter
from typing import Any

from qfolio.core.statistics import FEWEST_SEEDS
from qfolio.portfolio.backtest.assessment import Assessment
from qfolio.report.backtest.data import BacktestData
from qfolio.report.rendering import THIN_SPACE, number


def key_facts(data: BacktestData) -> list[tuple[str, str, str]]:
    """Return the key figures of the test: name, value and a remark."""
    test, settings, unit = data.assessment, data.config, unit_of(data.assessment.periods_per_year)
    facts = [
        (
            "Tested over",
            f"{number(test.periods / test.periods_per_year)} years",
            f"{test.first_date[:4]} to {test.last_date[:4]}",
        ),
        ("Assets", number(len(data.assets), 0), "and cash, long only"),
    ]
    if "cost" in settings:
        facts.append(("Cost", _basis_points(settings["cost"]), "of each trade’s value"))
    if "lag" in settings:
        facts.append(("Lag", _counted(settings["lag"], unit), "from decision to trade"))
    if data.folds:
        remark = "walk-forward"
        if "train" in settings and "test" in settings:
            remark = f"train {settings['train']}, test {settings['test']}"
        facts.append(("Folds", str(len(data.folds)), remark))
    earlier = f", {number(test.earlier_trials, 0)} earlier" if test.earlier_trials else ""
    facts.append(("Trials", number(test.trials, 0), _counts(test) + earlier))
    return facts


def _counted(count: int, noun: str) -> str:
    return f"{number(count, 0)} {noun}{'' if count == 1 else 's'}"


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
        text = f"{_counted(len(seeds), 'agent')} × {_counted(seeds[0], 'seed')}"
    else:
        text = f"{_counted(len(seeds), 'agent')}, {_counted(sum(seeds), 'seed')} in all"
    ensembles = kinds["ensemble"]
    return f"{text}, {_counted(ensembles, 'ensemble')}" if ensembles else text


def _basis_points(fraction: float) -> str:
    return f"{1e4 * fraction:.6g}{THIN_SPACE}bp"


def few_seeds(test: Assessment) -> bool:
    """Whether agents have several seeds, but too few for intervals over seeds."""
    seeds = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    return 1 < max(seeds, default=1) < FEWEST_SEEDS


def account(data: BacktestData) -> dict[str, Any]:
    """Return the settings for the description of the test; None for those that are unknown."""
    test, settings = data.assessment, data.config
    return {
        "cost": _basis_points(settings["cost"]) if "cost" in settings else None,
        **{key: settings.get(key) for key in ("lag", "train", "test", "expanding", "cap")},
        "trials": _counts(test),
        "earlier": test.earlier_trials,
    }
