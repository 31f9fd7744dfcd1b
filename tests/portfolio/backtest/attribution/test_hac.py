"""Newey & West's errors, against the definitions written out."""

import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.attribution.hac import mean_t, newey_west_lags, regress


def by_hand(values, regressors, lags):
    """Coefficients and errors, term by term."""
    count = len(values)
    rows = [np.array([1.0, *row]) for row in regressors]
    bread = np.linalg.inv(sum(np.outer(row, row) for row in rows))
    coefficients = bread @ sum(row * y for row, y in zip(rows, values, strict=True))
    leverage = [row @ bread @ row for row in rows]
    scores = [
        row * (y - row @ coefficients) / (1 - h)
        for row, y, h in zip(rows, values, leverage, strict=True)
    ]
    middle = np.zeros_like(bread)
    for i in range(count):
        for j in range(count):
            weight = max(0.0, 1 - abs(i - j) / (lags + 1))
            middle += weight * np.outer(scores[i], scores[j])
    return coefficients, np.sqrt(np.diag(bread @ middle @ bread))


def series(count=300, seed=0):
    """Errors and regressors with autocorrelation."""
    rng = np.random.default_rng(seed)
    noise, x = rng.normal(size=(2, count)), np.zeros((count, 2))
    for t in range(1, count):
        noise[0, t] += 0.6 * noise[0, t - 1]
        x[t] = 0.8 * x[t - 1] + rng.normal(size=2)
    return 0.3 + x @ [1.0, -0.5] + noise[0], x


def test_estimates_are_those_of_the_definition():
    y, x = series()
    found = regress(y, x)
    assert found.lags > 1
    coefficients, errors = by_hand(y, x, found.lags)
    np.testing.assert_allclose(found.coefficients, coefficients, rtol=1e-10)
    np.testing.assert_allclose(found.errors, errors, rtol=1e-10)
    residuals = y - coefficients @ np.stack([np.ones(len(y)), *x.T])
    assert found.r2 == pytest.approx(1 - residuals.var() / y.var())


def test_statsmodels_agrees():
    statsmodels = pytest.importorskip("statsmodels.api")
    y, x = series()
    found = regress(y, x)
    options = {"maxlags": found.lags, "use_correction": True}
    other = statsmodels.OLS(y, statsmodels.add_constant(x)).fit(cov_type="HAC", cov_kwds=options)
    np.testing.assert_allclose(found.errors, other.bse, rtol=0.02)  # without leverage


def test_few_rows_and_many_regressors_have_wide_errors():
    """Of a fit with its own row, an eighth of these t-statistics would exceed 1.96."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(600):
        y, x = rng.standard_t(5, 36), rng.standard_t(5, (36, 6))
        found.append(abs(regress(y, x).t[1:]) > 1.96)
    assert np.mean(found) < 0.095


def test_lags_follow_the_formula():
    scores = series(250, 3)[0]
    scores -= scores.mean()
    window = int(4 * (250 / 100) ** (2 / 9))
    assert window == 4
    sigma = [sum(scores[j:] * scores[: 250 - j]) / 250 for j in range(window + 1)]
    s0 = sigma[0] + 2 * sum(sigma[1:])
    s1 = 2 * sum(j * sigma[j] for j in range(window + 1))
    assert newey_west_lags(scores) == math.floor(1.1447 * ((s1 / s0) ** 2 * 250) ** (1 / 3)) > 0


def test_autocorrelation_widens_the_error_of_a_mean():
    rng = np.random.default_rng(1)
    independent = 0.1 + rng.normal(size=2000)
    plain = independent.mean() / independent.std(ddof=1) * math.sqrt(2000)
    assert mean_t(independent) == pytest.approx(plain, rel=0.15)
    repeated = np.repeat(independent[:400], 5)
    assert mean_t(repeated) < 0.7 * repeated.mean() / repeated.std() * math.sqrt(2000)
    assert mean_t(np.zeros(50)) == 0
