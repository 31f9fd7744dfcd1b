from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from qfolio.core.arrays import Floats
from qfolio.core.statistics import (
    FEWEST_SEEDS,
    band,
    bootstrap_interval,
    holm,
    interquartile_mean,
    mean_interval,
    probability_of_improvement,
    rank_test,
    regret,
)


@pytest.mark.parametrize("optimum", [None, 0.0])
def test_there_is_no_share_of_an_optimum_of_zero(optimum: float | None) -> None:
    assert regret([-1.0, 0.0, 1.0], optimum) is None


def test_a_regret_is_a_share_of_the_size_of_the_optimum() -> None:
    assert regret([-300.0, -200.0, -150.0], -200.0) == pytest.approx([0.5, 0.0, -0.25])
    assert regret(1.5, 2.0) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([7.0], 7.0),
        ([1.0, 4.0], 2.5),
        ([30.0, 0.0, 6.0], (0 / 4 + 6 + 30 / 4) / 1.5),
        ([9.0, 1.0, 2.0, -50.0], 1.5),
        # Five values: the middle 2.5 are 0.75 of the second, the third, 0.75 of the fourth.
        ([5.0, 100.0, 3.0, 4.0, -100.0], (0.75 * 3 + 4 + 0.75 * 5) / 2.5),
    ],
)
def test_interquartile_mean_by_hand(values: list[float], expected: float) -> None:
    assert interquartile_mean(values) == pytest.approx(expected)


@pytest.mark.parametrize("count", [4, 8, 64])
def test_interquartile_mean_equals_trimmed_mean(count: int) -> None:
    stats = pytest.importorskip("scipy.stats")
    values = np.random.default_rng(1).normal(size=(3, count))
    np.testing.assert_allclose(
        interquartile_mean(values), stats.trim_mean(values, 0.25, axis=-1), atol=1e-12
    )


def test_interquartile_mean_of_nothing() -> None:
    with pytest.raises(ValueError, match="at least one"):
        interquartile_mean([])


def test_bootstrap_of_one_value_has_no_width() -> None:
    assert bootstrap_interval([[3.0]]) == (3.0, 3.0)


def test_bootstrap_of_a_coin() -> None:
    # Two values 0 and 1: the resampled mean is 0, 1/2 or 1 with chances 1/4, 1/2 and 1/4.
    assert bootstrap_interval([[0.0, 1.0]], level=0.9) == (0.0, 1.0)
    assert bootstrap_interval([[0.0, 1.0]], level=0.3) == (0.5, 0.5)


def test_bootstrap_is_close_to_theory_and_repeatable() -> None:
    values = np.random.default_rng(3).normal(size=400)

    def mean(x: Floats) -> Floats:
        return np.asarray(x.mean(-1))

    low, high = bootstrap_interval([values], mean)
    assert (high - low) / 2 == pytest.approx(1.96 * values.std() / 20, rel=0.06)
    assert bootstrap_interval([values], mean) == (low, high)
    assert bootstrap_interval([values], mean, seed=1)[0] != low


def test_mean_interval_by_hand() -> None:
    # Mean 3, variance 5/2, n = 5: 3 ± 2.77645 √(1/2).
    interval = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert interval == pytest.approx((3 - 1.96324, 3 + 1.96324), abs=1e-4)


def test_few_seeds_have_a_range_and_no_interval() -> None:
    # Student's would say that a CartPole policy balances for −296 to 954 steps on average.
    assert mean_interval([329.0, 182.0, 476.0]) is None
    low, high = band([[329.0, 182.0, 476.0], [1.0, 1.0, 1.0]])
    np.testing.assert_array_equal([low, high], [[182.0, 1.0], [476.0, 1.0]])
    values = np.random.default_rng(4).normal(size=(2, FEWEST_SEEDS))
    np.testing.assert_array_equal(
        np.transpose(band(values)), [bootstrap_interval([row]) for row in values]
    )


def test_a_band_keeps_the_leading_shape() -> None:
    low, high = band(np.zeros((2, 3, FEWEST_SEEDS)))
    assert low.shape == high.shape == (2, 3)


def test_groups_are_drawn_by_themselves() -> None:
    # Each group is constant, so that its mean cannot change, whoever is drawn.
    def difference(x: Floats, y: Floats) -> Floats:
        return np.asarray(interquartile_mean(x) - interquartile_mean(y))

    assert bootstrap_interval([[5.0] * 3, [2.0] * 7], difference) == pytest.approx((3.0, 3.0))
    # Two coins: the difference of their means is ±1 with chance 1/16 each way, for two values each.
    low, high = bootstrap_interval([[0.0, 1.0], [0.0, 1.0]], difference, level=0.9)
    assert (low, high) == (-1.0, 1.0)
    low, high = bootstrap_interval([[0.0, 1.0], [0.0, 1.0]], difference, level=0.8)
    assert (low, high) == (-0.5, 0.5)


def test_intervals_cover_what_they_should() -> None:
    # Of ten values, an interval that claims 95% holds the truth some 93 times in 100, and a
    # difference between groups that are alike contains zero as often.
    rng = np.random.default_rng(5)
    held = np.zeros(3)
    for seed in range(400):
        x, y = rng.normal(size=(2, 10))
        cases: list[tuple[list[Any], Callable[..., Any], float]] = [
            ([x], interquartile_mean, 0.0), ([x, y], probability_of_improvement, 0.5),
            ([x, y + 1], probability_of_improvement, 0.23975),
        ]  # fmt: skip
        for i, (groups, statistic, truth) in enumerate(cases):
            low, high = bootstrap_interval(groups, statistic, resamples=300, seed=seed)
            held[i] += low <= truth <= high
    assert (held / 400 > 0.885).all()
    assert (held / 400 < 0.975).all()


@pytest.mark.parametrize(
    ("groups", "options"),
    [([], {}), ([[1.0], []], {}), ([[1.0]], {"level": 1.0}), ([[1.0]], {"resamples": 0})],
)
def test_groups_that_are_refused(groups: list[list[float]], options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"at least one|must lie"):
        bootstrap_interval(groups, **options)  # type: ignore[arg-type]


def test_probability_of_improvement_by_hand() -> None:
    # 1 beats nothing, 3 beats 2 and ties with 3, 5 beats both: (0 + 1.5 + 2) of 6.
    assert probability_of_improvement([1, 3, 5], [2, 3]) == pytest.approx(3.5 / 6)
    assert probability_of_improvement([2, 3], [1, 3, 5]) == pytest.approx(2.5 / 6)
    both = probability_of_improvement([[1, 3, 5], [0, 0, 0]], [[2, 3], [1, 1]])
    np.testing.assert_allclose(both, [3.5 / 6, 0.0])


def test_rank_test_by_hand() -> None:
    # Of the six ways to choose two of four values, {1, 2} and {3, 4} are the extreme ones.
    assert rank_test([1, 2], [3, 4]) == pytest.approx(2 / 6)
    assert rank_test([1, 4], [3, 2]) == pytest.approx(1)
    assert rank_test([1, 2, 3], [4, 5, 6]) == pytest.approx(2 / 20)
    assert rank_test([7, 7], [7, 7, 7]) == 1
    # Ranks 1.5, 1.5, 3.5, 3.5: sums are 3 (once), 5 (four times) and 7 (once).
    assert rank_test([1, 1], [2, 2]) == pytest.approx(2 / 6)
    assert rank_test([1, 2], [1, 2]) == pytest.approx(1)


@pytest.mark.parametrize("sizes", [(4, 4), (10, 10), (3, 12), (60, 55)])
def test_rank_test_equals_that_of_scipy(sizes: tuple[int, int]) -> None:
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(6)
    method = "exact" if sum(sizes) <= 100 else "asymptotic"
    for shift in (0.0, 0.3, 1.0):
        x, y = rng.normal(size=sizes[0]) + shift, rng.normal(size=sizes[1])
        options = {"method": method} if method == "exact" else {"use_continuity": False}
        assert rank_test(x, y) == pytest.approx(stats.mannwhitneyu(x, y, **options).pvalue)
        assert rank_test(x, y) == pytest.approx(rank_test(y, x))


def test_rank_test_rejects_as_seldom_as_it_says() -> None:
    rng = np.random.default_rng(7)
    values = rng.normal(size=(2000, 2, 6)).round(1)  # with some ties
    rejected = np.mean([rank_test(x, y) <= 0.05 for x, y in values])
    assert 0.025 < rejected <= 0.055


def test_holm_by_hand() -> None:
    # In order: 3 × 0.01, then 2 × 0.02, then 1 × 0.9; none below the one before, none above 1.
    np.testing.assert_allclose(holm([0.02, 0.01, 0.9]), [0.04, 0.03, 0.9])
    np.testing.assert_allclose(holm([0.04, 0.03, 0.9]), [0.09, 0.09, 0.9])
    np.testing.assert_allclose(holm([0.8, 0.7]), [1.0, 1.0])
    assert holm([]).shape == (0,)
