"""What no constant weights could have exceeded: a bound, which nobody could have followed."""

import math

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.measures import Floats
from qfolio.solvers.merton import growth_optimal


def constant_bound(values: Floats, first: int, periods_per_year: float) -> float | None:
    """Return the annual growth of the best constant weights of the assets and cash, without costs.

    T. Cover's best constant-rebalanced portfolio ("Universal Portfolios", 1991), which is known
    only after the last row. The conditions E[x_i/(b·x)] ≤ 1 certify it (``solvers/merton.py``).

    Args:
        values: Prices of shape (rows, N), NaN before an asset's first price.
        first: The row of the first return.
        periods_per_year: Rows in a year.

    Returns:
        The growth as a simple annual rate; None if the solver did not reach its tolerance.
    """
    relatives = values[first:] / values[first - 1 : -1]
    with_cash = np.column_stack([np.ones(len(relatives)), relatives])
    try:
        # An asset without a price is worth as much as cash.
        best = growth_optimal(np.where(np.isnan(with_cash), 1.0, with_cash))
    except QfolioError:
        return None
    return math.expm1(periods_per_year * best.growth)
