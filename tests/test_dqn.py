import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.errors import QfolioError
from qfolio.mdp import Transition
from qfolio.optimizer import learning_rate
from qfolio.presets import preset
from qfolio.targets import bootstrap, huber_loss, td_target
from qfolio.tasks.pendulum import Pendulum
from qfolio.training import Population


def rollout(agent, observation=1.0, reward=1.0, terminated=False, truncated=False):
    shape = (1, agent.environments)
    return Transition(
        state=None,
        observation=jnp.full((*shape, 3), observation),
        action=jnp.zeros(shape, jnp.int32),
        reward=jnp.full(shape, reward),
        next_state=None,
        next_observation=jnp.full((*shape, 3), observation + 1),
        terminated=jnp.full(shape, terminated),
        truncated=jnp.full(shape, truncated),
    )


def test_bootstrap_by_hand():
    target = jnp.array([[1.0, 2.0, 3.0], [6.0, 5.0, 4.0]])
    online = jnp.array([[9.0, 0.0, 0.0], [0.0, 0.0, 7.0]])
    np.testing.assert_allclose(bootstrap(target, target), [3, 6])  # max: Mnih et al.
    np.testing.assert_allclose(bootstrap(target, online), [1, 4])  # double


def test_td_target_by_hand():
    goal = td_target(jnp.array([1.0, 1.0]), jnp.array([False, True]), jnp.array([10.0, 10.0]), 0.9)
    np.testing.assert_allclose(goal, [10, 1])


def test_huber_loss_by_hand():
    errors = jnp.array([0.5, -0.5, 3.0, -3.0])
    np.testing.assert_allclose(huber_loss(errors, 1.0), [0.125, 0.125, 2.5, 2.5])
    np.testing.assert_allclose(huber_loss(errors, jnp.inf), [0.125, 0.125, 4.5, 4.5])
    slopes = jax.vmap(jax.grad(huber_loss), (0, None))
    np.testing.assert_allclose(slopes(errors, 1.0), [0.5, -0.5, 1, -1])
    np.testing.assert_allclose(slopes(errors, jnp.inf), errors)


def test_observing_learns_nothing(task, agent):
    state = agent.init(task, jax.random.key(0))
    after = agent.observe(state, rollout(agent))
    jax.tree.map(np.testing.assert_array_equal, after.online, state.online)
    assert after.replay.size == agent.environments


@pytest.mark.parametrize(
    ("terminated", "truncated", "wrong", "expected"),
    [(False, True, False, False), (False, True, True, True), (True, False, False, True)],
)
def test_what_counts_as_the_end(task, terminated, truncated, wrong, expected):
    agent = DQN(environments=2, time_limit_terminal=wrong, episode_steps=0)
    state = agent.init(task, jax.random.key(0))
    state = agent.observe(state, rollout(agent, terminated=terminated, truncated=truncated))
    assert state.replay.unpack(state.replay.rows).terminal[:2].tolist() == [expected] * 2


def test_the_gradient_reaches_the_online_network_only(task, agent):
    state = agent.init(task, jax.random.key(0))
    other = agent.init(task, jax.random.key(1)).online
    batch = agent.observe(state, rollout(agent)).replay.sample(jax.random.key(2), 8)
    loss = lambda online, target: agent._loss(online, target, batch)[0]  # noqa: E731
    online, target = jax.grad(loss, argnums=(0, 1))(state.online, other)
    assert max(float(jnp.abs(g).max()) for g in jax.tree.leaves(online)) > 0
    assert max(float(jnp.abs(g).max()) for g in jax.tree.leaves(target)) == 0


def test_the_target_network_is_copied_every_period(task):
    agent = DQN(
        hidden=(8,), environments=1, batch_size=4, target_period=3, target_rate=1.0,
        learning_rate=1e-2,
    )  # fmt: skip
    state = agent.init(task, jax.random.key(0))
    same = []
    for i in range(6):
        state, _ = agent.learn(Pendulum(), state, rollout(agent), jax.random.key(i))
        same.append(bool((state.target.mlp.weights[0] == state.online.mlp.weights[0]).all()))
    assert same == [False, False, True, False, False, True]


def test_the_report_presets_copies_come_at_the_end_of_each_episode():
    """Every hyperparameter of the report, and the step at which it copies: 200, 400, …"""
    agent, task = preset("report").build(), Pendulum()
    assert agent == DQN(
        hidden=(256, 256), environments=1, episode_steps=0, batch_size=64, updates=1,
        replay_capacity=50_000, learning_starts=64, double=False, time_limit_terminal=False,
        target_period=200, target_rate=1.0, discount=0.99, learning_rate=1e-3,
        learning_rate_final=1.0, epsilon=1.0, epsilon_end=0.01, epsilon_decay=0.995,
        huber=float("inf"), reward_scale=1.0, input_gain=0.0,
    )  # fmt: skip
    population = Population(task, agent, [0])
    copied = []
    for step in (63, 199, 200, 201, 399, 400):
        while population.steps < step:
            population.advance(step - population.steps)
        state = population.fetch().agent
        copied.append(bool((state.target.mlp.weights[0] == state.online.mlp.weights[0]).all()))
    assert copied == [True, False, True, False, False, True]


def test_the_target_network_follows_softly(task):
    agent = DQN(hidden=(8,), environments=1, batch_size=4, target_period=1, target_rate=0.25)
    before = agent.init(task, jax.random.key(0))
    after, _ = agent.learn(Pendulum(), before, rollout(agent), jax.random.key(1))
    expected = 0.75 * before.target.mlp.weights[0] + 0.25 * after.online.mlp.weights[0]
    np.testing.assert_allclose(after.target.mlp.weights[0], expected, rtol=1e-5, atol=1e-7)


def test_epsilon_decays_with_finished_episodes(task):
    agent = DQN(environments=1, epsilon=1.0, epsilon_end=0.5, epsilon_decay=0.9)
    state = agent.init(task, jax.random.key(0))
    values = []
    for _ in range(8):
        values.append(float(agent.epsilon_now(state)))
        state = agent.observe(state, rollout(agent, truncated=True))
    expected = [max(0.5, 0.9**i) for i in range(8)]
    np.testing.assert_allclose(values, expected, rtol=1e-5)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_explores_with_probability_epsilon(task, epsilon):
    agent = DQN(environments=1, epsilon=epsilon, epsilon_end=epsilon)
    state = agent.init(task, jax.random.key(0))
    n, actions = 20_000, task.actions.n
    observation = jnp.ones((n, 3))
    taken = np.asarray(agent.act(state, observation, jax.random.key(1)))
    greedy = int(agent.policy(state.online, observation)[0])
    share = np.bincount(taken, minlength=actions) / n
    expected = np.full(actions, epsilon / actions)
    expected[greedy] += 1 - epsilon
    np.testing.assert_allclose(share, expected, atol=0.012)


def test_the_learning_rate_falls_along_a_cosine():
    agent = DQN(learning_rate=2.0, learning_rate_final=0.5, learning_rate_steps=100.0)
    rates = [float(learning_rate(agent, jnp.array(i))) for i in (0, 50, 100, 1000)]
    np.testing.assert_allclose(rates, [2, 1.5, 1, 1], rtol=1e-6)


def test_adam_equals_its_formula(task):
    """One update against Adam written out (Kingma & Ba 2015, algorithm 1)."""
    agent = DQN(hidden=(8,), environments=1, batch_size=4, learning_rate=0.01)
    before = agent.init(task, jax.random.key(0))
    after, _ = agent.learn(Pendulum(), before, rollout(agent), jax.random.key(1))
    replay = agent.observe(before, rollout(agent)).replay
    batch = replay.sample(jax.random.key(1), 4)
    gradient = jax.grad(lambda w: agent._loss(w, before.target, batch)[0])(before.online)
    # At the first step Adam's direction is g / (|g| + ε).
    step = jax.tree.map(lambda g: 0.01 * g / (jnp.abs(g) + 1e-8), gradient)
    expected = jax.tree.map(lambda w, d: w - d, before.online, step)
    close = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5)  # noqa: E731
    jax.tree.map(close, after.online, expected)


@pytest.mark.parametrize(
    "settings",
    [
        {"discount": 1.5}, {"learning_rate": 0.0}, {"batch_size": 0}, {"hidden": ()},
        {"epsilon": -0.1}, {"huber": 0.0}, {"learning_starts": 100, "replay_capacity": 50},
    ],
)  # fmt: skip
def test_refuses_what_makes_no_sense(settings):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        DQN(**settings)
