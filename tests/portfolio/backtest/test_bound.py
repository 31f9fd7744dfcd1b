"""The bound on constant weights: it is reached, and it is not exceeded."""

import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.bound import constant_bound
from qfolio.portfolio.backtest.simulation import simulate

from tables import random_walk


def growth(prices: np.ndarray) -> np.ndarray:
    """Growth factors of cash and each asset; an asset without a price is worth as much as cash."""
    relatives = np.nan_to_num(prices[1:] / prices[:-1], nan=1.0)
    return np.column_stack([np.ones(len(relatives)), relatives])


def test_the_bound_of_covers_example() -> None:
    # Cash and a stock that doubles and halves in turn: half in each grows by √(9/8) a row.
    prices = np.array([[3.0], [1.0], [2.0], [1.0], [2.0], [1.0]])
    assert constant_bound(growth(prices[1:]), 12) == pytest.approx((9 / 8) ** 6 - 1)


def test_no_constant_weights_grow_more() -> None:
    rng = np.random.default_rng(0)
    prices = random_walk(301, 4, rng, 5e-4, 0.02)
    prices[:100, 2] = np.nan
    bound = constant_bound(growth(prices), 252)
    assert bound is not None
    tried = rng.dirichlet(np.full(5, 0.5), 500)[:, None].repeat(300, axis=1)
    tried[:, :100, 0] += tried[:, :100, 3]  # cash instead of what has no price yet
    tried[:, :100, 3] = 0
    for cost in (0.0, 0.001):
        found = simulate(prices, tried, first=0, cost=cost, lag=0)
        assert np.expm1(252 * found.growth.mean(-1)).max() <= bound
    assert bound < math.inf


def test_a_bound_beyond_all_floats_is_infinite() -> None:
    """A few minutes, each of which doubles the price."""
    assert constant_bound(np.tile([1.0, 2.0], (9, 1)), 98_280) == math.inf


def test_without_a_certificate_there_is_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("qfolio.solvers.merton.TOLERANCE", -1.0)
    assert constant_bound(np.ones((4, 3)), 252) is None
