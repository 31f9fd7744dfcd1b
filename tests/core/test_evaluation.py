import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.core.evaluation import evaluate, greedy_episode, start_keys, step_key, tail_steps
from qfolio.core.mdp import Step
from qfolio.portfolio.synthetic.ar1 import Ar1
from qfolio.tasks.pendulum import Pendulum

from probes import Endless, OneState


def constant(agent, task, values):
    """Weights whose action values are ``values`` everywhere."""
    weights = agent.init(task, jax.random.key(0)).online
    last = jnp.array(values) * agent.reward_scale
    zero = jax.tree.map(jnp.zeros_like, weights)
    zero.mlp.biases[-1] = last
    return zero


def test_returns_equal_gymnasiums():
    steps = 40
    task, agent = Pendulum(horizon=steps), DQN()
    weights = agent.init(task, jax.random.key(3)).online
    keys = start_keys(3)
    returns = evaluate(task, agent, weights, keys, 0).returns
    env = gymnasium.make("Pendulum-v1", max_episode_steps=steps)
    for key, value in zip(keys, returns, strict=True):
        env.reset(seed=0)
        env.unwrapped.state = np.array(task.reset(key), float)
        total, truncated = 0.0, False
        observation = np.array(task.observe(task.reset(key)))
        while not truncated:
            action = agent.policy(weights, jnp.array(observation)[None])[0]
            observation, reward, _, truncated, _ = env.step(np.array([task.torque(action)]))
            total += reward
        assert total == pytest.approx(float(value), rel=1e-4)


def test_steps_are_independent_of_the_start():
    keys, market = start_keys(2000), Ar1()
    starts = jax.vmap(market.reset)(keys).market
    first = jax.vmap(step_key, (0, None))(keys, jnp.array(0))
    shocks = jax.vmap(market.next_market)(starts, first).signal - market.rho * starts.signal
    assert abs(np.corrcoef(starts.signal, shocks)[0, 1]) < 0.1
    for key in keys[:4]:
        steps = jax.vmap(step_key, (None, 0))(key, jnp.arange(64))
        drawn = jnp.concatenate([key[None], jax.random.split(key, 64), steps])
        assert len(np.unique(jax.random.key_data(drawn), axis=0)) == 1 + 64 + 64


def test_overestimation_by_hand():
    agent = DQN(discount=0.5)
    # A reward of 1 for ever is worth 2.
    weights = constant(agent, Endless(), [3.0, 1.0])
    greedy = evaluate(Endless(), agent, weights, start_keys(4), tail_steps(0.5))
    np.testing.assert_allclose(greedy.overestimation, 3.0 - 2.0, rtol=0.01)
    np.testing.assert_allclose(greedy.returns, 1.0)
    # One step that ends the episode pays 1.
    weights = constant(agent, OneState(), [0.0, 1.25])
    greedy = evaluate(OneState(), agent, weights, start_keys(4), 3)
    np.testing.assert_allclose(greedy.overestimation, 0.25, rtol=1e-5)
    np.testing.assert_allclose(greedy.returns, 1.0)


class Table(Endless):
    """Rewards of 1 from a table whose rows are at an end after ``rows`` steps of a start at 0."""

    rows: int = eqx.field(static=True, default=10)

    def reset(self, key):
        return jnp.where(jax.random.bernoulli(key), 0, 5)

    def observe(self, state):
        return jnp.ones(1)

    def step(self, state, action, key):
        paid = jnp.where(state < self.rows, 1.0, 100.0)  # which nobody will ever earn
        return Step(state + 1, paid, jnp.array(False))

    def steps_left(self, state):
        return self.rows - state


def test_what_cannot_follow_is_not_counted():
    """Starts whose discounted return would need steps behind the end of a task's data are left out;
    where that is all of them, the overestimation is unknown."""
    agent, keys = DQN(discount=0.5), start_keys(8)
    weights = constant(agent, Table(), [3.0, 1.0])
    greedy = evaluate(Table(), agent, weights, keys, tail_steps(0.5))
    np.testing.assert_allclose(greedy.overestimation, 3.0 - 2.0, rtol=0.01)
    np.testing.assert_allclose(greedy.returns, 1.0)
    greedy = evaluate(Table(rows=7), agent, weights, keys, tail_steps(0.5))
    assert np.isnan(greedy.overestimation)
    np.testing.assert_allclose(greedy.returns, 1.0)


def test_the_tail_is_long_enough():
    assert tail_steps(0.5) == 7
    assert 0.99 ** tail_steps(0.99) <= 0.01
    assert tail_steps(0.0) == 1
    assert tail_steps(1.0) == 2000


def test_a_value_that_no_tail_reaches_is_not_compared():
    """At a discount of 0.999 a reward of 1 for ever is worth 1,000, an eighth of it after 2,000."""
    agent = DQN(discount=0.999)
    weights = constant(agent, Endless(), [1000.0, 1.0])
    greedy = evaluate(Endless(), agent, weights, start_keys(4), tail_steps(0.999))
    assert np.isnan(greedy.overestimation)
    weights = constant(agent, OneState(), [0.0, 1.25])  # whose episodes end
    greedy = evaluate(OneState(), agent, weights, start_keys(4), tail_steps(0.999))
    np.testing.assert_allclose(greedy.overestimation, 0.25, rtol=1e-5)


def test_few_starts_are_the_first_of_many():
    few, many = (jax.random.key_data(start_keys(n)) for n in (3, 10))
    np.testing.assert_array_equal(few, many[:3])


@pytest.mark.parametrize("task", [Pendulum(horizon=50), Ar1(menu="grid:10", horizon=50)])
def test_greedy_episode_is_what_evaluate_counts(task):
    agent = DQN()
    weights = agent.init(task, jax.random.key(0)).online
    episode = greedy_episode(task, agent, weights, start_keys(2)[1])
    returns = evaluate(task, agent, weights, start_keys(2), 0).returns
    assert jax.tree.leaves(episode.states)[0].shape == (51,)
    np.testing.assert_allclose(episode.rewards.sum(), returns[1], rtol=1e-5)
