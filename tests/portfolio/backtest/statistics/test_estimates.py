"""Errors of differences: by hand, and as often wrong as their p-values say."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from qfolio.portfolio.backtest.statistics.estimates import MEASURED, Estimate, estimate, luckiest
from qfolio.portfolio.backtest.statistics.measures import measures


def pair(rng: np.random.Generator, count: int, *, volatilities: int = 0) -> np.ndarray:
    """Two strategies that differ in nothing but luck, of shape (2, 1, count).

    volatilities: those that have calm and wild years, with heavy tails: none; 1 for the market and
    the strategies' own parts together; or 3, each its own.
    """
    size, noise = np.ones((1, count)), rng.standard_normal((3, count))
    if volatilities:
        shocks = 0.15 * rng.standard_normal((volatilities, count + 300))
        size = np.exp(lfilter([1], [1, -0.98], shocks)[:, 300:])
        noise = rng.standard_t(5, (3, count)) / math.sqrt(5 / 3)
    market, *own = np.tanh(noise * size / 30) * 0.3  # no total loss
    return np.stack([5e-4 + market + 0.4 * each for each in own])[:, None]


def test_values_are_those_of_the_measures() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = 0.001 + 0.01 * rng.standard_normal((3, 250)), 0.02 * rng.random((1, 250))
    found = estimate(ours, theirs, 252)
    one, other = (measures(x, 0 * x, 0 * x, 252) for x in (ours, theirs))
    assert found["growth"].value == pytest.approx(
        np.log1p(one["growth"]).mean() - np.log1p(other["growth"][0])
    )
    assert found["sharpe"].value == pytest.approx(one["sharpe"].mean() - other["sharpe"][0])
    assert found["volatility"].value == pytest.approx(
        np.log(one["volatility"]).mean() - np.log(other["volatility"][0])
    )


def test_the_error_by_hand() -> None:
    """Fourteen days have ν = ⌊0.41 · 14^⅔⌋ = 2 cosine transforms."""
    days = np.arange(14)
    ours, theirs = np.full((1, 14), 0.01), np.zeros((1, 14))
    ours[0] += 0.005 * np.sin(days)
    found = estimate(ours, theirs, 1.0)["growth"]
    logs = np.log1p(ours[0])
    sums = [(logs * np.cos(math.pi * k * (days + 0.5) / 14)).sum() for k in (1, 2)]
    np.testing.assert_allclose(np.abs(found.loads), np.abs(np.array(sums) * math.sqrt(2) / 14))
    assert found.error == pytest.approx(math.sqrt((found.loads**2).mean()))
    assert found.freedom == 2
    low, high = found.interval()
    assert high - found.value == pytest.approx(found.value - low)
    assert high - found.value == pytest.approx(4.302653 * found.error)  # t of 2 degrees


def test_a_difference_in_volatility_has_slow_transforms_only() -> None:
    """Ten years of 12 months: ν is 8, where that of growth is ⌊0.41 · 120^⅔⌋ = 9; of 2 years, 2."""
    rng = np.random.default_rng(0)
    for months, slow in ((120, 8), (24, 2)):
        ours, theirs = rng.normal(0, 0.1, (2, 1, months))
        found = estimate(ours, theirs, 12)
        assert len(found["growth"].loads) == int(0.41 * months ** (2 / 3))
        assert len(found["volatility"].loads) == slow


def test_independent_days_have_the_usual_error() -> None:
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(200):
        one, other = pair(rng, 800)
        usual = (np.log1p(one) - np.log1p(other)).std() / math.sqrt(800)
        ratios.append(estimate(one, other, 1.0)["growth"].error / usual)
    assert np.mean(np.square(ratios)) == pytest.approx(1, abs=0.04)


def test_autocorrelated_days_have_a_larger_error() -> None:
    """An excess that lasts for days, x ← 0.5 x + ε, has (1 + 0.5)/(1 − 0.5) times the variance."""
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(200):
        excess = 1e-4 * rng.standard_normal(3000)
        for day in range(1, 3000):
            excess[day] += 0.5 * excess[day - 1]
        found = estimate(excess[None], np.zeros((1, 3000)), 1.0)["growth"]
        ratios.append(found.error / (excess.std() / math.sqrt(3000)))
    assert np.mean(np.square(ratios)) == pytest.approx(3, rel=0.06)


def test_seeds_add_their_doubt() -> None:
    loads = np.full(50, 0.01)
    none, some = Estimate(0.1, loads, 0.0, 1), Estimate(0.1, loads, 0.0003, 4)
    assert some.error == pytest.approx(math.sqrt(1e-4 + 3e-4))
    assert none.freedom == 50
    # (1 + 3)² / (1²/50 + 3²/3)
    assert some.freedom == pytest.approx(16 / 3.02)
    assert some.tails().better > none.tails().better
    assert none.tails().better == pytest.approx(none.negated().tails().worse)


def test_leverage_changes_no_sharpe_ratio() -> None:
    """Half in cash: the same ratio, exactly, though growth and volatility differ."""
    rng = np.random.default_rng(3)
    market = 0.001 + 0.01 * rng.standard_normal((1, 5040))  # twenty years
    found = estimate(market / 2, market, 252)
    assert found["sharpe"].tails() == (1, 1)
    assert found["volatility"].value == pytest.approx(-math.log(2))
    assert found["volatility"].tails().worse < 1e-4


def test_money_in_cash_changes_no_sharpe_ratio_whatever_it_earns() -> None:
    rng = np.random.default_rng(8)
    rate = 0.001 + 0.0002 * rng.standard_normal(500)
    market = 0.002 + 0.01 * rng.standard_normal((1, 500))
    found = estimate((market + rate) / 2, market, 252, rate)["sharpe"]
    assert found.tails() == (1, 1)


def test_the_error_of_volatility_has_one_scale_for_both() -> None:
    """A day's squared deviations differ by 3 times a square, in units of twice the mean of both."""
    wave = np.sin(np.arange(20.0))[None]
    wave -= wave.mean()
    found = estimate(0.02 * wave, 0.01 * wave, 1.0)["volatility"]
    variance = (wave**2).sum() / 19
    each = 3 * wave[0] ** 2 / (2 * (4 * variance + variance) / 2)
    sums = [(each * np.cos(math.pi * k * (np.arange(20) + 0.5) / 20)).sum() for k in (1, 2, 3)]
    wanted = np.abs(np.array(sums) * math.sqrt(2) / 20)[: len(found.loads)]
    np.testing.assert_allclose(np.abs(found.loads), wanted)
    assert found.value == pytest.approx(math.log(2))


def test_what_has_no_error() -> None:
    flat, gains = np.zeros((1, 50)), np.full((1, 50), 0.01)
    market = 0.01 * np.random.default_rng(4).standard_normal((1, 50))
    ruin = market.copy()
    ruin[0, 3] = -1
    cash = estimate(flat, market, 252)
    assert cash["sharpe"].known
    assert not cash["volatility"].known  # −∞
    assert cash["volatility"].tails() == (1, 1)
    assert not estimate(gains, market, 252)["sharpe"].known
    lost = estimate(ruin, market, 252)["growth"]
    assert lost.value == -math.inf
    assert lost.interval() == (-math.inf, math.inf)
    same = estimate(ruin, ruin, 252)["growth"]
    assert (same.value, same.interval(), same.tails()) == (0, (0, 0), (1, 1))


@pytest.mark.parametrize(("periods", "known"), [(2, False), (4, False), (5, True)])
def test_a_few_days_prove_nothing(periods: int, known: bool) -> None:
    """The error of a Sharpe ratio of two days is 0 whatever they are."""
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(0.01, 0.01, (2, 1, periods))
    for each in estimate(ours, theirs, 252.0).values():
        assert each.known is known
        if not known:
            assert each.tails() == (1.0, 1.0)
            assert each.interval() == (-math.inf, math.inf)


def test_the_luckiest_of_several() -> None:
    rng = np.random.default_rng(5)
    apart = [Estimate(0.0, rng.standard_normal(500), 0.0, 1) for _ in range(5)]
    drawn = luckiest(apart, 20_000, rng)
    # The largest of five normal numbers exceeds 2 with probability 1 − Φ(2)⁵.
    assert (drawn > 2).mean() == pytest.approx(1 - 0.97725**5, abs=0.02)
    alike = luckiest(apart[:1] * 5, 20_000, rng)
    assert (alike > 2).mean() == pytest.approx(1 - 0.97725, abs=0.006)


def test_the_luckiest_is_as_doubtful_as_the_error_that_is_known_least() -> None:
    """Seeds of which there are two leave one degree of freedom: t = 12.7 is as rare as 1.96."""
    loads = 0.001 * np.random.default_rng(7).standard_normal(500)
    family = [Estimate(0.0, loads, 1e-4, 2), Estimate(0.0, loads, 1e-12, 2)]
    drawn = luckiest(family, 20_000, np.random.default_rng(8))
    assert 0.025 < (drawn > 12.706).mean() < 0.05  # of one alone, and of two


@pytest.mark.slow
@pytest.mark.parametrize("count", [120, 500, 1260, 5000])
@pytest.mark.parametrize("volatilities", [0, 1, 3])
def test_p_values_are_right_as_often_as_they_say(count: int, volatilities: int) -> None:
    """Two strategies without a difference: 5% of the p-values are at most 5%, 1% at most 1%."""
    rng = np.random.default_rng(6)
    p_values = np.empty((1500, len(MEASURED)))
    for world in p_values:
        one, other = pair(rng, count, volatilities=volatilities)
        found = estimate(one, other, 252)
        world[:] = [2 * min(found[key].tails()) for key in MEASURED]
    for level, tolerance in ((0.05, 0.018), (0.01, 0.009)):  # three standard errors
        rates = dict(zip(MEASURED, (p_values <= level).mean(axis=0), strict=True))
        assert max(rates.values()) <= level + tolerance, rates
        assert volatilities or min(rates.values()) >= level - tolerance, rates
