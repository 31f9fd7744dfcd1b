"""Least variance, equal risk, the highest ratio: optimality conditions, and skfolio's answers."""

import numpy as np
import pytest
from skfolio.optimization import MeanRisk, ObjectiveFunction, RiskBudgeting

from qfolio.core.errors import QfolioError
from qfolio.solvers import sifting
from qfolio.solvers.maximum_ratio import maximum_ratio
from qfolio.solvers.minimum_variance import minimum_variance
from qfolio.solvers.risk_budgeting import equal_risk


def returns(rows: int = 300, assets: int = 12) -> np.ndarray:
    rng = np.random.default_rng(0)
    scales = rng.uniform(0.005, 0.03, assets)
    common = rng.normal(size=(rows, 1)) * rng.uniform(0.5, 1.5, assets)
    return (rng.normal(size=(rows, assets)) + common) * scales


@pytest.mark.parametrize("cap", [1.0, 0.4, 0.2, 0.1, 1 / 12])
@pytest.mark.parametrize("rows", [5, 20, 300])  # of rank 4 at first
def test_least_variance_meets_its_conditions(cap: float, rows: int) -> None:
    sigma = np.cov(returns(rows).T)
    w = minimum_variance(sigma, cap)
    assert w.sum() == pytest.approx(1, abs=1e-12)
    assert w.min() >= 0
    assert w.max() <= cap + 1e-15
    # No shift of weight from an asset to another lowers the variance.
    slope = sigma @ w / sigma.trace()
    takes, gives = slope[w < cap - 1e-12], slope[w > 0]
    if takes.size:
        assert gives.max() <= takes.min() + 1e-8


@pytest.mark.parametrize("cap", [1.0, 0.2])
def test_least_variance_is_that_of_skfolio(cap: float) -> None:
    found = minimum_variance(np.cov(returns().T), cap)
    np.testing.assert_allclose(found, MeanRisk(max_weights=cap).fit(returns()).weights_, atol=1e-4)


def test_least_variance_of_uncorrelated_assets() -> None:
    found = minimum_variance(np.diag([1.0, 2.0, 4.0]) * 1e-4)
    np.testing.assert_allclose(found, np.array([4, 2, 1]) / 7, rtol=1e-9)
    np.testing.assert_allclose(minimum_variance(np.ones((2, 2))), 0.5)  # twins
    np.testing.assert_array_equal(minimum_variance([[3.0]]), [1.0])


def test_equal_risk_is_equal_and_that_of_skfolio() -> None:
    sigma = np.cov(returns().T)
    w = equal_risk(sigma)
    np.testing.assert_allclose(w * (sigma @ w), w @ sigma @ w / len(w), rtol=1e-8)
    np.testing.assert_allclose(w, RiskBudgeting().fit(returns()).weights_, atol=1e-4)
    few = np.cov(returns(5).T)  # of rank 4
    w = equal_risk(few)
    np.testing.assert_allclose(w * (few @ w), w @ few @ w / len(w), rtol=1e-6)
    np.testing.assert_allclose(equal_risk(np.diag([1.0, 4.0])), [2 / 3, 1 / 3])


def test_a_covariance_without_a_solution_is_refused() -> None:
    with pytest.raises(QfolioError, match="is the covariance positive"):
        equal_risk([[1.0, -1.0], [-1.0, 1.0]])
    for solve in (equal_risk, minimum_variance):
        with pytest.raises(QfolioError, match="must be symmetric"):
            solve([[1.0, 0.2], [0.9, 1.0]])


def ratio(weights: np.ndarray, mean: np.ndarray, sigma: np.ndarray) -> float:
    return float(mean @ weights / np.sqrt(weights @ sigma @ weights))


@pytest.mark.parametrize("cap", [1.0, 0.4, 0.2, 0.1])
def test_the_highest_ratio_is_no_lower_than_that_of_skfolio(cap: float) -> None:
    rising = returns() + 0.001
    mean, sigma = rising.mean(axis=0), np.cov(rising.T)
    w = maximum_ratio(mean, sigma, cap)
    assert w.sum() == pytest.approx(1, abs=1e-12)
    assert w.min() >= 0
    assert w.max() <= cap + 1e-15
    goal = ObjectiveFunction.MAXIMIZE_RATIO
    theirs = MeanRisk(objective_function=goal, max_weights=cap).fit(rising).weights_
    np.testing.assert_allclose(w, theirs, atol=2e-3)
    assert ratio(w, mean, sigma) >= ratio(theirs, mean, sigma) - 1e-9
    # No shift of weight from an asset to another raises the ratio.
    slope = mean / (mean @ w) - sigma @ w / (w @ sigma @ w)
    takes, gives = slope[w < cap - 1e-12], slope[w > 0]
    assert gives.min() >= takes.max() - 1e-6


@pytest.mark.parametrize("cap", [1.0, 0.02])
@pytest.mark.parametrize("rows", [100, 400])
def test_what_is_sifted_out_of_many_assets_is_the_optimum_of_all(
    cap: float, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = returns(rows, 240) + 0.001
    mean, sigma = many.mean(axis=0), np.cov(many.T)
    sizes = []
    solve = np.linalg.solve

    def counted(system: np.ndarray, right: np.ndarray) -> np.ndarray:
        sizes.append(len(system))
        return solve(system, right)

    monkeypatch.setattr(np.linalg, "solve", counted)
    least, best = minimum_variance(sigma, cap), maximum_ratio(mean, sigma, cap)
    assert max(sizes) < 240
    monkeypatch.setattr(sifting, "FIRST", 240)
    whole = minimum_variance(sigma, cap)
    assert least @ sigma @ least == pytest.approx(whole @ sigma @ whole, rel=1e-8)
    np.testing.assert_allclose(least, whole, atol=1e-4)
    np.testing.assert_allclose(best, maximum_ratio(mean, sigma, cap), atol=1e-4)
    assert max(sizes) == 240


def test_the_highest_ratio_of_uncorrelated_assets() -> None:
    found = maximum_ratio([4e-4, 4e-4, -1e-4], np.diag([1.0, 2.0, 4.0]) * 1e-4)
    np.testing.assert_allclose(found, [2 / 3, 1 / 3, 0], rtol=1e-9)
    np.testing.assert_allclose(maximum_ratio([1.0, 1.0], np.ones((2, 2))), 0.5)  # twins
    np.testing.assert_array_equal(maximum_ratio([3.0], [[2.0]]), [1.0])
    np.testing.assert_array_equal(maximum_ratio([1.0, 2.0], np.eye(2), 0.5), [0.5, 0.5])


@pytest.mark.parametrize("cap", [0.5, 0.4])
def test_assets_that_are_alike_have_a_highest_ratio(cap: float) -> None:
    """Weight can be shifted between them without any change, so that a step is not unique."""
    for seed in range(30):
        rng = np.random.default_rng(seed)
        found = rng.normal(5e-4, 0.01, (500, 5))
        found[:, 1] = found[:, 0]
        mean, sigma = found.mean(axis=0), np.cov(found.T)
        if mean.max() <= 0:
            continue
        w = maximum_ratio(mean, sigma, cap)
        assert w.sum() == pytest.approx(1, abs=1e-12)
        assert w.max() <= cap + 1e-12
        slope = mean / (mean @ w) - sigma @ w / (w @ sigma @ w)
        assert slope[w > 1e-6].min() >= slope[w < cap - 1e-6].max() - 1e-3


def test_ratios_without_a_highest() -> None:
    with pytest.raises(QfolioError, match="no portfolio within the cap has a positive mean"):
        maximum_ratio([-1.0, 0.0], np.eye(2))
    with pytest.raises(QfolioError, match="no portfolio within the cap has a positive mean"):
        maximum_ratio([1.0, -1.0, -2.0], np.eye(3), 0.4)
    with pytest.raises(QfolioError, match="a portfolio may be without risk"):
        maximum_ratio([1.0, 1.0], np.array([[1.0, -1.0], [-1.0, 1.0]]))
    with pytest.raises(QfolioError, match="do not fit"):
        maximum_ratio([1.0, 1.0], np.eye(3))
    with pytest.raises(QfolioError, match="finite"):
        maximum_ratio([1.0, np.nan], np.eye(2))
    with pytest.raises(QfolioError, match="too low for 3 assets"):
        maximum_ratio([1.0, 1.0, 1.0], np.eye(3), 0.2)


def test_covariances_that_cannot_be() -> None:
    with pytest.raises(QfolioError, match=r"square table of finite numbers; this one has shape"):
        minimum_variance(np.ones((2, 3)))
    with pytest.raises(QfolioError, match=r"cap of 0\.2 is too low for 3 assets"):
        minimum_variance(np.eye(3), 0.2)
    with pytest.raises(QfolioError, match="needs some variance"):
        minimum_variance(np.zeros((2, 2)))
    with pytest.raises(QfolioError, match="every asset needs some variance"):
        equal_risk(np.diag([1.0, 0.0]))
    with pytest.raises(QfolioError, match="square table"):
        equal_risk(np.array([[np.nan]]))
