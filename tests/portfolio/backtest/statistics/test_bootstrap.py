"""The stationary bootstrap, against theory, hand calculations and the package arch."""

import itertools
import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics import bootstrap
from qfolio.portfolio.backtest.statistics.bootstrap import (
    block_length,
    bootstrap_measures,
    percentile_interval,
    stationary_bootstrap_indices,
)
from qfolio.portfolio.backtest.statistics.measures import MEASURES, measures


def autoregressive(
    rng: np.random.Generator, rows: int, count: int, coefficient: float
) -> np.ndarray:
    noise = rng.standard_normal((count + 50, rows))
    for before, now in itertools.pairwise(noise):
        now += coefficient * before
    return noise[50:].T


@pytest.mark.parametrize("coefficient", [-0.4, 0.3, 0.6])
def test_block_length_of_an_autoregression(coefficient: float) -> None:
    # R(k) ∝ φ^k gives G / g(0) = 2 φ / (1 − φ²), so b = (2 |φ| / (1 − φ²))^⅔ n^⅓.
    count = 8000
    series = autoregressive(np.random.default_rng(1), 9, count, coefficient)
    theory = (2 * abs(coefficient) / (1 - coefficient**2)) ** (2 / 3) * count ** (1 / 3)
    assert np.median([block_length(row) for row in series]) == pytest.approx(theory, rel=0.15)


def test_block_length_by_hand() -> None:
    # Neighbors alone are related, so the window is 2 wide, with the weights 1 at lag 1 and 0 at
    # lag 2: G = 2 R(1) and g(0) = R(0) + 2 R(1).
    noise = np.random.default_rng(1).standard_normal(501)
    series = noise[1:] + 0.8 * noise[:-1]
    centerd = series - series.mean()
    none, one = centerd @ centerd, centerd[1:] @ centerd[:-1]
    expected = ((2 * one / (none + 2 * one)) ** 2 * 500) ** (1 / 3)
    assert block_length(series) == pytest.approx(expected)
    assert block_length(1000 - 3 * series) == pytest.approx(expected)


def test_block_length_is_bounded() -> None:
    # ±1 in turns, 8 in all: R(k) = ± (1 − k/8), the window is 7 wide, and the length would be 5.8.
    assert block_length([1.0, -1.0] * 4) == 3  # 8 / 3, rounded up


@pytest.mark.parametrize("series", [[0.1], [0.1, 0.2], [0.1] * 100, [0.0] * 100])
def test_block_length_of_hardly_anything(series: list[float]) -> None:
    assert block_length(series) == 1


def test_indices_are_blocks_of_geometric_length_in_a_circle() -> None:
    picks = stationary_bootstrap_indices(50, 5.0, 4000, np.random.default_rng(2))
    assert picks.shape == (4000, 50)
    follows = picks[:, 1:] == (picks[:, :-1] + 1) % 50
    # Each day follows its predecessor with chance 4/5, or by accident: 4/5 + 1/5 · 1/50.
    np.testing.assert_allclose(follows.mean(axis=0), 0.804, atol=0.03)
    pairs = follows[:, 1:] & follows[:, :-1]
    assert pairs.mean() == pytest.approx(0.804**2, abs=0.01)
    # Every day is equally likely at every place: expected 80, standard deviation 9.
    for place in (0, 1, 25, 49):
        counts = np.bincount(picks[:, place], minlength=50)
        assert (abs(counts - 80) < 45).all()


def test_indices_of_block_one_are_independent() -> None:
    picks = stationary_bootstrap_indices(10, 1.0, 5000, np.random.default_rng(3))
    assert (picks[:, 1:] == (picks[:, :-1] + 1) % 10).mean() == pytest.approx(0.1, abs=0.01)


def test_bootstrap_measures_are_the_measures_of_the_resampled_days(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(4)
    returns, turnover, cost = rng.random((3, 2, 30)) / 10
    returns -= 0.05
    returns[1, 7] = -1  # some histories are ruined, others are not
    monkeypatch.setattr(bootstrap, "CHUNK", 60)
    monkeypatch.setattr(bootstrap, "TOGETHER", 3)  # histories at a time; 60 has room for two
    drawn = bootstrap_measures(returns, turnover, cost, 252, 4, 7, np.random.default_rng(5))
    again = np.random.default_rng(5)
    picks = np.concatenate([stationary_bootstrap_indices(30, 4, n, again) for n in (3, 3, 1)])
    ruined = (picks == 7).any(axis=1)
    assert 0 < ruined.sum() < 7
    for row, days_drawn in enumerate(picks):
        direct = measures(returns[:, days_drawn], turnover[:, days_drawn], cost[:, days_drawn], 252)
        for name in MEASURES:
            np.testing.assert_allclose(drawn[name][row], direct[name], rtol=1e-9, err_msg=name)
    np.testing.assert_array_equal(drawn["growth"][:, 1] == -1, ruined)


def test_percentile_interval_by_hand() -> None:
    samples = np.random.default_rng(6).permutation(np.arange(1.0, 40.0))
    assert percentile_interval(samples).tolist() == [
        1,
        39,
    ]  # the (39 + 1) · 2.5% = first from either end
    assert percentile_interval(samples, 0.5).tolist() == [10, 30]
    samples[samples < 5] = -math.inf
    assert percentile_interval(samples).tolist() == [-math.inf, 39]


def test_blocks_cover_where_independent_days_do_not() -> None:
    # Log returns with φ = 0.5: the mean of n days varies (1 + φ) / (1 − φ) = 3 times as much as
    # independent days would tell, so their 95% intervals cover 2 Φ(1.96 / √3) − 1 = 74%.
    rng = np.random.default_rng(7)
    series = np.expm1(0.01 * autoregressive(rng, 150, 300, 0.5))
    zeros = np.zeros((1, 300))

    def coverage(block: float | None) -> float:
        hits = 0
        for row in series:
            length = block_length(row) if block is None else block
            drawn = bootstrap_measures(row[None], zeros, zeros, 252, length, 200, rng)
            low, high = percentile_interval(drawn["growth"][:, 0])
            hits += bool(low <= 0 <= high)
        return hits / len(series)

    assert coverage(1.0) == pytest.approx(0.74, abs=0.08)
    assert coverage(None) > 0.88


# The package arch as an oracle ---------------------------------------------------------------


@pytest.mark.parametrize(("coefficient", "count"), [(0.05, 300), (0.999, 300)])
def test_block_lengths_are_those_of_arch(coefficient: float, count: int) -> None:
    """Without any memory, or with one that outlasts the window, both have the same window."""
    from arch.bootstrap import optimal_block_length

    rows = autoregressive(np.random.default_rng(10), 6, count, coefficient)
    theirs = [optimal_block_length(row)["stationary"].item() for row in rows]
    assert max(theirs) > 1
    np.testing.assert_allclose([block_length(row) for row in rows], np.maximum(theirs, 1))


def test_block_lengths_with_memory_are_near_those_of_arch() -> None:
    """Its window ends two lags later than that of the paper, which adds noise of its own."""
    from arch.bootstrap import optimal_block_length

    for coefficient in (-0.6, 0.3, 0.6, 0.9):
        rows = autoregressive(np.random.default_rng(10), 9, 4000, coefficient)
        theirs = np.array([optimal_block_length(row)["stationary"].item() for row in rows])
        ratios = np.array([block_length(row) for row in rows]) / theirs
        assert np.median(ratios) == pytest.approx(1, abs=0.15), coefficient


def test_intervals_are_those_of_arch() -> None:
    from arch.bootstrap import StationaryBootstrap

    rng = np.random.default_rng(11)
    returns = np.expm1(0.01 * autoregressive(rng, 1, 400, 0.5))
    zeros = np.zeros_like(returns)
    drawn = bootstrap_measures(returns, zeros, zeros, 252, 8.0, 4000, rng)
    names = ("volatility", "sharpe", "sortino")

    def statistics(sample: np.ndarray) -> np.ndarray:
        table = measures(sample, 0 * sample, 0 * sample, 252)
        return np.array([table[name] for name in names])

    theirs = StationaryBootstrap(8, returns[0], seed=12).apply(statistics, reps=4000)
    for name, column in zip(names, theirs.T, strict=True):
        spread = column.std()
        assert drawn[name].std() == pytest.approx(spread, rel=0.06), name
        # A quantile of 2.5% has a standard error of √(.025 · .975 / 4000) / .058 = .043 spreads.
        for end, other in zip(
            percentile_interval(drawn[name][:, 0]), percentile_interval(column), strict=True
        ):
            assert abs(end - other) < 4 * math.sqrt(2) * 0.043 * spread, name
