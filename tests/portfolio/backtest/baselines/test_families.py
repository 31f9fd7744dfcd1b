"""Each family's formulas, worked out by hand."""

import numpy as np
import pytest
import skfolio.optimization

from qfolio.portfolio.backtest.baselines import Baseline, History, baseline
from qfolio.portfolio.backtest.baselines.base import nearest
from qfolio.portfolio.backtest.baselines.online import Olmar, Pamr
from qfolio.portfolio.backtest.baselines.optimizers import HierarchicalRiskParity

from tables import days


def history(prices: np.ndarray, month: int = 21, cap: float = 1.0) -> History:
    rows, assets = prices.shape
    return History(days(rows), prices, slice(0, rows), np.ones(assets, bool), cap, month)


def decide(name: str | Baseline, prices: np.ndarray, held: np.ndarray, **more: float) -> np.ndarray:
    made = baseline(name) if isinstance(name, str) else name
    found = made.decide(history(prices, **more), held)  # type: ignore[arg-type]
    assert found is not None
    return found[1:]


def cash(assets: int) -> np.ndarray:
    return np.eye(assets + 1)[0]


# ------------------------------------------------------------------------- Equal weights in a band


def test_a_weight_that_leaves_the_band_goes_back_to_its_edge() -> None:
    flat, band = np.ones((3, 4)), baseline("equal-weight-band")
    np.testing.assert_allclose(decide(band, flat, cash(4)), 0.25)
    inside = np.array([0, 0.30, 0.20, 0.25, 0.25])  # a fifth of .25 is .05: both at the edge
    assert band.decide(history(flat), inside) is None
    outside = np.array([0, 0.34, 0.22, 0.22, 0.22])
    np.testing.assert_allclose(decide(band, flat, outside), [0.30, 0.7 / 3, 0.7 / 3, 0.7 / 3])
    # An order may not exceed the cap, though a holding may have drifted above it.
    np.testing.assert_allclose(
        decide(band, flat, outside, cap=0.28), [0.28, 0.24, 0.24, 0.24], rtol=1e-12
    )


def test_nearest_weights_between_bounds() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        wanted = rng.normal(scale=rng.choice([0.1, 1, 1000]), size=6)
        low, high = rng.uniform(0, 1 / 6, 6), rng.uniform(1 / 6, 1, 6)
        found = nearest(wanted, low, high)
        assert found.sum() == pytest.approx(1, abs=1e-9)
        assert (low - 1e-12 <= found).all()
        assert (found <= high + 1e-12).all()
        # No other weights are nearer: the shift is the same for all strictly between the bounds.
        inside = (found > low + 1e-9) & (found < high - 1e-9)
        if inside.any():
            shift = (wanted - found)[inside]
            assert np.ptp(shift) < 1e-9
            assert (wanted - found >= shift.mean() - 1e-9)[found >= high - 1e-9].all()
            assert (wanted - found <= shift.mean() + 1e-9)[found <= low + 1e-9].all()
    np.testing.assert_array_equal(nearest(np.zeros(3), 0, 0.2), [0.2] * 3)  # cash is left


# ------------------------------------------------------------------------------------ Risk parity


@pytest.mark.parametrize("assets", [1, 2, 3, 12])
def test_hierarchical_risk_parity_is_that_of_skfolio(assets: int) -> None:
    rng = np.random.default_rng(0)
    common = rng.normal(size=(200, 1)) * rng.normal(size=assets)
    returns = 0.01 * (common + rng.normal(size=(200, assets)) * rng.uniform(0.5, 2, assets))
    found = HierarchicalRiskParity().fit(returns, 1.0)
    expected = skfolio.optimization.HierarchicalRiskParity().fit(returns).weights_
    np.testing.assert_allclose(found, expected, rtol=1e-9)


# ---------------------------------------------------------------------------------- Timing, trend


def test_timing_of_assets_by_reward_to_risk() -> None:
    wave = np.array([1.0, -1.0] * 30)[:, None]
    returns = np.array([0.002, 0.001, -0.001]) + wave * np.array([0.01, 0.01, 0.01])
    prices = np.concatenate([np.ones((1, 3)), np.cumprod(1 + returns, axis=0)])
    # Mean over variance as 2 : 1 : 0, squared.
    np.testing.assert_allclose(decide("reward-to-risk-timing", prices, cash(3)), [0.8, 0.2, 0])
    falling = np.concatenate([np.ones((1, 3)), np.cumprod(1 + returns - 0.01, axis=0)])
    with pytest.warns(UserWarning, match="no asset is worth holding"):
        found = decide("reward-to-risk-timing", falling, cash(3))
    np.testing.assert_allclose(found, 1 / 3)


def test_momentum_skips_the_latest_month() -> None:
    prices = np.ones((200, 6))
    # Twelve months of two rows: from row 175 to row 197; the last two rows do not count.
    prices[176:, 0] = 2.0
    prices[190:, 1] = 3.0
    prices[198:, 2] = 9.0
    prices[:175, 3] = 0.1  # before the year
    chosen = decide("momentum", prices, cash(6), month=2)
    np.testing.assert_allclose(chosen, [0.5, 0.5, 0, 0, 0, 0])
    # With a cap of .3 four assets are held, so that no cash is left.
    capped = decide("momentum", prices, cash(6), month=2, cap=0.3)
    assert capped.sum() == pytest.approx(1)
    np.testing.assert_allclose(capped[:2], 0.25)
    # Less than a month and a row: no asset has a past.
    np.testing.assert_allclose(decide("momentum", prices[:3], cash(6), month=2), 1 / 6)


def test_trend_goes_to_cash() -> None:
    prices = np.ones((100, 3))
    prices[-20:, 0] = np.linspace(1, 2, 20)  # above its average of twenty rows
    prices[-20:, 1] = np.linspace(2, 1, 20)  # below it
    prices[:-20, 1] = 0.1  # but above that of all rows
    found = baseline("trend").decide(history(prices, month=2), cash(3))
    assert found is not None
    np.testing.assert_allclose(found, [2 / 3, 1 / 3, 0, 0])  # the third does not move: not above


# -------------------------------------------------------------------------------------- On-line


def drifted(target: np.ndarray, relatives: np.ndarray) -> np.ndarray:
    worth = target * relatives
    return np.concatenate([[0], worth / worth.sum()])


def test_passive_aggressive_mean_reversion_by_hand() -> None:
    prices = np.array([[1.0, 1.0, 1.0], [1.1, 1.0, 0.9]])
    target = np.array([0.5, 0.3, 0.2])
    # b·x = 1.03, so the loss is .53; x − x̄ = (.1, 0, −.1) of square .02: τ = 26.5, and
    # b − τ(x − x̄) = (−2.15, .3, 2.85), whose nearest weights are (0, 0, 1).
    held = drifted(target, prices[1])
    np.testing.assert_allclose(decide("pamr", prices, held), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(Pamr().step(target, prices), [-2.65, 0, 2.65])
    # A fall below ε = .5 is no loss to it: it stays passive, on the target before the drift.
    crash = np.array([[1.0, 1.0, 1.0], [0.4, 0.5, 0.3]])
    found = decide("pamr", crash, drifted(target, crash[1]))
    np.testing.assert_allclose(found, target, rtol=1e-12)


def test_moving_average_reversion_by_hand() -> None:
    prices = np.array([[9.0, 9.0], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [2.0, 1.0]])
    target = np.array([0.5, 0.5])
    # Averages of five rows over the latest price: 1.2/2 = .6 and 1.8/1 = 1.8; the middle is 1.2,
    # and (10 − 1.2)/(.36 + .36) times (−.6, .6) is the step.
    step = 8.8 / 0.72 * 0.6
    np.testing.assert_allclose(Olmar().step(target, prices), [-step, step])
    held = drifted(target, prices[-1] / prices[-2])
    np.testing.assert_allclose(decide("olmar", prices, held), [0, 1], atol=1e-12)
    np.testing.assert_allclose(decide("olmar", prices, held, cap=0.7), [0.3, 0.7], atol=1e-12)


@pytest.mark.parametrize("name", ["olmar", "pamr", "minimum-variance-ledoit-wolf"])
def test_months_of_few_rows_do_not_starve_a_rule(name: str) -> None:
    """On monthly prices a rule sees the rows that it needs, not the one row of a month."""
    rng = np.random.default_rng(1)
    prices = np.cumprod(1 + rng.normal(0, 0.03, (300, 3)), axis=0)
    held = np.array([0, 0.5, 0.3, 0.2])
    found = decide(name, prices, held, month=1)
    months = decide(name, prices, held, month=5)  # with 60 rows a year
    np.testing.assert_allclose(found, months, rtol=1e-12)
    assert not np.allclose(decide(name, prices[-4:], held, month=1), found) or name == "pamr"


@pytest.mark.parametrize("name", ["pamr", "olmar"])
def test_online_rules_stay_where_all_assets_move_alike(name: str) -> None:
    prices = np.cumprod(np.full((6, 3), 1.1), axis=0)
    target = np.array([0.5, 0.3, 0.2])
    np.testing.assert_allclose(decide(name, prices, np.append(0, target)), target, rtol=1e-12)
    np.testing.assert_allclose(decide(name, prices, cash(3)), 1 / 3)
