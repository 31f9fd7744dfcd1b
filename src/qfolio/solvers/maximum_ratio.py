"""The long-only portfolio of the highest ratio of mean to deviation, with a cap on each weight."""

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats
from qfolio.solvers.shared import at_bounds, require, solve, step_length
from qfolio.solvers.sifting import sift


def maximum_ratio(mean: ArrayLike, covariance: ArrayLike, cap: float = 1.0) -> Floats:
    """The weights w that maximize μ'w/√(w'Σw) with 1'w = 1 and 0 ≤ w ≤ cap.

    The ratio does not depend on the scale of w, so that w = y/(1'y), where y minimizes
    ½ y'Σy − μ'y with 0 ≤ y ≤ cap 1'y (cf. G. Cornuéjols and R. Tütüncü, "Optimization Methods in
    Finance", 2006, section 8.2). A primal-dual interior-point method (Wright 1997, chapter 5)
    finds y, with multipliers z of y ≥ 0 and v of cap 1'y − y ≥ 0. Each iteration solves one linear
    system. Among many assets, sifting finds those that are held.

    Args:
        mean: μ, shape (asset,).
        covariance: Σ, shape (asset, asset), positive semidefinite.
        cap: Largest weight, at least 1/assets.

    Returns:
        Weights of shape (asset,); those that are zero or at the cap are so exactly.

    Raises:
        QfolioError: The arguments are invalid, no portfolio has a positive mean, the cap is too
            low, or there is no convergence, for example if a portfolio has no risk.
    """
    mu, sigma = np.asarray(mean, dtype=float), np.asarray(covariance, dtype=float)
    count = len(mu)
    require(
        mu.ndim == 1 and sigma.shape == (count, count),
        f"means of shape {mu.shape} do not fit a covariance of shape {sigma.shape}",
    )
    require(
        bool(np.isfinite(mu).all() and np.isfinite(sigma).all()),
        "means and covariances must be finite numbers",
    )
    scale = float(np.trace(sigma)) / count
    require(scale > 0, "a covariance needs some variance, else no ratio is the highest")
    require(cap * count >= 1 - 1e-12, f"a cap of {cap:g} is too low for {count} assets")
    filled = np.diff(np.minimum(cap * np.arange(count + 1), 1))  # of the best assets, in order
    require(float(filled @ -np.sort(-mu)) > 0, "no portfolio within the cap has a positive mean")
    if cap * count <= 1 + 1e-9 or count == 1:
        return np.full(count, 1 / count)
    mu, sigma = mu / mu.max(), sigma / scale
    return sift(
        -mu,
        cap,
        lambda some: _interior_point(mu[some], sigma[np.ix_(some, some)], cap),
        lambda w: sigma @ w / (w @ sigma @ w) - mu / (mu @ w),
        tol=1e-7,
    )


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # steps that are not finite end it
def _interior_point(mu: Floats, sigma: Floats, cap: float) -> Floats:
    """The weights of means of at most 1 and a mean variance of about 1; 1/assets < cap."""
    count = len(mu)
    capped, diagonal = cap < 1, np.diag_indices(count)

    def room(y: Floats) -> Floats:
        """The distance from the cap, and as a matrix its own transpose; free without a cap."""
        return cap * y.sum() - y if capped else np.zeros(count)

    y = np.full(count, max(mu.mean(), 0.1) * count / max(sigma.sum(), 1.0))
    z, v = np.ones(count), np.full(count, 1.0 if capped else 0.0)
    solved = False
    for _ in range(100):
        s = room(y) if capped else np.ones(count)
        slope = sigma @ y - mu
        size = float(mu @ y)
        gap = float(y @ z + s @ v)
        off = float(np.abs(slope - z - room(v)).max())
        solved = gap <= 1e-10 * abs(size) and off <= 1e-10
        if solved:
            break
        target = 0.1 * gap / (count * (1 + capped))
        pushed = target / s if capped else v
        system = sigma.copy()
        system[diagonal] += z / y
        if capped:
            ratio = v / s
            system += cap * (cap * ratio.sum() - ratio[:, None] - ratio)
            system[diagonal] += ratio
        right = target / y + room(pushed) - slope
        step = solve(system, right)
        if not np.isfinite(step).all() and np.isfinite(system).all():
            step = np.linalg.lstsq(system, right, rcond=None)[0]  # not unique if assets are alike
        step_s = room(step)
        if not np.isfinite(step).all():
            break
        step_z = target / y - z - z / y * step
        step_v = pushed - v - v / s * step_s
        length = step_length((y, step), (s, step_s), (z, step_z), (v, step_v))
        y, z, v = y + length * step, z + length * step_z, v + length * step_v
    require(
        solved, "the weights of the highest ratio were not found; a portfolio may be without risk"
    )
    return at_bounds(y / y.sum(), empty=y < z, full=room(y) < v, cap=cap)
