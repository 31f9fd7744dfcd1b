import numpy as np
import pytest

from qfolio.report.backtest.convergence import POINTS, FoldTraining, convergence_sentences
from qfolio.report.backtest.page import render_backtest

from backtests import make_data, make_series
from tables import weekdays


def training(slope_at_end, seed=0):
    """400 episodes whose returns rise at first, and at the end by this much."""
    steps = np.concatenate(
        [np.linspace(0, 1, 200), np.ones(100), np.linspace(1, 1 + slope_at_end, 100)]
    )
    return steps + np.random.default_rng(seed).normal(0, 0.1, 400)


def fold_of(returns):
    fold = FoldTraining.of(returns)
    assert fold is not None
    return fold


@pytest.mark.parametrize(("slope", "rising"), [(0.5, True), (0.0, False), (-0.5, False)])
def test_rising_is_what_the_last_quarter_gains(slope, rising):
    returns = training(slope)
    fold = fold_of(returns)
    assert fold.rising == rising
    assert fold.curve.shape == (POINTS,)
    assert fold.curve[0] == pytest.approx(returns[:20].mean())


def test_noise_alone_does_not_rise():
    folds = [fold_of(np.random.default_rng(i).normal(size=400)) for i in range(100)]
    assert sum(fold.rising for fold in folds) <= 8  # 2.3 expected


def test_seeds_that_differ_do_not_look_like_progress():
    """Rows come a lap of all environments at a time, one seed after another."""
    rng = np.random.default_rng(0)
    laps, seeds, environments = 7, 5, 32
    numbers = np.arange(laps * environments).reshape(laps, 1, environments)
    episodes = np.broadcast_to(numbers, (laps, seeds, environments)).ravel()
    better = np.broadcast_to(np.arange(seeds)[:, None], (laps, seeds, environments)).ravel()
    returns = better + rng.normal(0, 0.1, better.size)
    fold = FoldTraining.of(returns, episodes)
    assert fold is not None
    assert np.ptp(fold.curve) < 0.1
    assert not fold.rising
    mixed = FoldTraining.of(returns)
    assert mixed is not None
    assert np.ptp(mixed.curve) > 1


def test_few_episodes_say_nothing():
    assert FoldTraining.of(np.zeros(2 * POINTS - 1)) is None


def test_the_page_says_whether_training_converged():
    rng = np.random.default_rng(0)
    series = {"dqn": make_series(rng, "agent", 2, 300, 3, 0.0),
              "equal weight": make_series(rng, "baseline", 1, 300, 3, 0.0)}  # fmt: skip
    folds = [fold_of(training(slope, i)) for i, slope in enumerate((2.0, 0.0))]
    data = make_data(series, weekdays(300), ("A", "B", "C"), training={"dqn": folds})
    page = render_backtest(data)
    assert (
        "dqn: in 1 of 2 folds the returns were still rising; training for longer may help." in page
    )
    assert page.count("Returns of training episodes, fold by fold") == 1
    without = render_backtest(make_data(series, weekdays(300), ("A", "B", "C")))
    assert "Did training converge?" not in without
    assert convergence_sentences({"a": [folds[1]]}) == [
        "a: in none of 1 folds were the returns still rising."
    ]
