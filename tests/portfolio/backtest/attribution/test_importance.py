"""What a signal is worth, where it is known what the policy follows."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.backtest.attribution import importance as module
from qfolio.portfolio.backtest.attribution import replays
from qfolio.portfolio.backtest.attribution.importance import importance
from qfolio.portfolio.backtest.attribution.replays import Shuffle, Shuffles, replay
from qfolio.portfolio.backtest.replay import decide

from planted import NAMES, Known, four_folds, planted, with_a_delisted_asset


def found(rule, stretches, prices):
    return importance(Known(rule), stretches, NAMES, prices.values, 252)


def test_a_planted_signal_is_found_and_nothing_else(stretches, prices):
    worth, _ = found("momentum", stretches, prices)
    by_name = {each.name: each for each in worth.signals}
    momentum = by_name.pop("momentum:20")
    assert momentum.lost > 0.05
    assert momentum.t > 2
    assert momentum.low <= momentum.lost <= momentum.high
    assert all(each.lost == each.low == each.high == 0 for each in by_name.values())
    assert worth.everything.lost == pytest.approx(momentum.lost, rel=0.5)
    assert not worth.ignored
    assert (worth.draws, worth.seeds, worth.replays) == (3, 2, 1 + 3 * 5)


def test_replays_in_groups_are_those_of_one(stretches, monkeypatch):
    shuffles = Shuffles.drawn(stretches, 1, 63, 0)
    wanted = [Shuffle(mask, 1, 1) for mask in np.tri(5, 4, -1, dtype=int)]
    policy = Known("momentum")

    def replayed():
        groups = [group.targets for group in replay(policy, stretches, shuffles, wanted)]
        return [len(group) for group in groups], np.concatenate(groups)

    whole, targets = replayed()
    monkeypatch.setattr(replays, "AT_ONCE", 2)
    parts, again = replayed()
    assert (whole, parts) == ([5], [2, 2, 1])
    np.testing.assert_allclose(again, targets, atol=1e-6)
    # The first replay shuffles nothing: it is the policy itself.
    decided = decide(policy, stretches, 1, together=True)
    np.testing.assert_allclose(targets[:1], decided, atol=1e-6)


def test_a_shared_signal_is_shuffled_in_time(stretches, prices):
    worth, _ = found("market", stretches, prices)
    assert [each.shared for each in worth.signals] == [False, False, False, True]
    assert [each.high > each.low for each in worth.signals] == [False, False, False, True]


def test_an_agent_that_sees_nothing_is_told(stretches, prices):
    worth, _ = found("constant", stretches, prices)
    assert worth.ignored
    assert worth.everything.lost == 0


def test_equal_draws_give_equal_results(stretches, prices):
    assert found("momentum", stretches, prices)[0] == found("momentum", stretches, prices)[0]


def test_shuffles_keep_what_they_do_not_touch(stretches):
    drawn = Shuffles.drawn(stretches, 2, 63, 0)
    begin, end = stretches[0].fold.decisions.start - 1, stretches[-1].fold.decisions.stop
    count = end - begin
    assert drawn.begin == begin
    assert (drawn.rows[0, :count] == np.arange(begin, end)).all()
    assert (drawn.assets[0] == np.arange(6)).all()
    for draw in (1, 2):
        assert sorted(drawn.rows[draw, :count]) == list(range(begin, end))
        assert (np.sort(drawn.assets[draw]) == np.arange(6)).all()
        changes = (np.diff(drawn.assets[draw], axis=0) != 0).any(1).sum()
        assert 0 < changes <= count // 63


def test_replays_are_bounded(stretches, prices, monkeypatch):
    """With less room: one draw, then one seed, then everything at once only."""
    days, each = 600, 6 * 2 * 4
    for room, expected in ((6, (4, 1, 2)), (3, (4, 1, 1)), (1, (0, 1, 1))):
        monkeypatch.setattr(module, "WORK", days * each * 2 * room)
        worth, _ = found("momentum", stretches, prices)
        assert (len(worth.signals), worth.draws, worth.seeds) == expected
        assert worth.everything.lost > 0


def test_the_signals_of_a_single_asset_are_shuffled_in_time():
    prices = planted(400)
    prices = prices.select(prices.assets[:1])
    stretches = four_folds(prices)
    worth, _ = found("market", stretches, prices)
    assert [each.shared for each in worth.signals] == [True] * 4
    assert not worth.ignored


class FirstTilt(Known):
    """Always the same choice of a menu: towards the anchor, tilted by the first signal."""

    def policy(self, weights, observation):
        return jnp.full(observation.holding.shape[0], 1)


def test_a_menu_tilts_by_the_shuffled_signals(prices):
    """The signals that a menu computes weights from are shuffled, too."""
    task = {"signals": "momentum:20,reversal:3", "menu": "signals:1"}
    stretches = four_folds(prices, **task)
    names = ["log return", "momentum:20", "reversal:3"]
    worth, held = importance(FirstTilt("none"), stretches, names, prices.values, 252)
    assert held.std() > 0.01
    changed = [each.high - each.low > 1e-4 for each in worth.signals]  # from shuffle to shuffle
    assert changed == [False, True, False]
    assert not worth.ignored


def test_a_policy_that_is_wiped_out_is_explained():
    """With twice its wealth in assets, it loses everything on the day they all halve."""
    calm = planted()
    values = calm.values * np.where(np.arange(len(calm)) < 500, 1, 0.45)[:, None]
    prices = dataclasses.replace(calm, values=values)
    mandate = {
        "assets": {"cap": 1.0, "floor": 1 / 3},
        "cash": {"min": -1.0},
        "exposure": {"gross": 2.0},
    }
    stretches = four_folds(prices, mandate=mandate)
    worth, _ = found("constant", stretches, prices)
    assert worth.ignored
    assert worth.everything.lost == 0


def test_a_delisted_asset_takes_no_part():
    """Signals are unknown where an asset is delisted; those that all others share are shared."""
    prices = with_a_delisted_asset(planted())
    stretches = four_folds(prices)
    worth, _ = found("market", stretches, prices)
    assert [each.shared for each in worth.signals] == [False, False, False, True]
    assert worth.signals[3].high > worth.signals[3].low
    drawn = Shuffles.drawn(stretches, 2, 63, 0)
    assert (drawn.assets[..., 6] == 6).all()
    assert (drawn.assets[1:, :, :6] != np.arange(6)).any()
    volatility, momentum = drawn.others[..., 3], drawn.others[..., 1]
    np.testing.assert_array_equal(volatility[:, 6], volatility[:, 0])
    assert np.isnan(momentum[100:, 6]).all()


def test_moves_that_are_rounding_are_worth_nothing(stretches, prices, monkeypatch):
    monkeypatch.setattr(module, "UNMOVED", 2.0)
    worth, _ = found("momentum", stretches, prices)
    assert {(each.lost, each.t) for each in (*worth.signals, worth.everything)} == {(0, 0)}
    assert worth.ignored
