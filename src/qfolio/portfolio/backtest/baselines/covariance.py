"""Estimates of a covariance matrix from returns of shape (rows, assets)."""

import numpy as np

from qfolio.core.arrays import Floats


def ledoit_wolf(returns: Floats) -> Floats:
    """Linear shrinkage towards a multiple of the identity matrix.

    O. Ledoit and M. Wolf, "A Well-Conditioned Estimator for Large-Dimensional Covariance Matrices"
    (2004): (1 − δ) S + δ m I, where m is the mean variance, d² = ‖S − m I‖²/N, and δ =
    min(Σ‖xₜxₜ' − S‖² / (N T²), d²) / d².
    """
    rows, assets = returns.shape
    centered = returns - returns.mean(axis=0)
    sample = centered.T @ centered / rows
    mean = np.trace(sample) / assets
    spread = ((sample - mean * np.eye(assets)) ** 2).sum()
    # Σ‖xx' − S‖² = Σ‖x‖⁴ − T‖S‖²
    noise = (((centered**2).sum(axis=1) ** 2).sum() - rows * (sample**2).sum()) / rows**2
    intensity = min(noise / spread, 1.0) if spread > 0 else 1.0
    return np.asarray((1 - intensity) * sample + intensity * mean * np.eye(assets))


def nonlinear(returns: Floats) -> Floats:
    """Analytical nonlinear shrinkage: each eigenvalue is corrected by those around it.

    O. Ledoit and M. Wolf, "Analytical Nonlinear Shrinkage of Large-Dimensional Covariance Matrices"
    (2020), section 4.7, for N ≤ T and for N > T: the density f of the eigenvalues and its Hilbert
    transform H are estimated with Epanechnikov's kernel of bandwidth T^(−1/3) λ.
    """
    rows, assets = len(returns) - 1, returns.shape[1]  # a row less, for the mean
    centered = returns - returns.mean(axis=0)
    if assets <= rows:
        eigenvalues, vectors = np.linalg.eigh(centered.T @ centered / rows)
    else:  # without the eigenvalues that are 0, which would take most of the time for many assets
        vectors, singular, _ = np.linalg.svd(centered.T, full_matrices=False)
        eigenvalues, vectors = singular[rows - 1 :: -1] ** 2 / rows, vectors[:, rows - 1 :: -1]
    kept = np.maximum(eigenvalues, 1e-12 * eigenvalues[-1])
    width = rows ** (-1 / 3)
    scale = width * kept  # of each eigenvalue's kernel
    x = (kept[:, None] - kept) / scale
    root = np.sqrt(5)
    density = (3 / (4 * root) * np.maximum(1 - x**2 / 5, 0) / scale).mean(axis=1)
    hilbert = (_hilbert(x) / scale).mean(axis=1)
    ratio = assets / rows
    if assets <= rows:
        real = 1 - ratio - np.pi * ratio * kept * hilbert
        shrunk = kept / ((np.pi * ratio * kept * density) ** 2 + real**2)
        return np.asarray((vectors * shrunk) @ vectors.T)
    edge = np.log((1 + root * width) / abs(1 - root * width))
    level = 3 / 10 / width**2 + 3 / (4 * root) / width * (1 - 1 / (5 * width**2)) * edge
    none = 1 / (np.pi * (assets - rows) / rows * level / np.pi * (1 / kept).mean())
    positive = 1 / (np.pi**2 * kept * (density**2 + hilbert**2))
    return np.asarray(none * np.eye(assets) + (vectors * (positive - none)) @ vectors.T)


def _hilbert(x: Floats) -> Floats:
    """The Hilbert transform of Epanechnikov's kernel.

    Far from the kernel its terms cancel each other, all but about −1 / πx, and a series takes their
    place: eigenvalues of about as many assets as rows spread over many orders of magnitude.
    """
    root, far = np.sqrt(5), np.abs(x) > 100
    with np.errstate(divide="ignore", invalid="ignore"):
        curve = (1 - x**2 / 5) * np.log(np.abs((root - x) / (root + x)))
        square = 5 / x**2
        series = -(1 + square / 5 + 3 * square**2 / 35) / x
    curve = np.where(np.isclose(np.abs(x), root, rtol=1e-12), 0, curve)
    return np.asarray(np.where(far, series, -3 / 10 * x + 3 / (4 * root) * curve) / np.pi)


def exponential(returns: Floats, decay: float = 0.97) -> Floats:
    """Second moments, where each row counts ``decay`` times as much as the one after it.

    J.P. Morgan, "RiskMetrics: Technical Document" (1996), whose decay for a month is 0.97.
    """
    weights = decay ** np.arange(len(returns))[::-1]
    return np.asarray((returns.T * (weights / weights.sum())) @ returns)
