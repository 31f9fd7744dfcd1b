"""Factors look back only, and exposures are those of the strategy."""

import numpy as np
import pytest

from qfolio.portfolio.backtest.attribution.factors import exposures, factor_returns
from qfolio.portfolio.backtest.folds import walk_forward

from planted import planted, with_a_delisted_asset


def test_factors_see_nothing_of_the_future(prices, stretches):
    folds = [fold for *_, fold in stretches]
    found = factor_returns(prices.values, folds, 1, 252)
    names = ["market", "momentum 252−21", "reversal 21", "reversal 5", "low volatility"]
    assert list(found) == [*names, "component 1", "component 2"]
    assert {len(series) for series in found.values()} == {600}
    changed = prices.values.copy()
    changed[400:] *= np.exp(np.random.default_rng(0).normal(0, 0.2, changed[400:].shape))
    after = factor_returns(changed, folds, 1, 252)
    for name, series in found.items():
        np.testing.assert_allclose(after[name][:200], series[:200], atol=1e-12)  # rows before 400
        assert abs(after[name][200:] - series[200:]).max() > 1e-6


def test_a_factor_is_its_portfolio(prices, stretches):
    """Reversal over 5 rows, by the definition."""
    found = factor_returns(prices.values, [fold for *_, fold in stretches], 1, 252)
    moves = prices.values[1:] / prices.values[:-1] - 1
    for day in (0, 17, 599):
        row = 200 + day
        fell = -np.log(prices.values[row - 1] / prices.values[row - 6])
        weights = 2 * fell.argsort().argsort() / 5 - 1
        weights /= abs(weights).sum() / 2
        assert found["reversal 5"][day] == pytest.approx(weights @ moves[row - 1])
        assert found["market"][day] == pytest.approx(moves[row - 1].mean())


def test_components_are_of_training_rows():
    prices = planted(500)
    folds = walk_forward(prices.dates, "200d", "150d", 1)
    found = factor_returns(prices.values, folds, 1, 252)
    moves = prices.values[1:] / prices.values[:-1] - 1
    active = moves - moves.mean(1, keepdims=True)
    fold = folds[1]
    seen = active[fold.train.start : fold.train.stop - 1]
    vector = np.linalg.svd(seen, full_matrices=False)[2][0]
    vector /= abs(vector).sum() / 2
    expected = active[349:499] @ vector
    got = found["component 1"][150:]
    np.testing.assert_allclose(got, np.sign(got @ expected) * expected, atol=1e-12)


@pytest.mark.parametrize("carry", [0.0, 0.03])
def test_interest_on_cash_and_dividends_are_no_alpha(prices, stretches, carry):
    """An agent that holds half of its wealth in cash, which earns 5% a year."""
    folds, rate = [fold for *_, fold in stretches], np.full(600, 0.05 / 252)
    market = factor_returns(prices.values, folds, 1, 252)["market"] + carry / 252
    relatives = prices.values[200:800] / prices.values[199:799]
    growth = np.column_stack([1 + rate, relatives + carry / 252])
    found = factor_returns(prices.values, folds, 1, 252, growth=growth)
    np.testing.assert_allclose(found["market"], market - rate, atol=1e-12)
    noise = np.random.default_rng(0).normal(0, 1e-5, 600)
    left = exposures((market + rate) / 2 + noise - market, {"market": found["market"]}, 252)
    assert left is not None
    assert left.factors[0].beta == pytest.approx(-0.5, abs=1e-3)
    assert left.alpha == pytest.approx(0, abs=1e-3)  # and not 2.5%


@pytest.mark.parametrize(("per_year", "names"), [
    (12, ["market", "momentum 12−1", "reversal 1", "low volatility"]),
    (1, ["market"]),
])  # fmt: skip
def test_lengths_follow_the_frequency(prices, stretches, per_year, names):
    found = factor_returns(prices.values, [fold for *_, fold in stretches], 1, per_year)
    assert [name for name in found if "component" not in name] == names


def test_exposures_are_recovered():
    rng = np.random.default_rng(0)
    market, tilt = rng.normal(0, 0.01, (2, 2000))
    factors = {"market": market, "tilt": tilt, "same": 2 * market, "none": np.zeros(2000)}
    active = 0.0002 - 0.3 * market + 0.1 * tilt + rng.normal(0, 1e-3, 2000)
    found = exposures(active, factors, 252)
    assert found is not None
    assert [each.name for each in found.factors] == ["market", "tilt"]
    assert [each.beta for each in found.factors] == pytest.approx([-0.3, 0.1], abs=0.01)
    assert found.alpha == pytest.approx(0.0504, abs=0.03)
    assert found.alpha_t > 3
    assert found.r2 == pytest.approx(0.9, abs=0.03)
    assert exposures(active[:8], {"market": market[:8]}, 252) is None


@pytest.mark.parametrize(("assets", "components"), [(1, 0), (2, 0), (3, 1), (4, 2)])
def test_few_assets_have_few_components(prices, stretches, assets, components):
    folds = [fold for *_, fold in stretches]
    found = factor_returns(prices.values[:, :assets], folds, 1, 252)
    assert sum("component" in name for name in found) == components
    assert all(np.isfinite(series).all() for series in found.values())
    left = exposures(found["market"] + 1e-3, found, 252)
    assert left is not None
    assert left.factors[0].beta == pytest.approx(1)


def test_factors_do_not_hold_what_is_delisted(prices, stretches):
    folds = [fold for *_, fold in stretches][1:]
    full = with_a_delisted_asset(prices)
    expected = factor_returns(prices.values, folds, 1, 252)
    found = factor_returns(full.values, folds, 1, 252, full.tradable)
    assert list(found) == list(expected)
    for name, series in expected.items():
        np.testing.assert_allclose(found[name], series, atol=1e-12, err_msg=name)
