"""Capacity: how growth changes with the capital, if costs depend on it."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from qfolio.portfolio.backtest.replay import Entry, Replay
from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.portfolio.itemized import Itemized

SCALES = (0.1, 1.0, 10.0, 100.0)
"""Multiples of the capital."""


class Capacity(NamedTuple):
    """Net growth by capital.

    capitals: in money. growth: annual, the mean over the seeds, by strategy.
    """

    capitals: tuple[float, ...]
    growth: dict[str, tuple[float, ...]]


def capacity(replay: Replay, entries: Mapping[str, Entry], reference: str) -> Capacity | None:
    """Net growth of the same orders with other capitals, for judged strategies and the reference.

    Policies are not trained again: one that was trained for a small account trades too much for a
    large one. None if no cost depends on the capital.

    Args:
        replay: The rules of the backtest.
        entries: Its strategies.
        reference: The name of the strategy that they are compared with.
    """
    costs = replay.task.costs
    if not isinstance(costs, Itemized) or not costs.depends_on_wealth:
        return None
    models = [dataclasses.replace(costs, capital=scale * costs.capital) for scale in SCALES]
    shown = {
        name: entry
        for name, entry in entries.items()
        if entry.weighted and (entry.kind in JUDGED or name == reference)
    }
    year = replay.prices.periods_per_year

    def growth(entry: Entry, model: Itemized) -> float:
        paid = entry if model == costs else replay.entry(entry.kind, entry.decisions, model)
        return float(np.expm1(year * paid.simulation.growth.mean(-1)).mean())

    return Capacity(
        tuple(model.capital for model in models),
        {name: tuple(growth(entry, m) for m in models) for name, entry in shown.items()},
    )
