"""Anchored tilts: they trade as defined, find what is there, and stay where nothing is."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

from qfolio.agents import paths, tilts
from qfolio.agents.tilts import Deep, Tilt, TiltPolicy, Tilts, tilted
from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.market import View
from qfolio.core.mdp import Position, Simplex, Transition
from qfolio.core.population import Population, programs_of
from qfolio.core.training import begin, play
from qfolio.learning.evidence import Evidence, blocks_of, left_out
from qfolio.learning.scores import Hidden
from qfolio.learning.trading import Trading
from qfolio.portfolio.synthetic.kelly import Kelly
from qfolio.portfolio.task import Portfolio
from qfolio.tasks.pendulum import Pendulum

from populations import first_member, train_to
from tables import price_table, random_walk

SMALL: dict[str, Any] = {
    "num_envs": 16,
    "rollout_length": 42,
    "head": 10,
    "learning_rate_steps": 40.0,
}
TASK: dict[str, Any] = {
    "window": 1,
    "horizon": 42,
    "signals": "momentum:21,volatility:21",
    "anchor": "equal-weight",
}


def tilt(linear, interaction=None, rate=0.0, band=-20.0, cap=1.0, speed=1.0):
    count = len(linear)
    square = np.zeros((count, count)) if interaction is None else interaction
    resting = Trading(jnp.asarray(rate, float), jnp.asarray(band, float))
    trading = jax.tree.map(lambda x: x[None], resting)
    one = Tilt(jnp.asarray([linear], float), jnp.asarray([square], float), None, trading, resting)
    return TiltPolicy(one, jnp.array(1.0), jnp.array(0.0), jnp.array(speed), Simplex(3, cap))


def view(held, features=((0.0,), (0.0,), (0.0,)), anchor=(0.25, 0.25, 0.5)):
    returns = jnp.zeros((3, 1))
    channels = jnp.concatenate([returns, jnp.asarray(features, float)], -1)
    return View(channels[:, None], jnp.asarray(held, float), jnp.asarray(anchor, float))


def test_target_is_the_anchor_plus_scores_less_their_mean():
    found = tilt([1.0]).target(view([0, 0, 0], [[0.3], [0.0], [-0.3]]))
    np.testing.assert_allclose(found, [0, 0.35, 0.25, 0.4], atol=1e-6)


def test_target_is_the_nearest_without_negative_weights():
    wanted = jax.random.normal(jax.random.key(0), (200, 12)) * jnp.linspace(0, 3, 200)[:, None]
    anchor = jax.random.dirichlet(jax.random.key(1), jnp.ones(12), (200,))
    found = tilted(anchor, 12 * wanted, Simplex(12))
    exact = simplex.project(anchor + wanted)
    np.testing.assert_allclose(found[:, 1:], exact, atol=1e-5)
    np.testing.assert_allclose(found[:, 0], 0, atol=1e-6)


def test_an_input_of_five_deviations_counts_as_three():
    found, wanted = (tilt([0.1]).target(view([0, 0, 0], [[x], [0.0], [-x]])) for x in (5.0, 3.0))
    np.testing.assert_array_equal(found, wanted)


def test_interaction_multiplies_inputs_with_their_mean_over_the_assets():
    members = tilt([0.0, 0.0], [[0.0, 1.0], [0.0, 0.0]]).members
    features = jnp.array([[[0.0, 1.0, 0.5]], [[0.0, 0.0, 0.5]], [[0.0, -1.0, 0.5]]])
    np.testing.assert_allclose(members.scores(features), [[0.5, 0.0, -0.5]], atol=1e-6)


def test_without_tilts_and_at_the_anchor_nothing_is_traded():
    policy = tilt([0.0], band=np.log(0.1))
    seen = view([0.26, 0.24, 0.5])
    held = np.array([0, 0.26, 0.24, 0.5], np.float32)
    np.testing.assert_array_equal(policy(seen), held)


def test_a_weight_of_zero_can_grow():
    seen = view([0, 0, 0], [[3.0], [0.0], [0.0]], anchor=(1e-6, 0.5, 0.5 - 1e-6))
    assert tilt([1.0]).target(seen)[1] > 0.3


def test_target_keeps_the_cap():
    found = tilt([1.0], cap=0.5).target(view([0, 0, 0], [[3.0], [0.0], [0.0]]))
    np.testing.assert_allclose(found, [0, 0.5, 0.125, 0.375], atol=1e-6)


@pytest.mark.parametrize("count", [5, 12])
def test_a_cap_moves_nothing_into_cash(count):
    """What an asset may not hold goes to the others, unless all of them are at the cap."""
    scores = 3 * jax.random.normal(jax.random.key(0), (200, count))
    anchor = jax.random.dirichlet(jax.random.key(1), jnp.ones(count), (200,))
    anchor *= jnp.linspace(0, 1, 200)[:, None]
    anchor = jnp.where(jnp.arange(count) == 2, 0.0, anchor)  # untradable
    cap = 0.7 / (count - 1)
    found = np.asarray(tilted(anchor, scores, Simplex(count, cap)), float)
    assets = np.minimum(np.asarray(anchor).sum(1), 0.7)
    np.testing.assert_allclose(found[:, 0], 1 - assets, atol=1e-5)
    np.testing.assert_allclose(found.sum(1), 1, atol=1e-5)
    assert (found[:, 3] == 0).all()
    assert found[:, 1:].max() <= cap + 1e-6
    free = (found[:, 1:] > 1e-6) & (found[:, 1:] < cap - 1e-6)
    share = np.asarray(anchor.sum(1, keepdims=True)) / (count - 1)
    level = np.where(free, anchor + share * scores - found[:, 1:], np.nan)
    spread = np.nanmax(level, 1, initial=-9) - np.nanmin(level, 1, initial=9)
    assert np.nanmax(spread) < 1e-5  # the same amount is taken from each


def test_untradable_assets_stay_at_zero():
    found = tilt([5.0]).target(view([0, 0, 0], [[0.0], [0.0], [3.0]], anchor=(0.5, 0.5, 0.0)))
    np.testing.assert_allclose(found, [0, 0.5, 0.5, 0], atol=1e-6)


def test_evidence_is_the_t_statistic_of_ratios_by_block():
    rng = np.random.default_rng(0)
    active = rng.normal(0.1, 1, (50, 3)) * [1.0, 10.0, 0.1]  # a block in each path
    block = jnp.broadcast_to(jnp.arange(3), (50, 3))
    unseen = left_out(block, 2)
    np.testing.assert_array_equal(unseen[:, 0], [[True, False, True], [False, True, False]])
    seen_too = jnp.where(unseen, jnp.asarray(active), 99.0)  # by the other member
    evidence = Evidence.none(4).add(block, seen_too, unseen, 0.9)
    ratio = active.mean(0) / active.std(0)
    wanted = ratio.mean() / ratio.std(ddof=1) * np.sqrt(3)
    np.testing.assert_allclose(evidence.t, wanted, rtol=1e-4)


def test_a_block_of_one_step_is_no_evidence():
    two = Evidence(jnp.array([5.0, 5.0]), jnp.array([1.0, 2.0]), jnp.array([4.0, 4.0]))
    three = Evidence(*(jnp.append(x, last) for x, last in zip(two, (1.0, 3.0, 9.0), strict=True)))
    np.testing.assert_allclose(three.t, two.t, rtol=1e-6)


def test_no_evidence_of_nothing():
    assert Evidence.none(8).t == 0


def trained(*tables, rounds=40, signals=TASK["signals"], **settings):
    tasks = [Portfolio.of(price_table(values), **{**TASK, "signals": signals}) for values in tables]
    population = Population(tasks, Tilts(**SMALL, **settings), range(len(tables)))
    train_to(population, rounds * SMALL["rollout_length"])
    return jax.tree.map(jnp.asarray, population.fetch().agent)


def test_a_step_is_evidence_from_the_one_member_that_does_not_learn_from_it():
    """As all members trade alike at first, it does not matter how many there are."""
    few, many = (
        trained(random_walk(300, 3, seed=3), rounds=1, network="linear", members=count)
        for count in (2, 4)
    )
    assert abs(few.evidence.total).max() > 1e-6
    for one, other in zip(few.evidence, many.evidence, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-4, atol=1e-9)
    gradients = np.asarray(many.optimizer.mu.linear[0])
    assert len(np.unique(gradients, axis=0)) == 4  # of other blocks each


def test_evidence_is_over_the_anchor_at_the_speed_that_is_followed():
    """At the start, members without a tilt trade as the anchor does at its learned speed."""
    task = Portfolio.of(price_table(random_walk(300, 3, seed=3)), **TASK)
    agent = Tilts(**SMALL, network="linear")
    start = begin(task, agent, jnp.uint32(0))

    @jax.jit
    def evidence(speed):
        now = eqx.tree_at(lambda s: s.agent.policy.speed, start, speed)
        state, rollout = play(task, agent, now)
        return agent.learn(task, state.agent, rollout, jax.random.key(0))[0].evidence

    in_a_band, followed = (abs(evidence(jnp.array(x)).total).max() for x in (0.0, 1.0))
    assert followed < 1e-6 < in_a_band


def test_the_more_averse_to_tracking_error_the_smaller_are_tilts():
    task = Portfolio.of(price_table(random_walk(300, 3, seed=3)), **TASK)
    agents = [Tilts(**SMALL, network="linear", tracking_aversion=a) for a in (0.0, 1e4)]
    population = Population(task, agents, [0, 0])
    train_to(population, 20 * SMALL["rollout_length"])
    bold, averse = abs(population.fetch().agent.policy.members.linear).mean((1, 2))
    assert averse < bold / 2


@pytest.mark.parametrize("network", ["linear", "hidden"])
def test_stays_at_the_anchor_where_prices_hold_nothing(network):
    states = trained(*(random_walk(1500, 8, seed) for seed in range(3)), network=network)
    assert states.evidence.steps.min() > 0
    at_anchor = (states.policy.share == 0) & (states.policy.speed == 0)
    if states.policy.members.deep is not None:
        assert states.evidence_of_depth.steps.min() > 0
        at_anchor &= states.policy.depth == 0
    assert at_anchor.sum() >= 2


@pytest.mark.parametrize("network", ["linear", "hidden"])
def test_many_assets_learn_as_few_do(monkeypatch, network):
    """A step at a time and a path at a time, as with many assets, or all of them at once."""
    table = random_walk(300, 3, seed=3)
    found = [trained(table, rounds=2, network=network).policy]
    for module in (paths, tilts):
        monkeypatch.setattr(module, "AT_ONCE", 0)
    monkeypatch.setattr(paths, "BLOCK", 1)
    programs_of.cache_clear()
    found.append(trained(table, rounds=2, network=network).policy)
    programs_of.cache_clear()
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)
    assert np.abs(found[0].members.linear).min() > 1e-3


def test_finds_momentum():
    rng = np.random.default_rng(1)
    drift = np.repeat(rng.normal(0, 0.004, (15, 8)), 100, axis=0)
    state = first_member(trained(random_walk(1500, 8, 2, drift)))
    assert state.evidence.t > 4
    assert state.policy.members.linear[:, 0].min() > 0.1


def hump(seed, size):
    """Prices whose assets of middling volatility rise, and the others fall; volatilities change."""
    rng, assets, rows = np.random.default_rng(seed), 8, 75
    ranks = np.stack([np.linspace(-1, 1, assets)[rng.permutation(assets)] for _ in range(20)])
    noise = 0.01 * np.exp(0.7 * ranks).repeat(rows, 0) * rng.normal(size=(20 * rows, assets))
    return np.exp(np.cumsum(size * (1 - 2 * np.abs(ranks)).repeat(rows, 0) + noise, 0))


@pytest.mark.parametrize("network", ["hidden", "attention"])
def test_a_network_finds_what_linear_scores_cannot(network):
    tables = [hump(seed, 0.004) for seed in range(3)]
    states = trained(*tables, signals="volatility:21", network=network)
    assert states.policy.depth.min() > 0.5
    ranks = jnp.array([-1.5, -0.2, 0.2, 1.5])  # in standard deviations
    seen = jnp.zeros((4, 1, 2)).at[:, 0, 1].set(ranks)
    for seed in range(3):
        members = jax.tree.map(lambda x, seed=seed: x[seed], states.policy.members)
        scores = members.deep.scores(seen).mean(0)
        assert scores[1:3].min() > scores[jnp.array([0, 3])].max()


def test_a_network_changes_nothing_in_what_is_learned_without_it():
    tables = [random_walk(1500, 8, seed) for seed in range(3)]
    # Few rounds: the two programs round differently, which training amplifies.
    deep, linear = (trained(*tables, rounds=10, network=name) for name in ("hidden", "linear"))
    np.testing.assert_allclose(deep.evidence.total, linear.evidence.total, rtol=1e-2, atol=1e-5)
    for name in ("linear", "interaction"):
        one, other = (getattr(state.policy.members, name) for state in (deep, linear))
        np.testing.assert_allclose(one, other, rtol=1e-2, atol=1e-3)


def test_a_network_learns_from_every_fourth_path():
    state = trained(random_walk(300, 3, seed=3), rounds=2)
    counted = state.evidence_of_depth.steps.sum() / state.evidence.steps.sum()
    np.testing.assert_allclose(counted, 1 / 4, rtol=1e-5)


@pytest.mark.parametrize("members", [2, 3, 4, 5])
def test_each_member_gives_evidence_of_a_network_where_moves_are_drawn_anew(members):
    rollout = Transition(Position(jnp.zeros((2, 24)), None), *[jnp.zeros(())] * 7)
    block = blocks_of(Kelly(), rollout, 32, tilts.EVERY)
    np.testing.assert_array_equal(np.sort(block[0]), np.arange(24))
    assert left_out(block[:, :: tilts.EVERY], members).any((1, 2)).all()


def test_a_network_without_evidence_is_not_followed():
    linear = tilt([1.0], rate=0.5)
    network = jax.tree.map(lambda x: x[None] + 1.0, Hidden(1, 4, jax.random.key(0)))
    fast = jax.tree.map(lambda x: x[None], Trading.start(0.9))
    members = linear.members
    one = Tilt(members.linear, members.interaction, Deep(network, fast), members.trading,
               members.resting)  # fmt: skip
    seen = view([0.2, 0.3, 0.5], [[0.3], [0.0], [-0.3]])
    without = TiltPolicy(one, linear.share, jnp.array(0.0), linear.speed, linear.actions)
    np.testing.assert_array_equal(without(seen), linear(seen))
    whole = TiltPolicy(one, linear.share, jnp.array(1.0), linear.speed, linear.actions)
    np.testing.assert_allclose(whole.trading.described["rate"], 0.9, rtol=1e-5)
    assert np.abs(whole.target(seen) - linear.target(seen)).max() > 1e-2


@pytest.mark.parametrize(("share", "rate"), [(0.0, 0.1), (1.0, 0.5)])
def test_trades_at_the_speed_of_the_anchor_without_evidence_and_of_the_scores_with_it(share, rate):
    members = tilt([1.0], rate=0.0).members  # a rate of one half
    members = Tilt(members.linear, members.interaction, None, members.trading, Trading.start(0.1))
    policy = TiltPolicy(members, jnp.array(share), jnp.array(0.0), jnp.array(1.0), Simplex(3))
    np.testing.assert_allclose(policy.trading.described["rate"], rate, rtol=1e-5)


def test_without_evidence_for_another_speed_the_anchor_is_kept_in_a_band_of_a_fifth():
    policy = tilt([0.0], speed=0.0)
    policy = TiltPolicy(policy.members, jnp.array(0.0), policy.depth, policy.speed, Simplex(3))
    near = np.array([0, 0.3, 0.2, 0.5], np.float32)  # within a fifteenth of the anchor
    np.testing.assert_array_equal(policy(view(near[1:])), near)
    order = policy(view([0.45, 0.15, 0.4]))
    np.testing.assert_allclose(order[1], 0.45 - 0.3 * (0.2 - 0.2 / 3), rtol=1e-5)


@pytest.mark.parametrize("network", ["linear", "hidden"])
def test_the_anchor_is_rebalanced_faster_where_losers_recover(network):
    noise = np.random.default_rng(0).normal(0, 0.01, (1500, 8))
    fading = lfilter([1], [1, -0.8], noise, axis=0)  # forgets a fifth a day
    go_on, revert = np.exp(np.cumsum(fading / 2, 0)), np.exp(fading)
    states = trained(go_on, revert, network=network)
    assert states.evidence_of_speed.t.min() > 3
    slow, fast = jax.vmap(lambda policy: policy.resting.described["rate"])(states.policy)
    assert slow < 0.15
    assert fast > 0.6


def test_needs_an_anchor():
    task = Portfolio.of(price_table(random_walk(300, 3, 0)), **{**TASK, "anchor": ""})
    with pytest.raises(QfolioError, match="anchor=equal-weight"):
        Tilts(**SMALL).init(task, jax.random.key(0))
    with pytest.raises(QfolioError, match="has none"):
        Tilts().init(Pendulum(), jax.random.key(0))


def test_a_rollout_must_not_span_two_episodes():
    task = Portfolio.of(price_table(random_walk(300, 3, 0)), **{**TASK, "horizon": 50})
    refused = lambda says: pytest.raises(QfolioError, match=f"must divide the {says}, or another ")  # noqa: E731
    with refused("50 steps of an episode; set horizon=84"):
        Tilts(**SMALL).init(task, jax.random.key(0))
    for steps, fits in ((48, "episode_steps=42"), (40, "horizon=42 and episode_steps=0")):
        with refused(f"{steps} steps of an episode; set {fits}"):
            Tilts(**SMALL, episode_steps=steps).init(task, jax.random.key(0))


@pytest.mark.parametrize(
    "settings",
    [{"head": 84}, {"members": 1}, {"threshold": -1.0}, {"members": 40}, {"memory": 0.0}],
)
def test_settings_out_of_range(settings: dict[str, Any]):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        Tilts(**settings)
