"""Almgren & Chriss (2000): selling a position over a horizon when trades move the price."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from qfolio.solvers.shared import require


class Liquidation(NamedTuple):
    """The best schedule of a sale, and what it is expected to cost."""

    positions: Float[np.ndarray, " time"]
    """Shares held at each of the steps + 1 times; the last is 0."""
    kappa: float
    """κ, the speed of the sale per unit of time; without a horizon, 1/κ is the time in which the
    position falls by a factor of e."""
    cost: float
    """Expected implementation shortfall in money, without the spread."""
    variance: float
    """Variance of the implementation shortfall, in money squared."""


def almgren_chriss(
    shares: float,
    volatility: float,
    temporary: float,
    permanent: float,
    risk_aversion: float,
    duration: float,
    steps: int,
) -> Liquidation:
    """The best way to sell a position, for an investor who weighs expected cost against variance.

    Within each of the steps, of length τ = T/N, n shares are sold at n/τ a unit of time. This
    lowers their own price by η n/τ and all later ones by γ n; besides, the price is a random walk
    of volatility σ. The sale that minimizes E + λV is

        x_j = X sinh κ(T − jτ) / sinh κT,   2 (cosh κτ − 1) = κ̃²τ²,   κ̃² = λσ² / (η − γτ/2),

    with E = γX²/2 + (η − γτ/2)/τ Σ n² and V = σ²τ Σ x². At λ = 0 it is a straight line.

    Source: R. Almgren and N. Chriss, "Optimal Execution of Portfolio Transactions" (2000),
    equations 5, 8, 9, 16, 17. The cost of their spread is the same for all schedules and left out.

    Args:
        shares: X, the position at the start, in shares.
        volatility: σ ≥ 0, in money per share, over one unit of time.
        temporary: η, in money per share, for each share sold per unit of time.
        permanent: γ ≥ 0, in money per share, for each share sold; γτ/2 must be below η.
        risk_aversion: λ ≥ 0, per unit of money.
        duration: T > 0, in units of time.
        steps: N ≥ 1, the number of trades.

    Raises:
        QfolioError: A parameter is out of range.
    """
    numbers = (shares, volatility, temporary, permanent, risk_aversion, duration)
    require(all(map(math.isfinite, numbers)), "the parameters must be finite numbers")
    require(
        min(volatility, permanent, risk_aversion) >= 0,
        "volatility, permanent impact and risk aversion must not be negative",
    )
    require(duration > 0 and steps >= 1, "duration must be positive, and steps at least 1")
    tau = duration / steps
    net = temporary - permanent * tau / 2
    require(
        net > 0,
        f"temporary impact is {temporary:.3g}; it must be above half a step's permanent impact, "
        f"{permanent * tau / 2:.3g}, or the sale has no best speed",
    )
    # 2 (cosh κτ − 1) = 4 sinh² (κτ/2)
    kappa = 2 / tau * math.asinh(math.sqrt(risk_aversion * volatility**2 / net) * tau / 2)
    left = duration - tau * np.arange(steps + 1)
    positions = shares * sinh_ratio(kappa, left, duration)
    sold = -np.diff(positions)
    cost = permanent * shares**2 / 2 + net / tau * float(sold @ sold)
    variance = volatility**2 * tau * float(positions[1:] @ positions[1:])
    return Liquidation(positions, kappa, cost, variance)


def sinh_ratio(
    kappa: float, left: Float[np.ndarray, " time"], whole: Float[np.ndarray, " time"] | float
) -> Float[np.ndarray, " time"]:
    """sinh(κ left) / sinh(κ whole), without overflow; left / whole at κ = 0."""
    if kappa == 0:
        return np.asarray(left / whole)
    falling = np.expm1(-2 * kappa * np.asarray(left)) / np.expm1(-2 * kappa * np.asarray(whole))
    return np.asarray(np.exp(-kappa * (whole - left)) * falling)
