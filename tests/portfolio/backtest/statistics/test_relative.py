import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics.assessment import Strategy, assess
from qfolio.portfolio.backtest.statistics.relative import (
    RELATIVE,
    active_share,
    bootstrap_relative,
    relative,
)

from tables import days

RETURNS = np.array([0.03, -0.02, 0.01, 0.0])
OTHER = np.array([0.02, -0.01, 0.02, -0.01])


def test_measures_by_hand() -> None:
    """Differences of 1, −1, −1 and 1%; deviations of 2.5, −2.5, 0.5, −0.5 and 1.5, −1.5, …."""
    found = relative(RETURNS, OTHER, 4)
    assert found["active_return"] == pytest.approx(0, abs=1e-15)
    assert found["tracking_error"] == pytest.approx(2 * 0.01 * math.sqrt(4 / 3))
    assert found["beta"] == pytest.approx((2.5 + 2.5 + 0.5 + 0.5) * 1.5 / (4 * 1.5**2))
    assert found["up_capture"] == pytest.approx((math.sqrt(1.03 * 1.01) - 1) / 0.02)
    assert found["down_capture"] == pytest.approx((1 - math.sqrt(0.98)) / 0.01)
    assert np.isnan(found["active_share"])
    ahead = relative(RETURNS + 0.001, OTHER, 4, np.full(4, 0.3))
    assert ahead["active_return"] == pytest.approx(0.004)
    assert ahead["information_ratio"] == pytest.approx(0.004 / found["tracking_error"])
    assert ahead["active_share"] == pytest.approx(0.3)
    assert tuple(ahead) == RELATIVE


def test_active_share_counts_cash() -> None:
    weights = np.array([[0.0, 0.5, 0.5], [1.0, 0.0, 0.0], [0.5, 0.25, 0.25]])
    benchmark = np.array([[0.0, 0.5, 0.5], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5]])
    np.testing.assert_allclose(active_share(weights, benchmark), [0, 1, 0.5])


def test_limits() -> None:
    itself = relative(OTHER, OTHER, 252)
    assert (itself["tracking_error"], itself["information_ratio"]) == (0, 0)
    rounded = relative(OTHER + np.array([1e-9, 1e-10, 0, 1e-10]), OTHER, 252)
    assert rounded["tracking_error"] > 0
    assert rounded["information_ratio"] == 0
    dearer = relative(OTHER - 1e-4, OTHER, 252)  # by the same fee in each period
    assert (dearer["tracking_error"], dearer["information_ratio"]) == (0, -math.inf)
    assert itself["beta"] == itself["up_capture"] == itself["down_capture"] == pytest.approx(1)
    rising = relative(RETURNS, [0.01, 0.011, 0.01, 0.01], 252)
    assert np.isnan(rising["down_capture"])
    cash = relative(RETURNS, np.zeros(4), 252)
    assert all(np.isnan(cash[name]) for name in ("beta", "up_capture", "down_capture"))
    ruined = relative(np.array([0.03, -1.0, 0.0, 0.0]), OTHER, 252)
    assert ruined["down_capture"] > 50


def test_histories_are_measured_as_the_days_that_they_draw() -> None:
    rng = np.random.default_rng(0)
    returns, other, share = rng.normal(0, 0.01, (3, 2, 60))
    drawn = bootstrap_relative(returns, other[0], 252, np.abs(share), 5.0, 2000, 3)
    seen = relative(returns, other[0], 252, np.abs(share))
    for name in RELATIVE:
        assert drawn[name].shape == (2000, 2)
        low, high = np.quantile(drawn[name], [0.001, 0.999], axis=0)
        assert ((low < seen[name]) & (seen[name] < high)).all(), name
    # A bootstrap of the mean has its standard error: of independent days, nearly sd / √n.
    spread = drawn["active_return"].std(axis=0) / 252
    error = (returns - other[0]).std(axis=1) / math.sqrt(60)
    np.testing.assert_allclose(spread, error, rtol=0.35)


def test_an_assessment_compares_with_its_reference() -> None:
    rng = np.random.default_rng(1)

    def made(kind: str, seeds: int, known: bool = True) -> Strategy:
        returns = rng.normal(0, 0.01, (seeds, 60))
        traded = np.full((seeds, 60), 0.02) if known else None
        weights = rng.dirichlet(np.ones(3), (seeds, 60)) if known else None
        return Strategy(kind, returns, traded, None if traded is None else traded / 10, weights)

    strategies = {
        "index": made("baseline", 1, known=False), "mine": made("strategy", 1),
        "equal": made("baseline", 1), "dqn": made("agent", 3),
    }  # fmt: skip
    found = assess(strategies, days(60), periods_per_year=252, reference="index", resamples=50)
    assert found.trials == 1 + 3
    assert found.strategies["index"].relative == {}
    assert math.isnan(found.strategies["index"].measures["turnover"].mean)
    assert found.to_json()["strategies"]["index"]["measures"]["cost_drag"]["mean"] is None
    for name in ("mine", "equal", "dqn"):
        entry = found.strategies[name]
        seen = relative(
            np.asarray(strategies[name].returns), np.asarray(strategies["index"].returns)[0], 252
        )
        for key in RELATIVE[:-1]:
            assert entry.relative[key].per_seed == pytest.approx(tuple(seen[key]))
            low, high = entry.relative[key].over_time
            assert low < high
        assert math.isnan(entry.relative["active_share"].mean)
    again = assess(strategies, days(60), periods_per_year=252, reference="equal", resamples=50)
    mine, equal = (strategies[name].weights for name in ("mine", "equal"))
    assert mine is not None
    assert equal is not None
    share = active_share(mine[0], equal[0]).mean()
    assert again.strategies["mine"].relative["active_share"].mean == pytest.approx(share)
    # A strategy of one's own is judged, and agents are judged beside it.
    judged = again.strategies["mine"].to_reference
    assert judged is not None
    assert judged.growth.p is not None
    assert again.best_baseline in ("mine", "equal", "index")
