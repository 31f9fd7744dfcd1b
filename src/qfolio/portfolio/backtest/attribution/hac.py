"""Least squares with standard errors that allow for heteroskedasticity and autocorrelation.

Newey & West (1987), "A simple, positive semi-definite, heteroskedasticity and autocorrelation
consistent covariance matrix"; the number of lags is chosen from the data as for Bartlett's kernel
in Newey & West (1994), "Automatic lag selection in covariance matrix estimation". Residuals are
those of a fit without their own row, e/(1 − h) where h is the row's leverage (HC3, MacKinnon &
White 1985): with few rows and several regressors, errors are too small otherwise.
"""

import math
from typing import NamedTuple

import numpy as np

from qfolio.core.arrays import Floats

LEAST = 1e-6
"""Least distance of a leverage from 1, at which a row alone decides a coefficient."""


class Regression(NamedTuple):
    """Coefficients of an intercept and K regressors, in this order."""

    coefficients: Floats  # (K + 1,)
    errors: Floats  # standard errors, (K + 1,)
    r2: float  # 0 if there is nothing to explain
    lags: int

    @property
    def t(self) -> Floats:
        """Coefficients over their standard errors; 0 where the error is 0."""
        known = self.errors > 0
        return np.where(known, self.coefficients / np.where(known, self.errors, 1.0), 0.0)


def regress(values: Floats, regressors: Floats) -> Regression:
    """Regresses a series on an intercept and other series.

    Args:
        values: Shape (T,).
        regressors: Shape (T, K), not collinear, K + 1 < T; K may be 0.

    Returns:
        Estimates whose variances are those of Newey & West, of residuals over 1 − leverage.
    """
    count = len(values)
    design = np.concatenate([np.ones((count, 1)), regressors], axis=1)
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    residuals = values - design @ coefficients
    bread = np.linalg.inv(design.T @ design)
    leverage = np.einsum("tk,kl,tl->t", design, bread, design)
    scores = design * (residuals / np.maximum(1 - leverage, LEAST))[:, None]
    # As in the paper, the intercept does not count in the choice of lags, unless it is alone.
    lags = newey_west_lags(scores[:, 1:].sum(1) if regressors.shape[1] else scores[:, 0])
    middle = scores.T @ scores
    for lag in range(1, lags + 1):
        crossed = scores[lag:].T @ scores[:-lag]
        middle += (1 - lag / (lags + 1)) * (crossed + crossed.T)
    variance = np.diag(bread @ middle @ bread)
    total = float(((values - values.mean()) ** 2).sum())
    r2 = 1 - float((residuals**2).sum()) / total if total > 0 else 0.0
    return Regression(coefficients, np.sqrt(np.maximum(variance, 0.0)), r2, lags)


def newey_west_lags(scores: Floats) -> int:
    """The number of lags for a mean of T scores, shape (T,).

    m = ⌊1.1447 ((s₁/s₀)² T)^⅓⌋, where s₀ and s₁ sum σⱼ and |j| σⱼ over the autocovariances up to
    ⌊4 (T/100)^(2/9)⌋ lags in both directions.
    """
    count = len(scores)
    longest = min(int(4 * (count / 100) ** (2 / 9)), count - 1)
    covariances = [
        float(scores[lag:] @ scores[: count - lag]) / count for lag in range(longest + 1)
    ]
    level = covariances[0] + 2 * sum(covariances[1:])
    slope = 2 * sum(lag * each for lag, each in enumerate(covariances))
    if level == 0:
        return 0
    return min(math.floor(1.1447 * ((slope / level) ** 2 * count) ** (1 / 3)), count - 1)


def mean_t(values: Floats) -> float:
    """The t-statistic of a series' mean, shape (T,); 0 if the series is rounding errors."""
    if abs(values).max() < 1e-12:
        return 0.0
    return float(regress(values, np.empty((len(values), 0))).t[0])
