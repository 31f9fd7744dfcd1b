"""The growth that no constant weights could have exceeded: a bound, known only in hindsight."""

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.solvers.merton import growth_optimal


def constant_bound(growth: Floats, periods_per_year: float) -> float | None:
    """Return the annual growth of the best constant weights of the assets and cash, without costs.

    T. Cover's best constant-rebalanced portfolio ("Universal Portfolios", 1991), which is known
    only after the last row. The conditions E[x_i/(b·x)] ≤ 1 certify it (``solvers/merton.py``).

    Args:
        growth: Growth factors of cash and each asset, of shape (days, N + 1).
        periods_per_year: Rows in a year.

    Returns:
        The growth as a simple annual rate, infinite if it is beyond all floats; None if the solver
        did not reach its tolerance.
    """
    try:
        best = growth_optimal(growth)
    except QfolioError:
        return None
    with np.errstate(over="ignore"):  # a short test of many rows a year may be too good
        return float(np.expm1(periods_per_year * best.growth))
