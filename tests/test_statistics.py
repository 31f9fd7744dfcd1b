import numpy as np
import pytest

from qfolio.statistics import bootstrap_interval, interquartile_mean, mean_interval


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


def test_interquartile_mean_takes_any_axis() -> None:
    values = np.random.default_rng(2).normal(size=(6, 2, 5))
    np.testing.assert_allclose(
        interquartile_mean(values, axis=0), interquartile_mean(np.moveaxis(values, 0, -1))
    )


def test_interquartile_mean_of_nothing() -> None:
    with pytest.raises(ValueError, match="at least one"):
        interquartile_mean([])


def test_bootstrap_of_one_value_has_no_width() -> None:
    low, high = bootstrap_interval([[3.0], [-1.0]])
    np.testing.assert_array_equal(low, [3.0, -1.0])
    np.testing.assert_array_equal(high, [3.0, -1.0])


def test_bootstrap_of_a_coin() -> None:
    # Two values 0 and 1: the resampled mean is 0, 1/2 or 1 with chances 1/4, 1/2 and 1/4.
    low, high = bootstrap_interval([0.0, 1.0], np.mean, level=0.9)
    assert (float(low), float(high)) == (0.0, 1.0)
    low, high = bootstrap_interval([0.0, 1.0], np.mean, level=0.3)
    assert (float(low), float(high)) == (0.5, 0.5)


def test_bootstrap_is_close_to_theory_and_repeatable() -> None:
    values = np.random.default_rng(3).normal(size=(2, 400))
    low, high = bootstrap_interval(values, np.mean)
    np.testing.assert_allclose((high - low) / 2, 1.96 * values.std(axis=-1) / 20, rtol=0.06)
    again = bootstrap_interval(values, np.mean)
    np.testing.assert_array_equal((low, high), again)
    assert not np.array_equal(low, bootstrap_interval(values, np.mean, seed=1)[0])


def test_bootstrap_keeps_the_leading_shape() -> None:
    low, high = bootstrap_interval(np.zeros((2, 3, 4)), resamples=10)
    assert low.shape == high.shape == (2, 3)


@pytest.mark.parametrize(
    ("values", "options"),
    [([], {}), ([1.0], {"level": 1.0}), ([1.0], {"level": 0.0}), ([1.0], {"resamples": 0})],
)
def test_bootstrap_refuses_bad_arguments(values: list[float], options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"at least one|must lie"):
        bootstrap_interval(values, **options)  # type: ignore[arg-type]


def test_mean_interval_by_hand() -> None:
    # Mean 2, standard deviation 1, n = 3: 2 ± 4.3027 / √3.
    low, high = mean_interval([1.0, 2.0, 3.0])
    np.testing.assert_allclose([low, high], [2 - 2.48414, 2 + 2.48414], atol=1e-4)
