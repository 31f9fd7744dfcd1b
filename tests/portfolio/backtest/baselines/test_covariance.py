"""Estimates of the covariance, against scikit-learn, by hand, and against the truth."""

import numpy as np
import pytest
from sklearn.covariance import ledoit_wolf as reference

from qfolio.portfolio.backtest.baselines.covariance import exponential, ledoit_wolf, nonlinear


@pytest.mark.parametrize("shape", [(300, 5), (40, 30), (20, 50), (10, 1)])
def test_linear_shrinkage_is_that_of_scikit_learn(shape: tuple[int, int]) -> None:
    returns = np.random.default_rng(0).normal(size=shape) * np.linspace(1, 3, shape[1])
    np.testing.assert_allclose(ledoit_wolf(returns), reference(returns)[0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("rows", "assets"), [(60, 40), (120, 40), (250, 40), (60, 80)])
def test_nonlinear_shrinkage_is_nearer_to_the_truth(rows: int, assets: int) -> None:
    """Nearer than the sample, and, where the truth is not a ball, than linear shrinkage."""
    rng = np.random.default_rng(1)
    truth = np.concatenate([np.full(assets // 2, 1.0), np.full(assets - assets // 2, 8.0)])
    turn = np.linalg.qr(rng.normal(size=(assets, assets)))[0]
    sigma = turn * truth @ turn.T
    errors = np.zeros(3)
    for _ in range(20):
        returns = rng.normal(size=(rows, assets)) * np.sqrt(truth) @ turn.T
        found = np.cov(returns.T), ledoit_wolf(returns), nonlinear(returns)
        errors += [((each - sigma) ** 2).sum() for each in found]
        np.testing.assert_allclose(found[2], found[2].T, atol=1e-9)
        assert np.linalg.eigvalsh(found[2])[0] > 0
    assert errors[2] < errors[1] < errors[0]


@pytest.mark.parametrize("assets", [20, 240, 251, 252, 253, 600])
def test_nonlinear_shrinkage_keeps_a_common_factor(assets: int) -> None:
    """With as many assets as rows, eigenvalues spread over many orders of magnitude."""
    rng = np.random.default_rng(3)
    factor, own = rng.normal(size=(252, 1)), rng.normal(size=(252, assets))
    direction = np.full(assets, assets**-0.5)
    found = nonlinear(0.01 * (factor + own))
    sample = 1e-4 * ((factor + own) @ direction).var()
    np.testing.assert_allclose(direction @ found @ direction, sample, rtol=0.1)
    assert np.linalg.eigvalsh(found)[0] > 0


def test_nonlinear_shrinkage_of_more_assets_than_rows_equals_that_of_the_whole_spectrum() -> None:
    """Where the published formula needs all eigenvectors, the ones that are left out are alike."""
    returns = np.random.default_rng(4).normal(size=(30, 70)) * np.linspace(1, 3, 70)
    found = nonlinear(returns)
    values, vectors = np.linalg.eigh(np.cov(returns.T))
    turned = vectors.T @ found @ vectors
    np.testing.assert_allclose(turned, np.diag(np.diag(turned)), atol=1e-9)
    none = np.diag(turned)[: 70 - 29]
    np.testing.assert_allclose(none, none[0])
    assert np.diag(turned)[-1] > none[0] > values[0]


def test_nonlinear_shrinkage_vanishes_with_many_rows() -> None:
    returns = np.random.default_rng(2).normal(size=(100_000, 4)) * [1, 2, 3, 4]
    np.testing.assert_allclose(nonlinear(returns), np.cov(returns.T), rtol=2e-3, atol=2e-2)


def test_exponential_weights_by_hand() -> None:
    returns = np.array([[2.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    weights = np.array([0.25, 0.5, 1.0]) / 1.75
    expected = sum(w * np.outer(row, row) for w, row in zip(weights, returns, strict=True))
    np.testing.assert_allclose(exponential(returns, 0.5), expected)
