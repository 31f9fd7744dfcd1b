"""Figures of tear sheets, each beside a value computed by hand."""

import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics.tearsheet import (
    Fall,
    alpha,
    contributions,
    effective_number,
    falls,
    figures,
    kelly,
    leverage,
    longest_run,
    rolling_beta,
    rolling_sharpe,
    stability,
    value_at_risk,
)

DAYS = np.array(
    ["2020-01-30", "2020-01-31", "2020-02-03", "2020-02-04", "2021-01-04", "2021-01-05"],
    "datetime64[D]",
)
RETURNS = np.array([0.1, -0.2, 0.25, 0.1, -0.5, 0.0])  # wealth 1.1, .88, 1.1, 1.21, .605, .605


def test_drawdowns_from_peak_to_recovery() -> None:
    first, second = falls(RETURNS, 5)
    assert first == pytest.approx(Fall(3, 4, None, 0.5, 2))  # to the end of the record
    assert second == pytest.approx(Fall(0, 1, 2, 0.2, 2))
    assert falls(RETURNS, 1) == [first]
    (start,) = falls([-0.1, 0.2], 5)
    assert start == pytest.approx(Fall(-1, 0, 1, 0.1, 2))  # the start is a peak
    assert falls([0.1, 0.0], 5) == []


def test_value_at_risk_is_a_loss() -> None:
    returns = np.arange(-10, 11) / 100  # the 5% quantile of 21 values is the second
    var, cvar = value_at_risk(returns)
    assert var == pytest.approx(0.09)
    assert cvar == pytest.approx(0.095)
    assert np.isnan(value_at_risk(returns[:19])).all()  # of 19, none is 5%


def test_rolling_ratios() -> None:
    rng = np.random.default_rng(0)
    market = 1e-3 + 0.01 * rng.normal(size=50)
    returns = np.stack([2 * market + 1e-4, -market])
    sharpe = rolling_sharpe(returns, 20, 252)
    last = returns[:, 10:30]
    expected = math.sqrt(252) * last.mean(axis=1) / last.std(axis=1, ddof=1)
    assert np.isnan(sharpe[:, :19]).all()
    np.testing.assert_allclose(sharpe[:, 29], expected, rtol=1e-9)
    beta = rolling_beta(returns, market, 20)
    assert np.isnan(beta[:, :19]).all()
    np.testing.assert_allclose(beta[:, 19:], [[2.0] * 31, [-1.0] * 31], rtol=1e-9)
    assert np.isnan(rolling_beta(market, np.zeros(50), 20)).all()
    np.testing.assert_array_equal(rolling_sharpe(np.zeros(4), 2, 252)[1:], 0)


def test_effective_number_of_assets() -> None:
    weights = [[0.2, 0.4, 0.4], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.375, 0.125]]
    np.testing.assert_allclose(effective_number(weights), [2, 1, 0, 1.6])


def test_leverage_of_long_and_short_positions() -> None:
    gross, net = leverage([[0.5, 0.9, -0.4], [0.0, 1.0, 0.0]])
    assert gross == pytest.approx((1.3 + 1.0) / 2)
    assert net == pytest.approx((0.5 + 1.0) / 2)


def test_alpha_is_what_a_reference_leaves() -> None:
    market = np.array([0.01, -0.02, 0.03, 0.0])
    assert alpha(2 * market + 0.001, market, 250) == pytest.approx(0.25)
    # Both are one point above or below their means, .01 and .02, so the slope is 1.
    assert alpha([0.0, 0.02], [0.01, 0.03], 100) == pytest.approx(-1.0)
    assert math.isnan(alpha(market, np.full(4, 0.001), 250))
    assert math.isnan(alpha(market, market[::-1] / 100, 250))  # as interest on cash moves
    assert alpha(5 * market, market, 250) == pytest.approx(0)


def test_stability_of_a_straight_line() -> None:
    assert stability(np.expm1([0.01, 0.01, 0.01])) == pytest.approx(1)
    # Log wealth 1, 0, 1 over times 0, 1, 2 has no slope; 0, 0, 1 has R² = 1² / (2 × ⅔).
    assert stability(np.expm1([1, -1, 1])) == pytest.approx(0, abs=1e-12)
    assert stability(np.expm1([0, 0, 1])) == pytest.approx(0.75)
    assert stability([0.0, 0.0]) == 0
    assert math.isnan(stability([0.1, -1.0]))


def test_kelly_fraction() -> None:
    assert kelly([0.2, 0.2, -0.1, 0.0]) == pytest.approx(2 / 3 - 1 / 3 / 2)
    assert kelly([0.1, -0.1, -0.1]) == pytest.approx(1 / 3 - 2 / 3)
    assert kelly([0.1, 0.3]) == 1
    assert math.isnan(kelly([0.0, -0.1]))


def test_longest_run() -> None:
    assert longest_run([True, True, False, True, True, True]) == 3
    assert longest_run([False, False]) == longest_run([]) == 0
    assert longest_run([True]) == 1


def test_contributions_add_up_to_the_mean_return() -> None:
    weights = [[0.5, 0.5, 0.0], [0.0, 0.25, 0.75]]
    moves = [[0.02, 0.5], [-0.04, 0.08]]
    gross = np.array([0.01, 0.05])
    parts, rest = contributions([gross - 0.001, gross - 0.003], weights, moves, 100)
    np.testing.assert_allclose(parts, [0.0, 3.0], atol=1e-12)  # (.01 − .01) / 2 and .06 / 2
    assert rest == pytest.approx(-0.2)


def test_figures_of_a_short_record() -> None:
    found = figures(RETURNS, DAYS, 3)
    assert found["total"] == pytest.approx(-0.395)
    assert found["growth"] == pytest.approx(math.sqrt(0.605) - 1)  # six periods are two years
    assert found["volatility"] == pytest.approx(math.sqrt(3) * RETURNS.std(ddof=1))
    assert found["sharpe"] == pytest.approx(-0.25 / 6 / RETURNS.std(ddof=1) * math.sqrt(3))
    assert found["sortino"] == pytest.approx(-0.25 / 6 / math.sqrt(0.29 / 6) * math.sqrt(3))
    assert found["calmar"] == pytest.approx((math.sqrt(0.605) - 1) / 0.5)
    assert found["omega"] == pytest.approx(0.45 / 0.7)
    assert found["drawdown"] == pytest.approx(0.5)
    assert found["longest"] == pytest.approx(2 / 3)
    assert found["time_below"] == pytest.approx(0.5)
    assert found["ulcer"] == pytest.approx(math.sqrt((0.2**2 + 2 * 0.5**2) / 6))
    assert found["tail_ratio"] == pytest.approx(0.2125 / 0.425)
    assert found["hit_rate"] == pytest.approx(3 / 5)
    assert found["hit_rate_month"] == pytest.approx(1 / 3)
    assert found["gain_to_pain"] == pytest.approx((-0.12 + 0.375 - 0.5) / (0.12 + 0.5))
    assert found["kelly"] == pytest.approx(3 / 5 - 2 / 5 * 0.35 / 0.15)
    assert (found["winning"], found["losing"]) == (2, 1)
    assert found["payoff"] == pytest.approx(0.15 / 0.35)
    assert (found["best"], found["worst"]) == (0.25, -0.5)
    assert found["best_month"] == pytest.approx(0.375)  # 1.25 × 1.1 − 1, in February
    assert found["worst_month"] == pytest.approx(-0.5)
    assert found["best_year"] == pytest.approx(0.21)
    assert found["worst_year"] == pytest.approx(-0.5)
    tails = [found[key] for key in ("var", "cvar", "var_month", "cvar_month")]
    assert np.isnan(tails).all()  # six values have no twentieth
    assert found["kurtosis"] == pytest.approx(
        ((RETURNS - RETURNS.mean()) ** 4).mean() / RETURNS.var() ** 2
    )


def test_a_record_without_losses_or_moves() -> None:
    found = figures([0.0, 0.0], DAYS[:2], 252)
    assert found["longest"] == found["drawdown"] == found["hit_rate"] == found["omega"] == 0
    assert figures([0.1, 0.1], DAYS[:2], 252)["omega"] == math.inf
    assert figures([0.1, -1.0], DAYS[:2], 252)["growth"] == -1


def test_tails_of_months_are_those_of_monthly_rows() -> None:
    returns = np.random.default_rng(0).normal(0.01, 0.05, 30)
    months = np.datetime64("2020-01-31") + np.arange(30) * 31
    found = figures(returns, months, 12)
    assert (found["var_month"], found["cvar_month"]) == pytest.approx(value_at_risk(returns))
