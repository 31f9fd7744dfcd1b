"""Anchors: a baseline followed on a whole table, without look-ahead, or a column of weights."""

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.registry import BASELINES
from qfolio.portfolio import anchors
from qfolio.portfolio.backtest.baselines import Baseline
from qfolio.portfolio.task import LEAST, Portfolio

from tables import price_table, random_walk

ROWS = 320


def table(rows=ROWS, features=None, late=False):
    values = random_walk(rows, 4, volatility=0.01 * np.array([1, 2, 1, 3]))
    if late:
        values[:60, 3] = np.nan
    if features is None:
        return price_table(values)
    return price_table(values, features=features[..., None], feature_names=("weight",))


@pytest.mark.parametrize("name", BASELINES)
def test_a_row_depends_on_no_later_one(name):
    whole = anchors.path(name, table())
    assert whole.min() >= 0
    assert whole.sum(1).max() <= 1 + 1e-9
    np.testing.assert_array_equal(anchors.path(name, table(290)), whole[:290])


def test_equal_weights_stay_equal_and_monthly_ones_drift():
    np.testing.assert_allclose(anchors.path("equal-weight", table()), 0.25)
    prices = table()
    found = anchors.path("equal-weight-monthly", prices)
    month = round(prices.periods_per_year / 12)
    np.testing.assert_allclose(found[month], 0.25)
    grown = prices.values[month + 3] / prices.values[month]
    np.testing.assert_allclose(found[month + 3], grown / grown.sum())


def test_an_asset_joins_after_a_year_of_prices():
    found = anchors.path("inverse-volatility", table(late=True))
    assert not found[:60, 3].any()
    assert found[:60, :3].sum(1).min() > 0.99


class Debt(Baseline):
    def decide(self, history, held):
        return np.array([-1.0, 2.0, 0.0, 0.0, 0.0])


def test_a_baseline_with_invalid_weights_is_named():
    with pytest.raises(QfolioError, match=r"Debt at 2020-01-03 .* minimum of -1"):
        anchors.path(f"{__name__}:Debt", table())


def test_a_column_of_weights():
    weights = np.tile([0.4, 0.3, 0.2, 0.1], (ROWS, 1))
    np.testing.assert_array_equal(anchors.path("feature:weight", table(features=weights)), weights)
    with pytest.raises(QfolioError, match="add up to at most 1"):
        anchors.path("feature:weight", table(features=2 * weights))
    with pytest.raises(QfolioError, match="has no column missing"):
        anchors.path("feature:missing", table())
    with pytest.raises(QfolioError, match="no baseline 'nothing'"):
        anchors.path("nothing", table())


def test_several_baselines_are_averaged_at_each_row():
    both = anchors.path("volatility-timing+minimum-variance", table())
    each = [anchors.path(name, table()) for name in ("volatility-timing", "minimum-variance")]
    np.testing.assert_allclose(both, (each[0] + each[1]) / 2)
    assert np.abs(each[0] - each[1]).max() > 0.1
    with pytest.raises(QfolioError, match="no baseline 'nothing'"):
        anchors.path("equal-weight+nothing", table())
    with pytest.raises(QfolioError, match="no baseline ''"):
        anchors.path("equal-weight+", table())
    weights = np.tile([0.4, 0.3, 0.2, 0.1], (ROWS, 1))
    found = anchors.path("equal-weight+feature:weight", table(features=weights))
    np.testing.assert_allclose(found, (weights + 0.25) / 2)


@pytest.mark.parametrize("anchor", ["column:weight", "equal-weight+column:weight"])
def test_what_an_anchor_may_be_is_said(anchor):
    said = (
        "no anchor 'column:weight', because .* module column; .* as module:Name, .* as feature:NAME"
    )
    with pytest.raises(QfolioError, match=said):
        Portfolio.of(table(), window=1, horizon=10, anchor=anchor)


def test_a_task_checks_each_baseline_of_its_anchor():
    with pytest.raises(QfolioError, match="no baseline 'olmer'; did you mean olmar"):
        Portfolio.of(table(), window=1, horizon=10, anchor="equal-weight+olmer")


def test_what_cannot_be_traded_goes_to_the_others():
    task = Portfolio.of(table(), window=1, horizon=10, anchor="equal-weight")
    part = task.part(0, 200, np.array([True, True, True, False]))
    weights = np.asarray(part.anchor_weights(jnp.array(50)))
    np.testing.assert_allclose(weights, [1 / 3, 1 / 3, 1 / 3, 0], atol=1e-6)
    assert weights[3] == 0
    sparse = Portfolio.of(table(), window=1, horizon=10, anchor="momentum")
    held = np.asarray(sparse.anchor_weights(jnp.array(300)))
    assert held.min() == pytest.approx(LEAST / 4)  # not 0: it may be traded


def test_a_delisted_asset_has_no_weight_in_a_column():
    weights = np.tile([0.25] * 4, (ROWS, 1))
    weights[200:] = [1 / 3, 1 / 3, 1 / 3, 0.25]  # its last number remains
    listed = np.ones(weights.shape, bool)
    listed[200:, 3] = False
    prices = price_table(
        table().values, features=weights[..., None], feature_names=("weight",), listed=listed
    )
    found = anchors.path("feature:weight", prices)
    np.testing.assert_array_equal(found, np.where(listed, weights, 0))
    alone = anchors.path(prices.assets[3], prices)
    np.testing.assert_array_equal(alone, np.where(listed, [0, 0, 0, 1], 0))
