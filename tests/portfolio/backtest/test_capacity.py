"""Growth by capital: the backtest's own at its capital, less with impact on more."""

import numpy as np
import pytest

from qfolio.portfolio.backtest.capacity import SCALES, capacity
from qfolio.portfolio.backtest.folds import walk_forward
from qfolio.portfolio.backtest.replay import Replay
from qfolio.portfolio.task import Portfolio

from planted import planted


def rules(cost_model: str) -> Replay:
    prices = planted(400)
    folds = walk_forward(prices.dates, "200d", "150d", 1)
    task = Portfolio.of(prices, window=2, horizon=20, cost_model=cost_model)
    return Replay(prices, folds, task, 1.0)


def orders(replay: Replay, seeds: int) -> np.ndarray:
    days = sum(fold.days for fold in replay.folds)
    return np.random.default_rng(0).dirichlet(np.ones(7), (seeds, days))


def test_growth_at_each_capital() -> None:
    replay = rules("itemized(impact=1, volume=1e5, capital=1e6)")
    entries = {
        "agent": replay.entry("agent", orders(replay, 2)),
        "equal-weight": replay.entry("baseline", orders(replay, 1)),
        "other": replay.entry("baseline", orders(replay, 1)),
    }
    found = capacity(replay, entries, "equal-weight")
    assert found is not None
    assert found.capitals == (1e5, 1e6, 1e7, 1e8)
    assert found.growth.keys() == {"agent", "equal-weight"}
    for name, growth in found.growth.items():
        assert sorted(growth, reverse=True) == list(growth)  # impact grows with what is traded
        logs = entries[name].simulation.growth.mean(-1)
        own = np.expm1(replay.prices.periods_per_year * logs).mean()
        assert growth[SCALES.index(1.0)] == pytest.approx(own, rel=1e-12)


def test_fees_weigh_on_small_accounts() -> None:
    replay = rules("itemized(fixed=1, capital=1e4)")
    found = capacity(replay, {"a": replay.entry("agent", orders(replay, 1))}, "none")
    assert found is not None
    assert sorted(found.growth["a"]) == list(found.growth["a"])
    assert found.growth["a"][0] == -1  # six orders a day, and 1,000 to pay them from


def test_proportional_costs_have_none() -> None:
    for model in ("proportional", "itemized(spread=0.001)"):
        replay = rules(model)
        assert capacity(replay, {"a": replay.entry("agent", orders(replay, 1))}, "none") is None
