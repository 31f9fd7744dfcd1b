import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.tasks.pendulum import Pendulum, PendulumState


def test_equals_gymnasium_step_for_step():
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    task = Pendulum()
    random = np.random.default_rng(0)
    n = 5000
    theta = random.uniform(-4 * np.pi, 4 * np.pi, n)
    theta_dot = random.uniform(-8, 8, n)
    theta_dot[:100], theta[:100] = np.sign(theta_dot[:100]) * 8, 1.5  # against the speed limit
    actions = random.integers(0, 11, n)
    states = PendulumState(jnp.array(theta), jnp.array(theta_dot))
    steps = jax.vmap(task.step, (0, 0, None))(states, jnp.array(actions), jax.random.key(0))
    observed = jax.vmap(task.observe)(steps.state)
    torques = np.linspace(-2, 2, 11)
    for i in range(n):
        env.state = np.array([theta[i], theta_dot[i]])
        observation, reward, terminated, _, _ = env.step(np.array([torques[actions[i]]]))
        np.testing.assert_allclose(observed[i], observation, atol=2e-5)
        np.testing.assert_allclose(steps.reward[i], reward, rtol=1e-5, atol=2e-5)
        assert not terminated
        assert not steps.terminated[i]


def test_episodes_equal_gymnasiums():
    env = gymnasium.make("Pendulum-v1")
    env.reset(seed=1)
    task = Pendulum()
    step = jax.jit(task.step)
    state = PendulumState(*map(jnp.float32, env.unwrapped.state))
    actions = np.random.default_rng(1).integers(0, 11, task.horizon)
    for i, action in enumerate(actions):
        state, reward, _ = step(state, jnp.array(action), jax.random.key(0))
        torque = np.array([task.torque(jnp.array(action))])
        observation, expected, _, truncated, _ = env.step(torque)
        np.testing.assert_allclose(task.observe(state), observation, atol=2e-3)
        np.testing.assert_allclose(reward, expected, atol=2e-2)
        assert truncated == (i == task.horizon - 1)


def test_start_states_cover_gymnasiums_range():
    starts = jax.vmap(Pendulum().reset)(jax.random.split(jax.random.key(0), 4000))
    for values, bound in ((starts.theta, np.pi), (starts.theta_dot, 1.0)):
        assert np.abs(values).max() <= bound
        np.testing.assert_allclose(np.mean(values), 0, atol=0.06 * bound)
        np.testing.assert_allclose(np.std(values), bound / np.sqrt(3), rtol=0.03)


def test_torques_are_equally_spaced():
    task = Pendulum()
    np.testing.assert_allclose(task.torque(jnp.arange(11)), np.linspace(-2, 2, 11), atol=1e-6)


@pytest.mark.parametrize("settings", [{"torques": 1}, {"horizon": 0}])
def test_refuses_what_makes_no_sense(settings):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        Pendulum(**settings)
