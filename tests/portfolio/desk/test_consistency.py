"""The sequential test of live returns: false alarms, power, and the band."""

import numpy as np
import pytest

from qfolio.portfolio.desk.consistency import ALARM, ALPHA, Promise, band, evidence, together

SHARPE = 1.0 / np.sqrt(252)


def clustered(rng, count, mean):
    """Daily returns of deviation 1% or so, whose volatility clusters, with fat tails."""
    variance, out = 1.0, np.empty(count)
    for t in range(count):
        shock = np.sqrt(variance) * rng.standard_t(5) * np.sqrt(3 / 5)
        variance = 0.04 + 0.08 * shock**2 + 0.88 * variance
        out[t] = 0.01 * (mean + shock)
    return out


def plain(rng, count, mean):
    return 0.01 * rng.normal(mean, 1, count)


def alarms(draw, live_mean, cases, tested=1000, live=750):
    """The share of cases in which the alarm is ever given within three years."""
    given = 0
    for seed in range(cases):
        rng = np.random.default_rng(seed)
        promise = Promise.of(draw(rng, tested, SHARPE), rng, resamples=300)
        given += evidence(promise, draw(rng, live, live_mean)).max() >= ALARM
    return given / cases


@pytest.mark.parametrize("draw", [plain, clustered])
def test_false_alarms_are_rare_at_any_time(draw):
    """Under the backtest's own law, whose mean is estimated from 1000 days."""
    assert alarms(draw, SHARPE, 200) <= ALPHA


def test_an_expectation_that_is_known_is_bet_against_in_vain():
    """Ville's inequality alone, with the mean of the cut returns exactly at the limit."""
    rng = np.random.default_rng(0)
    promise = Promise(-0.02, 0.02, 0.0)
    found = [evidence(promise, 0.01 * rng.normal(0, 1, 2000)).max() for _ in range(500)]
    assert np.mean(np.array(found) >= 10) <= 0.1
    assert max(found) > 3  # it does bet


@pytest.mark.parametrize(("sharpe", "least"), [(-2, 0.5), (-3, 0.8)])
def test_a_large_drop_is_found(sharpe, least):
    """The share of cases within three years, after a backtest of four with a Sharpe ratio of 1."""
    assert alarms(plain, sharpe * SHARPE, 60) >= least


def test_a_promise_of_several_is_weaker():
    """Together they are wrong as rarely as one alone."""
    tested = plain(np.random.default_rng(1), 1000, SHARPE)
    one, two, both = (
        Promise.of(tested, np.random.default_rng(0), promises).least for promises in (1, 2, 2)
    )
    assert two == both < one
    spread = 0.01 / np.sqrt(1000)
    assert one == pytest.approx(tested.mean() - 1.96 * spread, abs=0.2 * spread)
    assert two == pytest.approx(tested.mean() - 2.24 * spread, abs=0.2 * spread)


def test_evidence_by_hand():
    """A loss of half the range below the limit, with the largest bet of 1 / (1/2)."""
    promise = Promise(-1.0, 1.0, 0.0)
    bets = 2 * np.array([0.02, 0.05, 0.1, 0.2, 0.4])
    expected = [(1 + bets / 2).mean(), ((1 + bets / 2) * (1 - bets / 4)).mean()]
    np.testing.assert_allclose(evidence(promise, [-7.0, 0.5]), expected)
    np.testing.assert_allclose(together([np.array([1.0, 3]), np.array([3.0, 1])]), [2, 2])
    np.testing.assert_array_equal(evidence(Promise(0.0, 0.0, 0.0), [0.1]), [1])


def test_the_band_of_independent_returns():
    rng = np.random.default_rng(1)
    tested = plain(rng, 1500, SHARPE)
    low, middle, high = band(tested, 2000, rng)  # longer than the backtest
    rows = np.arange(1, 2001)
    mean, deviation = np.log1p(tested).mean(), np.log1p(tested).std()
    np.testing.assert_allclose(np.log(middle), rows * mean, atol=0.05)
    spread = (np.log(high) - np.log(low)) / (2 * 1.96 * deviation * np.sqrt(rows))
    assert spread[500:].mean() == pytest.approx(1, abs=0.15)


def test_the_band_of_a_backtest_that_was_wiped_out():
    tested = np.append(plain(np.random.default_rng(1), 200, SHARPE), [-1.0, *np.zeros(50)])
    low, middle, high = band(tested, 100, np.random.default_rng(0))
    assert (low <= middle).all()
    assert (middle <= high).all()
    assert 0 < low[-1] < 0.01
