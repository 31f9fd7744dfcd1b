"""The parts of a return add up, and name what the return really came from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from qfolio.core.mdp import Position
from qfolio.portfolio.backtest.attribution.decomposition import decompose
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.synthetic.ar1 import Ar1

from tables import random_walk


def decomposed(prices, decisions, cost=0.002, folds=None):
    """A replay from row 0 on with a lag of 1, and its parts at 252 days a year."""
    found = simulate(prices, decisions, first=0, cost=cost)
    days = len(decisions)
    returns = np.zeros((days, prices.shape[1] + 1))
    returns[:, 1:] = prices[2 : days + 2] / prices[1 : days + 1] - 1
    folds = {"all": slice(0, days)} if folds is None else folds
    names = [f"asset {i}" for i in range(prices.shape[1])]
    parts = decompose(found.returns, found.weights, returns, folds, names, 252)
    return found, parts


def random_prices():
    return random_walk(402, 4, drift=3e-4, volatility=0.02)


def test_the_parts_add_up_exactly():
    prices = random_prices()
    decisions = np.random.default_rng(1).dirichlet(np.ones(5), 400)
    folds = {"a": slice(0, 150), "b": slice(150, 300), "c": slice(300, 400)}
    found, parts = decomposed(prices, decisions, folds=folds)
    net = 252 * found.returns.mean()
    assert parts.net == pytest.approx(net, abs=1e-12)
    assert parts.equal + parts.tilts + parts.timing - parts.cost == pytest.approx(net, abs=1e-12)
    static, timing = (sum(getattr(each, key) for each in parts.assets)
                      for key in ("static", "timing"))  # fmt: skip
    assert static == pytest.approx(parts.static, abs=1e-12)
    assert timing == pytest.approx(parts.timing, abs=1e-12)
    # Each part by an independent way.
    held = prices[2:402] / prices[1:401] - 1
    weights = found.weights[:, 1:]
    covariances = [np.cov(weights[:, i], held[:, i], ddof=0)[0, 1] for i in range(4)]
    assert timing == pytest.approx(252 * sum(covariances), abs=1e-12)
    gross = 1 + (weights * held).sum(1)
    assert parts.cost == pytest.approx(252 * (found.cost * gross).mean(), abs=1e-12)
    assert parts.equal == pytest.approx(252 * held.mean(), abs=1e-12)
    for key in ("static", "timing", "cost", "net"):
        weighted = np.average([getattr(part, key) for part in parts.folds], weights=[150, 150, 100])
        assert weighted == pytest.approx(getattr(parts, key), abs=1e-12)
    for fold in parts.folds:
        assert fold.static + fold.timing - fold.cost == pytest.approx(fold.net, abs=1e-12)


def test_constant_weights_have_no_timing():
    found, parts = decomposed(random_prices(), np.tile([0.1, 0.4, 0.3, 0.2, 0.0], (400, 1)), 0.0)
    # The weights drift from a decision to its trade, and no further.
    assert abs(found.weights - found.weights.mean(0)).max() < 0.02
    prices = random_prices()
    returns = np.zeros((400, 5))
    returns[:, 1:] = prices[1:401] / prices[:400] - 1
    weights = np.tile([0.1, 0.4, 0.3, 0.2, 0.0], (400, 1))
    names = list("abcd")
    parts = decompose((weights * returns).sum(1), weights, returns, {}, names, 252)
    assert parts.timing == pytest.approx(0, abs=1e-12)
    assert parts.static == pytest.approx(parts.net, abs=1e-12)


def test_equal_weights_of_what_is_there_have_neither_tilts_nor_timing():
    """Each asset joins or leaves; an agent that holds twice as much of one is tilted only."""
    rng = np.random.default_rng(3)
    returns = np.concatenate([np.zeros((400, 1)), rng.normal(3e-4, 0.02, (400, 4))], 1)
    there = np.ones((400, 4), bool)
    there[:150, 0] = there[250:, 1] = False
    even = np.concatenate([np.zeros((400, 1)), there / there.sum(1, keepdims=True)], 1)
    tilted = even + np.array([0, 0, 0, 0.1, -0.1])
    for weights, tilts in ((even, 0.0), (tilted, 252 * 0.1 * (returns @ [0, 0, 0, 1, -1]).mean())):
        net = (weights * returns).sum(1)
        names, folds = list("abcd"), {"all": slice(0, 400)}
        parts = decompose(net, weights, returns, folds, names, 252, there)
        assert parts.tilts == pytest.approx(tilts, abs=1e-12)
        assert parts.timing == pytest.approx(0, abs=1e-12)
        assert sum(each.static for each in parts.assets) == pytest.approx(parts.static, abs=1e-12)
        assert parts.net == pytest.approx(parts.static + parts.timing - parts.cost, abs=1e-12)


def test_a_holding_that_drifts_has_no_skill():
    """Its timing and its tilts are artefacts of mean weights that are known at the end only."""
    rng = np.random.default_rng(2)
    found = []
    for _ in range(100):
        returns = 0.01 * rng.standard_normal((1000, 10))
        wealth = np.cumprod(1 + returns, 0)
        held = np.concatenate([np.ones((1, 10)), wealth[:-1]])
        weights = np.pad(held / held.sum(1, keepdims=True), ((0, 0), (1, 0)))
        returns = np.pad(returns, ((0, 0), (1, 0)))
        net = (weights * returns).sum(1)
        found.append(decompose(net, weights, returns, {}, list("abcdefghij"), 252))
    timing, tilts = (np.array([getattr(x, key) for x in found]) for key in ("timing", "tilts"))
    assert np.mean(timing < 0) > 0.9
    assert np.mean(tilts > 0) > 0.9
    assert abs(np.mean(timing + tilts)) < 0.1 * np.mean(tilts)
    assert np.mean([abs(x.active_t) > 1.96 for x in found]) <= 0.1


def test_the_exact_policy_of_an_ar1_market_earns_by_timing():
    """Its signal has mean zero: constant weights earn the small drift only."""
    task = Ar1(cost=0.0005)
    best = task.best()

    def step(state, key):
        action = best(state)
        after = task.step(state, action, key).state
        return after, (action, after.market.relative)

    @jax.jit
    def rolled(key):
        start = Position(task.reset_market(key), task.hold(jnp.array([1.0, 0.0])))
        return lax.scan(step, start, jax.random.split(key, 20_000))[1]

    weights, relatives = (np.asarray(x, float) for x in rolled(jax.random.key(0)))
    prices = np.cumprod(np.concatenate([[1.0], relatives]))[:, None]
    found = simulate(prices, weights, first=0, cost=0.0005, lag=0)
    returns = np.stack([np.zeros(20_000), relatives - 1], 1)
    parts = decompose(found.returns, found.weights, returns, {}, ["asset"], 252)
    assert parts.timing > 0.15
    assert parts.active_t > 5
    assert abs(parts.static) < 0.3 * parts.timing
    assert parts.static + parts.timing - parts.cost == pytest.approx(parts.net, abs=1e-12)
