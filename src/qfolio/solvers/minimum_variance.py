"""The long-only portfolio of least variance with a cap on each weight."""

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats
from qfolio.solvers.shared import at_bounds, require, solve, square, step_length
from qfolio.solvers.sifting import sift


def minimum_variance(covariance: ArrayLike, cap: float = 1.0) -> Floats:
    """The weights w that minimize w'Σw with 1'w = 1 and 0 ≤ w ≤ cap.

    A primal-dual interior-point method (Wright 1997, chapter 5) from equal weights, with
    multipliers y of 1'w = 1, z of w ≥ 0 and v of w ≤ cap: Σw − y − z + v = 0 holds after a full
    step, and the products w z and (cap − w) v go to zero together. Each iteration solves one linear
    system. Among many assets, sifting finds those that are held.

    Args:
        covariance: Σ, shape (asset, asset), positive semidefinite.
        cap: Largest weight, at least 1/assets.

    Returns:
        Weights of shape (asset,); those that are zero or at the cap are so exactly.

    Raises:
        QfolioError: The covariance is invalid, the cap is too low, or there is no convergence.
    """
    sigma = square(covariance)
    count, scale = len(sigma), float(np.trace(sigma)) / len(sigma)
    require(scale > 0, "a covariance needs some variance, else every portfolio has the least")
    require(cap * count >= 1 - 1e-12, f"a cap of {cap:g} is too low for {count} assets")
    if cap * count <= 1 + 1e-9 or count == 1:
        return np.full(count, 1 / count)
    sigma = sigma / scale
    return sift(
        np.diag(sigma),
        cap,
        lambda some: _interior_point(sigma[np.ix_(some, some)], cap),
        lambda w: sigma @ w,
        tol=1e-9,
    )


def _interior_point(sigma: Floats, cap: float) -> Floats:
    """The weights of a covariance with a mean variance of about 1; 1/assets < cap."""
    count = len(sigma)
    w = np.full(count, 1 / count)
    z = v = np.full(count, 1.0)
    for _ in range(100):
        room = cap - w
        gap = float(w @ z + room @ v) / (2 * count)
        if gap <= 1e-12:  # in units of the mean variance
            break
        target = 0.1 * gap
        system = sigma + np.diag(z / w + v / room)
        push = target / w - target / room - sigma @ w
        moved, level = solve(system, np.stack([push, np.ones(count)], axis=1)).T
        step = moved - moved.sum() / level.sum() * level  # of sum 0
        step_z = target / w - z - z / w * step
        step_v = target / room - v + v / room * step
        length = step_length((w, step), (room, -step), (z, step_z), (v, step_v))
        w, z, v = w + length * step, z + length * step_z, v + length * step_v
    else:
        require(False, "the weights of least variance were not found; is the covariance positive?")
    # At most one of each pair is not almost zero.
    return at_bounds(w, empty=w < z, full=cap - w < v, cap=cap)
