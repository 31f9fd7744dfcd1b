"""Running statistics against numpy, and agents that learn by them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.a2c import A2C
from qfolio.agents.mbpo import MBPO
from qfolio.agents.ppo import PPO
from qfolio.agents.sac import SAC
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.mdp import Transition
from qfolio.core.population import Population
from qfolio.experiments.run import Run
from qfolio.learning.normalization import Moments, NormalizationConfig, Normalizer, RewardScale
from qfolio.portfolio.synthetic.merton import Merton
from qfolio.tasks.finite import Cliff
from qfolio.tasks.pendulum import Pendulum

from populations import assert_same, first_member, train_to
from probes import Aim

BOTH: dict[str, Any] = {"normalize_observations": True, "normalize_rewards": True}
SMALL = {
    "ppo": PPO(hidden=(8,), num_envs=2, rollout_length=5, batch_size=5, epochs=2, **BOTH),
    "sac": SAC(
        hidden=(8,), num_envs=2, batch_size=8, learning_starts=10, replay_capacity=99,
        noise_theta=0.3, **BOTH,
    ),
}  # fmt: skip


class Foreign(Aim):
    """``Aim`` in other units."""

    def observe(self, state):
        return 300 + 20 * super().observe(state)

    def step(self, state, action, key):
        after = super().step(state, action, key)
        return after._replace(reward=50 * after.reward)


def moments(normalizer):
    return normalizer.observations.mean, normalizer.observations.variance


def trained(task, agent, steps, seeds=(0,)):
    return train_to(Population(task, agent, seeds), steps)


@pytest.mark.parametrize("sizes", [[40], [1] * 40, [1, 9, 30]])
def test_moments_are_those_of_all_rows(sizes):
    rows = np.random.default_rng(0).normal([5, -300, 0.1], [1, 20, 1e-3], (40, 3))
    found = Moments.begin((3,))
    for part in np.split(rows.astype(np.float32), np.cumsum(sizes)[:-1]):
        found = found.update(jnp.asarray(part))
    assert found.count == 40
    np.testing.assert_allclose(found.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(found.variance, rows.var(0), rtol=1e-3)


def test_rewards_are_divided_by_the_spread_of_discounted_returns():
    """Two environments by hand, in two rollouts; an episode's end starts the return anew."""
    rng = np.random.default_rng(1)
    reward, finished = rng.normal(2, 5, (30, 2)), rng.random((30, 2)) < 0.2
    returns, each = np.zeros(2), []
    for now, over in zip(reward, finished, strict=True):
        returns = 0.9 * returns + now
        each.append(returns)
        returns = np.where(over, 0, returns)
    scale = RewardScale(jnp.zeros(2), Moments.begin(()))
    for part in (slice(0, 13), slice(13, 30)):
        scale = scale.update(
            jnp.asarray(reward[part], jnp.float32), jnp.asarray(finished[part]), 0.9
        )
    np.testing.assert_allclose(scale.returns, returns, rtol=1e-5)
    normalizer = Normalizer(None, scale)
    np.testing.assert_allclose(normalizer.unit, np.std(each), rtol=1e-5)
    given = normalizer.reward(jnp.array([3.0, 1e9]))
    np.testing.assert_allclose(given, [3 / np.std(each), 10], rtol=1e-5)


def test_observations_are_standardised_and_clipped():
    seen = Moments(jnp.array(9.0), jnp.array([1.0, 7.0]), jnp.array([4.0, 0.0]))
    normalizer = Normalizer(seen, None)
    given = normalizer.observation(jnp.array([[5.0, 7.0], [-99.0, 8.0]]))
    np.testing.assert_allclose(given, [[2, 0], [-10, 10]], rtol=1e-6)
    assert normalizer.unit == 1.0
    np.testing.assert_array_equal(normalizer.reward(jnp.array([123.0])), [123])


def test_the_range_of_rewards_is_normalized_as_rewards_are():
    """The returns 4 and −2 have a standard deviation of 3; the metric is in the task's units."""

    class Ranged(SAC):
        def practise(self, learned, draw, rewards, key):
            np.testing.assert_allclose(rewards, [-2 / 3, 4 / 3], rtol=1e-6)
            return learned, {"q": rewards[1]}

    agent = Ranged(hidden=(4,), num_envs=2, normalize_rewards=True)
    state, zeros = agent.init(Aim(), jax.random.key(0)), jnp.zeros((1, 2))
    view, never = zeros[..., None], jnp.zeros((1, 2), bool)
    step = Transition(zeros, view, view, jnp.array([[4.0, -2.0]]), zeros, view, never, never)
    _, metrics = agent.learn(Aim(), state, step, jax.random.key(1))
    np.testing.assert_allclose(metrics["q"], 4, rtol=1e-6)


def test_nothing_is_kept_or_changed_without_the_settings():
    numbered = Cliff(), jnp.array(0), 2
    assert not jax.tree.leaves(NormalizationConfig(False, False).begin(Aim(), jnp.ones(1), 2))
    assert NormalizationConfig(True, False).begin(*numbered).observations is None


@pytest.mark.parametrize("agent", SMALL.values(), ids=SMALL)
def test_the_statistics_are_those_of_what_was_seen(agent):
    """At the start of each of 20 one-step episodes of each environment: a state of ±½."""
    population = trained(Foreign(), agent, 20)
    state = jax.tree.map(lambda x: x[0], population.fetch().agent)
    mean, variance = moments(state.normalizer)
    assert state.normalizer.observations.count == 40
    high = (mean - 290) / 20  # share of the states +½
    assert 0.2 < high < 0.8
    assert high * 40 == pytest.approx(np.round(high * 40), abs=1e-2)
    np.testing.assert_allclose(variance, 400 * high * (1 - high), rtol=1e-3)


@pytest.mark.parametrize("agent", SMALL.values(), ids=SMALL)
def test_an_evaluation_uses_the_statistics_and_leaves_them(agent):
    population = trained(Foreign(), agent, 40)
    before = population.fetch()
    population.evaluate(start_keys(20))
    assert_same(before, population.fetch())
    state = first_member(before.agent)
    seen = jnp.array([[290.0], [310.0], [1e6]])
    plain = type(agent)(hidden=(8,))
    inner = state.weights if isinstance(agent, PPO) else state.learned.actor
    inner = inner if isinstance(agent, PPO) else plain.weights(state)._replace(actor=inner)
    by_hand = plain.policy(inner, state.normalizer.observation(seen))
    np.testing.assert_array_equal(agent.policy(agent.weights(state), seen), by_hand)
    assert not np.allclose(plain.policy(inner, seen), by_hand, atol=1e-3)


@pytest.mark.parametrize("agent", SMALL.values(), ids=SMALL)
def test_a_run_resumes_with_its_statistics_bit_for_bit(agent, tmp_path):
    task = Pendulum(torques=0, horizon=20)
    whole = Run.create(task, agent, steps=160, seeds=2, out=tmp_path / "whole")
    whole.train()
    half = Run.create(task, agent, steps=80, seeds=2, out=tmp_path / "half")
    half.train()
    again = Run.open(tmp_path / "half")
    assert_same(half.population.weights(), again.population.weights())
    again.train(whole.budget)
    assert_same(whole.population.fetch(), again.population.fetch())
    assert (again.grade()["return_per_seed"]) == whole.grade()["return_per_seed"]


@pytest.mark.slow
def test_units_do_not_matter():
    """SAC learns the same from observations and rewards in other units, up to rounding."""
    agent = SAC(
        hidden=(16,), num_envs=4, batch_size=32, learning_starts=40, replay_capacity=400, **BOTH
    )
    own, foreign = (trained(task, agent, 40) for task in (Aim(), Foreign()))
    states = jnp.array([[0.5], [-0.5]])
    actions = [
        agent.policy(first_member(population.weights()), seen)
        for population, seen in ((own, states), (foreign, 300 + 20 * states))
    ]
    np.testing.assert_allclose(actions[0], actions[1], atol=1e-2)


@pytest.mark.optimized
@pytest.mark.parametrize("agent", [PPO, A2C])
def test_policies_are_learned_in_any_units(agent):
    """Without the statistics neither learns from observations around 300 and rewards of 50.

    One seed's actions end about 0.1 from the best ones; the mean error of 16 hardly varies.
    """
    settings: dict[str, Any] = {
                "hidden": (16,), "num_envs": 8, "rollout_length": 8, "learning_rate": 1e-2,
                "learning_rate_final": 0.0, "learning_rate_steps": 2000.0, "discount": 0.5,
                "initial_std": 0.5}  # fmt: skip
    if agent is PPO:
        settings |= {"batch_size": 32, "epochs": 4}
    states = 300 + 20 * jnp.array([[0.5], [-0.5]])
    for chosen, reached in ((BOTH, True), ({}, False)):
        learner = agent(**settings, **chosen)
        weights = trained(Foreign(), learner, 8 * 250, range(16)).weights()
        actions = jax.vmap(learner.policy, in_axes=(0, None))(weights, states)
        error = jnp.abs(actions - jnp.array([[1.0], [-1.0]])).mean()
        assert error < 0.15 if reached else error > 0.8


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PPO(normalize_observations=True, input_gain=3.0), "input_gain is 3.0"),
        (lambda: SAC(normalize_observations=True, input_gain=3.0), "input_gain is 3.0"),
        (lambda: MBPO(normalize_rewards=True), "normalize_rewards is True"),
        (lambda: MBPO(noise_theta=0.5), "noise_theta is 0.5"),
        (lambda: SAC(noise_theta=0.0), "noise_theta is 0.0"),
        (lambda: Population(Merton(), SAC(**BOTH), [0]), "one array of numbers"),
    ],
)
def test_it_says_what_is_wrong(make, message):
    with pytest.raises(QfolioError, match=message):
        make()
