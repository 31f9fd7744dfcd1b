"""Slices, gradients and rules of policies that are known."""

import equinox as eqx
import numpy as np
import pytest

from qfolio.portfolio.backtest.attribution.distillation import distil
from qfolio.portfolio.backtest.attribution.gradients import DAYS, integrated_gradients
from qfolio.portfolio.backtest.attribution.replays import channels
from qfolio.portfolio.backtest.attribution.slices import slices
from qfolio.portfolio.backtest.replay import decide

from planted import ASSETS, NAMES, Known, four_folds, planted, with_a_delisted_asset

SHARED = [False, False, False, True]


def held(days=600):
    return np.full((days, ASSETS + 1), 1 / (ASSETS + 1))


def test_the_rule_is_recovered(stretches):
    begin, end = stretches[0].fold.decisions.start, stretches[-1].fold.decisions.stop
    targets = decide(Known("momentum"), stretches, 1, together=True)[0, :, 1:]
    seen = np.asarray(channels(stretches[0].task))[begin:end].astype(float)
    open_to = np.ones_like(targets)
    fitted = np.repeat([True, False, True, False], 150)
    rule = distil(targets, 0 * targets, seen, NAMES, open_to, fitted)
    terms = {term.name: term for term in rule.terms}
    assert terms["momentum:20"].coefficient == pytest.approx(0.5 / ASSETS, rel=1e-4)
    spread = np.std(np.linspace(-1, 1, ASSETS))
    assert terms["momentum:20"].per_deviation == pytest.approx(0.5 / ASSETS * spread, rel=1e-4)
    assert abs(terms["reversal:3"].per_deviation) < 1e-6
    assert rule.shared == ["market-volatility:20"]
    assert rule.r2 == pytest.approx(1, abs=1e-6)
    noise = targets + np.random.default_rng(0).normal(0, 0.1, targets.shape)
    assert distil(noise, 0 * targets, seen, NAMES, open_to, fitted).r2 == pytest.approx(
        0.2, abs=0.1
    )
    turned = np.where(fitted[:, None], targets, -targets)  # tested on the folds not fitted on
    found = distil(turned, 0 * targets, seen, NAMES, open_to, fitted).r2
    assert found is not None
    assert found < -1
    same = distil(0 * targets, 0 * targets, seen, NAMES, open_to, fitted)
    assert same.r2 is None


def test_gradients_add_up_and_name_the_driver(stretches):
    found = integrated_gradients(Known("momentum"), stretches, NAMES, held())
    assert found is not None
    pulls = {pull.name: pull for pull in found.pulls}
    momentum = pulls.pop("momentum:20")
    assert found.gap < 1e-6
    assert momentum.size == pytest.approx(found.whole, rel=1e-3)
    assert momentum.size == pytest.approx(0.5 / ASSETS * abs(np.linspace(-1, 1, ASSETS)).mean(),
                                          rel=1e-3)  # fmt: skip
    assert momentum.direction == pytest.approx(1, abs=1e-3)
    assert all(pull.size == 0 for pull in pulls.values())


def test_slices_draw_the_rule(stretches):
    found = slices(Known("momentum"), stretches, NAMES, list("ABCDEF"), held(), SHARED)
    assert (found.asset, found.partner) == ("A", "B")
    drawn = {each.name: each for each in found.signals}
    x = np.array(drawn["momentum:20"].x)
    for lines in (drawn["momentum:20"].lines, drawn["momentum:20"].above):
        assert np.shape(lines) == (4, 17)
        np.testing.assert_allclose(lines[0], (1 + 0.5 * x) / ASSETS, rtol=1e-4)
    assert np.ptp(drawn["reversal:3"].lines) == 0
    assert [each.shared for each in found.signals] == SHARED
    np.testing.assert_allclose(found.holding.lines, 1 / ASSETS, rtol=1e-5)


def test_slices_draw_the_edges_of_a_band(stretches):
    found = slices(Known("band"), stretches, NAMES, list("ABCDEF"), held(), SHARED)
    momentum = found.signals[1]
    x = np.array(momentum.x)
    edge = 0.1 * (1 + np.maximum(0.4 * x, 0.6 * x))  # of the seed that wants more
    np.testing.assert_allclose(momentum.lines[0], edge, rtol=1e-4)
    np.testing.assert_allclose(momentum.above[0], 0.16, rtol=1e-4)
    x = np.array(found.holding.x)
    np.testing.assert_allclose(found.holding.lines[0], np.clip(x, 0.1, 0.16), rtol=1e-4)


def test_a_single_asset_has_no_rule():
    one = np.random.default_rng(0).uniform(size=(40, 1))
    rule = distil(one, 0 * one, one[..., None], ["x"], np.ones_like(one), np.arange(40) < 20)
    assert (rule.terms, rule.r2, rule.shared) == ([], None, ["x"])


def test_a_delisted_asset_dilutes_no_average(stretches):
    """It has no weight that a signal could move, and its signals of 0 are no observations."""
    apart = four_folds(with_a_delisted_asset(planted()))
    weights = np.full((600, ASSETS + 2), 1 / (ASSETS + 2))
    found = integrated_gradients(Known("momentum"), apart, NAMES, weights)
    assert found is not None
    momentum = next(pull for pull in found.pulls if pull.name == "momentum:20")
    expected = 0.5 / ASSETS * abs(np.linspace(-1, 1, ASSETS)).mean()  # as without it
    assert momentum.size == pytest.approx(expected, rel=1e-3)
    drawn = slices(Known("market"), apart, NAMES, list("ABCDEFG"), weights, SHARED).signals[3]
    alone = slices(Known("market"), stretches, NAMES, list("ABCDEF"), held(), SHARED).signals[3]
    assert drawn.x == pytest.approx(alone.x, abs=1e-4)


@pytest.mark.parametrize("folds", [2, 0])
def test_days_on_which_nothing_can_be_bought_are_left_out(folds):
    apart = four_folds(with_a_delisted_asset(planted()))
    cut, there = apart[folds].fold.decisions.start, apart[0].task.tradable
    closed = there.at[cut:].set(False)
    apart = [each._replace(task=eqx.tree_at(lambda t: t.tradable, each.task, closed))
             for each in apart]  # fmt: skip
    weights = np.full((600, ASSETS + 2), 1 / (ASSETS + 2))
    found = integrated_gradients(Known("momentum"), apart, NAMES, weights)
    assert (found.days if found else 0) == DAYS * folds // 4
    assert found is None or np.isfinite([found.whole, found.gap]).all()
