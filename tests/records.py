"""Made-up track records of strategies, for tests of a backtest's statistics."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qfolio.portfolio.backtest.statistics.assessment import Assessment, Strategy, assess


def strategy(
    rng: np.random.Generator, kind: str = "agent", seeds: int = 3, count: int = 300
) -> Strategy:
    return Strategy(
        kind,
        0.0005 + 0.01 * rng.standard_normal((seeds, count)),
        rng.random((seeds, count)) / 10,
        rng.random((seeds, count)) / 1000,
    )


def record(entry: Strategy) -> tuple[ArrayLike, ArrayLike, ArrayLike]:
    """Returns, turnover and cost of a strategy of which they are known."""
    assert entry.turnover is not None
    assert entry.cost is not None
    return entry.returns, entry.turnover, entry.cost


def assessed(strategies: Mapping[str, Any], dates: ArrayLike, **options: Any) -> Assessment:
    """The statistics of daily records beside those of equal weight; options: of ``assess``."""
    return assess(
        strategies, dates, **{"periods_per_year": 252, "reference": "equal weight", **options}
    )
