"""On random walks nothing can be learned: how often a verdict says otherwise."""

import numpy as np
import pytest

from qfolio.portfolio.backtest.baselines import Baseline
from qfolio.portfolio.backtest.baselines.equal_weight import (
    SPEEDS,
    BuyAndHold,
    EqualWeight,
    EqualWeightAt,
)
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.orders import orders
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.backtest.statistics.assessment import Assessment, Strategy, assess

from tables import days

ASSETS, ROWS, YEAR = 6, 757, 252
FOLD = Fold("0", slice(0, 1), slice(0, ROWS - 2), slice(0, 1))


def world(rng: np.random.Generator, cost: float = 0.005) -> Assessment:
    """Three years of six equal random walks, and two agents that tilt at random every month."""
    common, own = rng.standard_normal((ROWS, 1)), rng.standard_normal((ROWS, ASSETS))
    values = np.exp((3e-4 + 0.008 * common + 0.015 * own).cumsum(axis=0))

    def strategy(kind: str, decisions: np.ndarray) -> Strategy:
        found = simulate(values, decisions, first=0, cost=cost, lag=1)
        return Strategy(kind, found.returns, found.turnover, found.cost)

    def replayed(kind: str, made: Baseline) -> Strategy:
        return strategy(kind, orders("own", made, [FOLD], days(ROWS), values).decisions[None])

    def tilted(size: float) -> np.ndarray:
        decisions = np.full((1, ROWS - 2, ASSETS + 1), np.nan)
        weights = np.exp(size * rng.standard_normal((len(range(0, ROWS - 2, 21)), ASSETS)))
        decisions[0, ::21, 0] = 0
        decisions[0, ::21, 1:] = weights / weights.sum(axis=1, keepdims=True)
        return decisions

    return assess(
        {
            "equal weight": replayed("baseline", EqualWeight()),
            "hold": replayed("baseline", BuyAndHold()),
            **{f"at {speed}": replayed("rebalancing", EqualWeightAt(speed)) for speed in SPEEDS},
            "faint": strategy("agent", tilted(0.01)),
            "bold": strategy("agent", tilted(0.3)),
        },
        days(ROWS - 2),
        periods_per_year=YEAR,
        reference="equal weight",
        resamples=1,
    )


def rates(worlds: int, seed: int = 0) -> dict[str, float]:
    """Shares of worlds in which a verdict claims something of an agent."""
    rng = np.random.default_rng(seed)
    claims = dict.fromkeys(("beats any speed", "beats every row", "beats best"), 0)
    claims |= dict.fromkeys(("less than best speed, faint", "grows less than best"), 0)
    for _ in range(worlds):
        found = world(rng).strategies
        agents = [found[name] for name in ("faint", "bold")]
        for name, field in (
            ("beats any speed", "to_rebalanced"),
            ("beats every row", "to_reference"),
            ("beats best", "to_best_baseline"),
        ):
            differences = [getattr(agent, field) for agent in agents]
            claims[name] += any(
                {"growth", "sharpe"} & set(difference.found("better"))
                for difference in differences
                if difference is not None
            )
        faint = found["faint"].to_rebalanced
        assert faint is not None
        claims["less than best speed, faint"] += faint.growth.finding == "worse"
        best = found["faint"].to_best_baseline
        claims["grows less than best"] += best is not None and best.growth.finding == "worse"
    return {name: count / worlds for name, count in claims.items()}


@pytest.mark.slow
def test_noise_is_no_evidence() -> None:
    found = rates(60)
    assert found["beats any speed"] <= 0.05
    assert found["beats best"] <= 0.05
    assert found["less than best speed, faint"] <= 0.05
    assert found["beats every row"] > 0.3  # by the costs that trading every month saves
