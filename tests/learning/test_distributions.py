import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from qfolio.core.mdp import Box, Discrete, Simplex
from qfolio.learning.distributions import Categorical, Gaussian, LogisticNormal, Squashed, policy_of

KEY = jax.random.key(0)
DRAWS = 100_000
MEAN, STD = np.array([0.4, -1.2]), np.array([0.5, 1.5])


def gaussian(draws=None):
    """Two coordinates, as a batch of equal rows or without one."""
    shape = (2,) if draws is None else (draws, 2)
    return Gaussian(jnp.broadcast_to(jnp.array(MEAN), shape).astype(jnp.float32), jnp.log(STD))


def test_categorical_against_its_probabilities():
    chances = np.array([0.5, 0.2, 0.3])
    policy = Categorical(jnp.broadcast_to(jnp.log(chances) + 7, (DRAWS, 3)))
    draws = policy.sample(KEY)
    np.testing.assert_allclose(np.bincount(draws) / DRAWS, chances, atol=0.006)
    np.testing.assert_allclose(policy.log_prob(draws)[:50], np.log(chances)[draws[:50]], rtol=1e-5)
    np.testing.assert_allclose(policy.entropy()[0], stats.entropy(chances), rtol=1e-5)
    assert (policy.mode() == 0).all()


def test_a_choice_that_is_never_made_has_no_entropy():
    policy = Categorical(jnp.array([0.0, -200.0]))
    np.testing.assert_allclose(policy.entropy(), 0, atol=1e-6)
    slope = jax.grad(lambda x: Categorical(x).entropy())(policy.logits)
    assert jnp.isfinite(slope).all()


def test_gaussian_against_scipy():
    draws = gaussian(DRAWS).sample(KEY)
    np.testing.assert_allclose(draws.mean(0), MEAN, atol=0.02)
    np.testing.assert_allclose(draws.std(0), STD, rtol=0.01)
    expected = stats.norm(MEAN, STD)
    some = np.asarray(draws[:100])
    np.testing.assert_allclose(
        gaussian(100).log_prob(draws[:100]), expected.logpdf(some).sum(1), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(gaussian().entropy(), expected.entropy().sum(), rtol=1e-6)
    np.testing.assert_allclose(gaussian().mode(), MEAN, rtol=1e-6)


def test_squashed_is_the_change_of_variables():
    policy = Squashed(gaussian(1000), 2.0)
    drawn, log_prob = policy.sample_and_log_prob(KEY)
    action = np.asarray(drawn, np.float64)
    np.testing.assert_array_equal(action, policy.sample(KEY))
    inside = np.abs(action).max(1) < 1.99  # beyond, float32 cannot be inverted
    x = np.arctanh(action / 2)
    expected = stats.norm(MEAN, STD).logpdf(x) - np.log(2 * (1 - (action / 2) ** 2))
    np.testing.assert_allclose(log_prob[inside], expected.sum(1)[inside], rtol=1e-3, atol=1e-3)


def test_squashed_density_integrates_to_one():
    normal = Gaussian(jnp.full((20_000, 1), 0.3), jnp.log(jnp.array([0.8])))
    action, log_prob = Squashed(normal, 2.0).sample_and_log_prob(KEY)
    order = np.argsort(action[:, 0])
    total = integrate.trapezoid(np.exp(log_prob)[order], np.asarray(action)[order, 0])
    assert total == pytest.approx(1, abs=2e-3)


def test_squashed_stays_finite_at_the_bounds():
    normal = Gaussian(jnp.array([[30.0], [-30.0]]), jnp.zeros(1))
    action, log_prob = Squashed(normal, 1.0).sample_and_log_prob(KEY)
    np.testing.assert_allclose(action, [[1], [-1]], rtol=1e-6)
    assert jnp.isfinite(log_prob).all()


def test_logistic_normal_of_one_asset_integrates_to_one():
    policy = LogisticNormal(Gaussian(jnp.array([0.5]), jnp.log(jnp.array([0.7]))))
    weight = np.linspace(0, 1, 20_001)[1:-1]
    density = jax.vmap(policy.log_prob)(jnp.stack([1 - weight, weight], -1).astype(jnp.float32))
    total = integrate.trapezoid(np.exp(density), weight)
    assert total == pytest.approx(1, abs=1e-3)


def test_logistic_normal_of_two_assets_integrates_to_one():
    policy = LogisticNormal(gaussian())
    points = (np.arange(1500) + 0.5) / 1500
    first, second = np.meshgrid(points, points)
    inside = first + second < 1
    first, second = first[inside], second[inside]
    weights = jnp.stack([1 - first - second, first, second], -1).astype(jnp.float32)
    total = np.exp(np.asarray(policy.log_prob(weights), np.float64)).sum() / 1500**2
    assert total == pytest.approx(1, abs=5e-3)


def test_logistic_normal_draws():
    policy = LogisticNormal(gaussian(DRAWS))
    weights, log_prob = policy.sample_and_log_prob(KEY)
    np.testing.assert_allclose(weights.sum(-1), 1, rtol=1e-5)
    logs = np.log(np.asarray(weights))
    y = logs[:, 1:] - logs[:, :1]
    np.testing.assert_allclose(y.mean(0), MEAN, atol=0.02)
    np.testing.assert_allclose(y.std(0), STD, rtol=0.01)
    np.testing.assert_allclose(policy.log_prob(weights), log_prob, rtol=1e-3, atol=1e-3)
    middle = np.exp([0, *MEAN]) / np.exp([0, *MEAN]).sum()
    np.testing.assert_allclose(policy.mode()[0], middle, rtol=1e-5)


@pytest.mark.parametrize(
    "policy", [Categorical(jnp.array([0.3, -1.0, 0.5])), gaussian()], ids=["choice", "numbers"]
)
def test_entropy_is_minus_the_mean_log_density(policy):
    draws = jax.vmap(policy.sample)(jax.random.split(KEY, DRAWS))
    mean = -jax.vmap(policy.log_prob)(draws).mean()
    assert float(mean) == pytest.approx(float(policy.entropy()), abs=0.01)


def test_the_score_is_zero_on_average():
    """∫ p = 1 for every mean and deviation, so that E ∇ log p = 0."""

    def score(mean, log_std):
        policy = LogisticNormal(Gaussian(mean, log_std))
        draws = jax.lax.stop_gradient(jax.vmap(policy.sample)(jax.random.split(KEY, DRAWS)))
        return jax.vmap(policy.log_prob)(draws).mean()

    slopes = jax.grad(score, (0, 1))(gaussian().mean, gaussian().log_std)
    np.testing.assert_allclose(np.stack(slopes), 0, atol=0.02)


def test_what_an_output_means():
    output = jnp.array([[1.0, 3.0, -1.0]])
    np.testing.assert_array_equal(policy_of(Discrete(3), output, jnp.zeros(0)).mode(), [1])

    bounded = policy_of(Box(3, 2.0), output, jnp.log(jnp.array([0.5, 1.0, 2.0])))
    assert isinstance(bounded, Gaussian)
    np.testing.assert_allclose(bounded.mode(), 2 * output, rtol=1e-6)
    np.testing.assert_allclose(jnp.exp(bounded.log_std), [1, 2, 4], rtol=1e-6)
    free = policy_of(Box(3), output, jnp.zeros(3))
    np.testing.assert_allclose(free.mode(), output)

    weights = policy_of(Simplex(2), output, jnp.log(jnp.array([0.5])))
    np.testing.assert_allclose(weights.mode(), jax.nn.softmax(output), rtol=1e-6)
    entropy = 2 * (math.log(0.5) + math.log(2 * math.pi * math.e) / 2)
    np.testing.assert_allclose(weights.entropy(), [entropy], rtol=1e-6)
