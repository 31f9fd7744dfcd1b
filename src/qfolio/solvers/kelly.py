"""Kelly's bet: the fraction of wealth to stake on a repeated two-point bet."""

import math

from qfolio.solvers.shared import require


def kelly(up: float, down: float, probability: float) -> tuple[float, float]:
    """The fraction of wealth to bet when a stake is multiplied by ``up`` or ``down``.

    Source: J. L. Kelly, "A New Interpretation of Information Rate" (1956). Long only: the fraction
    is clipped to [0, 1].

    Args:
        up: What a stake of 1 becomes with the given probability, above 1.
        down: What it becomes otherwise, at least 0 and below 1.
        probability: Probability of ``up``.

    Returns:
        The fraction and the expected log growth per bet.

    Raises:
        QfolioError: A parameter is out of range.
    """
    from scipy.special import xlogy

    require(0 <= down < 1 < up < math.inf, f"a bet needs 0 ≤ down < 1 < up; not {down} and {up}")
    require(0 <= probability <= 1, f"a probability must be between 0 and 1; not {probability}")
    fraction = probability / (1 - down) - (1 - probability) / (up - 1)
    fraction = min(max(fraction, 0.0), 1.0)
    win, lose = 1 + fraction * (up - 1), 1 - fraction * (1 - down)
    return fraction, float(xlogy(probability, win) + xlogy(1 - probability, lose))
