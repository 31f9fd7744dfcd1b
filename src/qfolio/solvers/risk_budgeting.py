"""The long-only portfolio whose assets contribute equally to its variance."""

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats
from qfolio.solvers.shared import require, solve, square


def equal_risk(covariance: ArrayLike) -> Floats:
    """The weights w > 0 with w_i (Σw)_i equal for all i (risk parity).

    They minimize ½ w'Σw − Σ ln(w_i)/N up to a factor. The function is strictly convex, so Newton's
    method with damped steps finds them (F. Spinu, "An Algorithm for Computing Risk Parity Weights",
    2013).

    Args:
        covariance: Σ, shape (asset, asset), positive semidefinite with positive variances.

    Returns:
        Weights of shape (asset,), which sum to 1.

    Raises:
        QfolioError: The covariance is invalid, or there is no convergence.
    """
    sigma = square(covariance)
    deviations = np.sqrt(np.maximum(np.diag(sigma), 0))
    require(bool((deviations > 0).all()), "every asset needs some variance to contribute to risk")
    # In units of each asset's deviation the problem is one in correlations.
    correlations, count = sigma / np.outer(deviations, deviations), len(sigma)
    y = (
        np.full(count, 1 / np.sqrt(correlations.sum()))
        if correlations.sum() > 0
        else np.ones(count)
    )
    for _ in range(200):
        slope = correlations @ y - 1 / (count * y)
        if np.max(np.abs(slope * y)) * count <= 1e-10:  # contributions relative to their mean
            break
        curvature = correlations + np.diag(1 / (count * y**2))
        step = solve(curvature, slope)
        decrement = np.sqrt(count * (step @ slope))  # in the units of a self-concordant function
        y = y - step / (1 + decrement if decrement > 0.2 else 1)
    else:
        require(False, "the weights of equal risk were not found; is the covariance positive?")
    weights = y / deviations
    return np.asarray(weights / weights.sum())
