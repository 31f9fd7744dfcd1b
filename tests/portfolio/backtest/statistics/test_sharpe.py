"""Probabilistic and deflated Sharpe ratios, against the figures of their papers."""

import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics.sharpe import (
    SharpeTest,
    deflated_sharpe,
    expected_maximum_sharpe,
    minimum_track_record,
    probabilistic_sharpe,
    sharpe_tests,
)


def test_probabilistic_sharpe_of_the_paper() -> None:
    # Bailey & López de Prado (2012): 24 months, Sharpe ratio 0.458 a month.
    assert probabilistic_sharpe(0.458, 24, 0, 3) == pytest.approx(0.982, abs=5e-4)
    assert probabilistic_sharpe(0.458, 24, -2.448, 10.164) == pytest.approx(0.913, abs=5e-4)


def test_probabilistic_sharpe_by_hand() -> None:
    # √(1 + 0.5 · 0.2 + 5/4 · 0.04) = √1.15, (0.2 − 0.1) · 10 / √1.15 = 0.9325; Φ = 0.82447.
    assert probabilistic_sharpe(0.2, 101, -0.5, 6, 0.1) == pytest.approx(0.82447, abs=1e-5)
    assert probabilistic_sharpe(0.1, 101, -0.5, 6, 0.1) == 0.5
    assert probabilistic_sharpe(math.inf, 10, 0, 3) == 1
    assert probabilistic_sharpe(-math.inf, 10, 0, 3) == 0


@pytest.mark.parametrize(("per_year", "years"), [(252, 2.73), (52, 2.83), (12, 3.24)])
def test_minimum_track_record_of_the_paper(per_year: int, years: float) -> None:
    # An annual Sharpe ratio of 2 is to be shown above 1 with normal returns.
    periods = minimum_track_record(2 / math.sqrt(per_year), 0, 3, 1 / math.sqrt(per_year))
    assert periods / per_year == pytest.approx(years, abs=5e-3)


def test_minimum_track_record_of_the_paper_for_hedge_funds() -> None:
    periods = minimum_track_record(2 / math.sqrt(12), -0.72, 5.78, 1 / math.sqrt(12))
    assert periods / 12 == pytest.approx(4.99, abs=5e-3)


def test_minimum_track_record_inverts_the_probability() -> None:
    periods = minimum_track_record(0.1, -1, 8, 0.02, 0.9)
    assert probabilistic_sharpe(0.1, math.ceil(periods), -1, 8, 0.02) >= 0.9
    assert probabilistic_sharpe(0.1, math.floor(periods), -1, 8, 0.02) < 0.9
    assert minimum_track_record(0.1, 0, 3, 0.1) == math.inf
    assert minimum_track_record(math.inf, 0, 3) == 1


def test_expected_maximum_sharpe() -> None:
    # The best of N standard normal draws, by simulation, and one trial picks nothing.
    best = np.random.default_rng(8).standard_normal((20_000, 40)).max(axis=1).mean()
    assert expected_maximum_sharpe(40, 1.0) == pytest.approx(best, rel=0.02)
    assert expected_maximum_sharpe(40, 0.25) == pytest.approx(expected_maximum_sharpe(40, 1) / 2)
    assert expected_maximum_sharpe(1, 1.0) == 0


def test_deflated_sharpe_of_the_paper() -> None:
    # Bailey & López de Prado (2014): annual Sharpe ratio 2.5 over five years of 250 days, chosen
    # from 100 trials whose annual Sharpe ratios have the variance 1/2.
    sharpe, variance = 2.5 / math.sqrt(250), 0.5 / 250
    assert expected_maximum_sharpe(100, variance) == pytest.approx(0.1132, abs=5e-5)
    assert deflated_sharpe(sharpe, 1250, -3, 10, 100, variance) == pytest.approx(0.9004, abs=5e-5)
    assert deflated_sharpe(sharpe, 1250, -3, 10, 46, variance) == pytest.approx(0.9505, abs=5e-5)
    assert deflated_sharpe(sharpe, 1250, 0, 3, 88, variance) == pytest.approx(0.9505, abs=5e-5)


def test_a_bad_trial_is_no_sign_of_luck() -> None:
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((3, 1000))
    noise = (noise - noise.mean(1, keepdims=True)) / noise.std(1, keepdims=True)

    def tests(**means: list[float]) -> dict[str, SharpeTest]:
        returns = {
            name: np.array(mean)[:, None] + noise[: len(mean)] for name, mean in means.items()
        }
        year = math.sqrt(252)
        ratios = {name: year * each.mean(1) / each.std(1) for name, each in returns.items()}
        return sharpe_tests(returns, ratios, list(means), 10, 252)

    alone = tests(good=[0.1, 0.1, 0.1])["good"]
    luck = math.sqrt(252) * expected_maximum_sharpe(10, 1 / 999)
    assert alone.threshold == pytest.approx(luck)
    beside = tests(good=[0.1, 0.1, 0.1], bad=[-2.0, -2.0, -2.0], fund=[-3.0])["good"]
    assert beside.threshold == pytest.approx(luck)
    spread = tests(good=[0.1, 0.1, 0.1], wild=[-0.1, 0.0, 0.1])["good"]
    # Variances by hand: 0 and 0.01 with two degrees of freedom each, a period.
    wide = math.sqrt(252) * expected_maximum_sharpe(10, 0.005)
    assert spread.threshold == pytest.approx(wide)
