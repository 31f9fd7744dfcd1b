import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox import filter_jit as jit

from qfolio.agents.dqn import DQN
from qfolio.core.errors import QfolioError
from qfolio.core.files import read_tree, write_tree
from qfolio.core.market import MenuActions
from qfolio.core.mdp import Transition
from qfolio.core.population import Population
from qfolio.experiments.presets import preset
from qfolio.learning import heads
from qfolio.learning.bootstrapped import Heads
from qfolio.learning.distributional import (
    Categorical,
    Expected,
    Quantile,
    project,
    quantile_huber_loss,
)
from qfolio.learning.encoders import MLP
from qfolio.learning.exploration import epsilon_greedy
from qfolio.learning.networks import Flat
from qfolio.learning.optimizer import CosineSchedule
from qfolio.learning.replay import Experience
from qfolio.learning.targets import (
    Scale,
    bootstrap,
    chosen,
    huber_loss,
    possible_values,
    smallest,
    td_target,
)
from qfolio.portfolio.following import begin, follow
from qfolio.portfolio.synthetic.ar1 import Ar1
from qfolio.portfolio.synthetic.leverage import Leverage
from qfolio.portfolio.synthetic.merton import Merton
from qfolio.portfolio.task import Portfolio
from qfolio.tasks.gymnasium import GymnasiumTask
from qfolio.tasks.pendulum import Pendulum

from planted import persistent
from populations import assert_same, train_to

VALUES, ROOTS = Scale(roots=False), Scale(roots=True)

structure: Any = jax.tree.structure  # the type of what it gives declares no ==


def rollout(agent, observation=1.0, reward=1.0, terminated=False, truncated=False):
    shape = (1, agent.num_envs)
    full = lambda shape, value: jnp.asarray(np.full(shape, value))  # noqa: E731
    return Transition(
        state=None,
        observation=full((*shape, 3), np.float32(observation)),
        action=full(shape, np.int32(0)),
        reward=full(shape, np.float32(reward)),
        next_state=None,
        next_observation=full((*shape, 3), np.float32(observation + 1)),
        terminated=full(shape, terminated),
        truncated=full(shape, truncated),
    )


def test_bootstrap_by_hand():
    target = jnp.array([[1.0, 2.0, 3.0], [6.0, 5.0, 4.0]])
    online = jnp.array([[9.0, 0.0, 0.0], [0.0, 0.0, 7.0]])
    np.testing.assert_allclose(bootstrap(target, target), [3, 6])  # max: Mnih et al.
    np.testing.assert_allclose(bootstrap(target, online), [1, 4])  # double


def test_the_smallest_estimate_by_hand():
    values = jnp.array([[1.0, 5.0, 2.0], [3.0, 4.0, 2.0]])
    np.testing.assert_array_equal(smallest(values), [1, 4, 2])
    slope = jax.grad(lambda x: (smallest(x) * jnp.array([1.0, 10, 100])).sum())(values)
    np.testing.assert_array_equal(slope, [[1, 0, 100], [0, 10, 0]])


def test_td_target_by_hand():
    target = td_target(
        jnp.array([1.0, 1.0]), jnp.array([False, True]), jnp.array([10.0, 10.0]), 0.9
    )
    np.testing.assert_allclose(target, [10, 1])


def test_possible_values_by_hand():
    """An episode may end at once or go on for ever."""
    values = lambda *rewards: possible_values(jnp.array(rewards), 0.75)  # noqa: E731
    np.testing.assert_allclose(values(-2.0, 1.0), [-8, 4])
    np.testing.assert_allclose(values(-2.0, -1.0), [-8, -1])
    np.testing.assert_allclose(values(1.0, 2.0), [1, 8])
    np.testing.assert_allclose(values(0.0, 0.0), [0, 0])
    assert np.isfinite(possible_values(jnp.array([-1.0, 1.0]), 1.0)).all()


def test_huber_loss_by_hand():
    errors = jnp.array([0.5, -0.5, 3.0, -3.0])
    np.testing.assert_allclose(huber_loss(errors, 1.0), [0.125, 0.125, 2.5, 2.5])
    np.testing.assert_allclose(huber_loss(errors, jnp.inf), [0.125, 0.125, 4.5, 4.5])
    slopes = jax.vmap(jax.grad(huber_loss), (0, None))
    np.testing.assert_allclose(slopes(errors, 1.0), [0.5, -0.5, 1, -1])
    np.testing.assert_allclose(slopes(errors, jnp.inf), errors)


def gradients(agent, state, target):
    """Of the loss of a batch in the online and the target network."""
    batch = sampled(agent, state)

    def loss(online, target):
        losses = agent._losses(online, target, batch, agent.discount, jax.random.key(3))
        return losses.each.mean()

    return jax.jit(jax.grad(loss, argnums=(0, 1)))(state.online, target)


def sampled(agent, state):
    replay = jit(agent.observe)(state, rollout(agent)).replay
    return jit(replay.sample)(jax.random.key(2), 8)


def largest(gradient):
    return max(float(jnp.abs(g).max()) for g in jax.tree.leaves(gradient))


def test_observing_learns_nothing(task, agent):
    state = jit(agent.init)(task, jax.random.key(0))
    after = jit(agent.observe)(state, rollout(agent))
    assert_same(after.online, state.online)
    assert after.replay.size == agent.num_envs


@pytest.mark.parametrize(
    ("terminated", "truncated", "wrong", "expected"),
    [(False, True, False, False), (False, True, True, True), (True, False, False, True)],
)
def test_what_counts_as_the_end(task, terminated, truncated, wrong, expected):
    agent = DQN(num_envs=2, time_limit_terminal=wrong, episode_steps=0)
    state = jit(agent.init)(task, jax.random.key(0))
    state = jit(agent.observe)(state, rollout(agent, terminated=terminated, truncated=truncated))
    assert state.replay.unpack(state.replay.rows).terminal[:2].tolist() == [expected] * 2


def test_the_gradient_reaches_the_online_network_only(task, agent):
    state = jit(agent.init)(task, jax.random.key(0))
    other = jit(agent.init)(task, jax.random.key(1)).online
    assert largest(gradients(agent, state, other)[0]) > 0
    assert largest(gradients(agent, state, other)[1]) == 0


@pytest.mark.parametrize("values", ["expected", "categorical", "quantile"])
def test_selecting_and_evaluating_have_no_gradient(task, agent, values):
    """With γ = 0 what follows does not matter, and nor may its gradient with γ > 0."""
    changes = {"values": values, "double": True, "dueling": True, "atoms": 7, "huber_delta": 1.0}
    changes |= {"v_min": -1000.0, "v_max": 1000.0}
    agent = dataclasses.replace(agent, **changes, discount=0.9)
    state = jit(agent.init)(task, jax.random.key(0))
    other = jit(agent.init)(task, jax.random.key(1)).online
    online, target = gradients(agent, state, other)
    assert largest(online) > 0
    assert largest(target) == 0
    # Scaling what the targets are made of moves the targets, not the way that the gradient takes.
    batch = sampled(agent, state)

    def targets_moved_by_hand(online):
        frozen = jax.tree.map(jax.lax.stop_gradient, state.online)
        z = chosen(agent._read(online, batch.observation), batch.action)
        kind = agent._values
        selector = kind.mean(agent._read(frozen, batch.next_observation))
        following = bootstrap(agent._read(other, batch.next_observation), selector)
        target = batch.reward[:, None] + 0.9 * kind.outcomes(following)
        return kind.loss(z, target, following)[0].mean()

    expected = jax.jit(jax.grad(targets_moved_by_hand))(state.online)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)  # noqa: E731
    jax.tree.map(close, online, expected)


def first_layer(network):
    return network.mlp.weights[0]


def test_the_target_network_is_copied_every_period(task):
    agent = DQN(
        hidden=(8,), num_envs=1, batch_size=4, target_update_interval=3, tau=1.0,
        learning_rate=1e-2,
    )  # fmt: skip
    state = jit(agent.init)(task, jax.random.key(0))
    same = []
    for i in range(6):
        state, _ = jit(agent.learn)(Pendulum(), state, rollout(agent), jax.random.key(i))
        same.append(bool((first_layer(state.target) == first_layer(state.online)).all()))
    assert same == [False, False, True, False, False, True]


@pytest.mark.optimized
def test_the_report_presets_copies_come_at_the_end_of_each_episode():
    """Every hyperparameter of the report, and the step at which it copies: 200, 400, …"""
    agent, task = preset("report").build(), Pendulum()
    assert agent == DQN(
        hidden=(256, 256), num_envs=1, episode_steps=0, batch_size=64, gradient_steps=1,
        replay_capacity=50_000, learning_starts=64, double=False, time_limit_terminal=False,
        target_update_interval=200, tau=1.0, discount=0.99, learning_rate=1e-3,
        learning_rate_final=1.0, epsilon_start=1.0, epsilon_end=0.01, epsilon_decay=0.995,
        huber_delta=float("inf"), reward_scale=1.0, input_gain=0.0,
    )  # fmt: skip
    population = Population(task, agent, [0])
    copied = []
    for step in (63, 199, 200, 201, 399, 400):
        state = train_to(population, step).fetch().agent
        copied.append(bool((first_layer(state.target) == first_layer(state.online)).all()))
    assert copied == [True, False, True, False, False, True]


def test_the_target_network_follows_softly(task):
    agent = DQN(hidden=(8,), num_envs=1, batch_size=4, target_update_interval=1, tau=0.25)
    before = jit(agent.init)(task, jax.random.key(0))
    after, _ = jit(agent.learn)(Pendulum(), before, rollout(agent), jax.random.key(1))
    expected = 0.75 * first_layer(before.target) + 0.25 * first_layer(after.online)
    np.testing.assert_allclose(first_layer(after.target), expected, rtol=1e-5, atol=1e-7)


def test_learns_once_from_several_steps(task):
    """Two rollouts of three steps; the target network is copied at the fourth step."""
    agent = DQN(
        hidden=(4,), num_envs=2, batch_size=4, train_freq=3, target_update_interval=4, tau=1.0
    )
    assert agent.rollout_steps == 3
    state = jit(agent.init)(task, jax.random.key(0))
    parts = [rollout(agent, float(i)) for i in (1, 2, 3)]
    steps = jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *parts)
    copied = []
    for i in range(2):
        state, _ = jit(agent.learn)(task, state, steps, jax.random.key(i))
        copied.append(bool((first_layer(state.target) == first_layer(state.online)).all()))
    assert (int(state.steps), int(state.replay.size), int(state.optimizer.count)) == (6, 12, 2)
    stored = state.replay.unpack(state.replay.rows[:12]).observation[:, 0]
    np.testing.assert_array_equal(stored, [1, 1, 2, 2, 3, 3] * 2)
    assert copied == [False, True]


def test_epsilon_decays_with_finished_episodes(task):
    agent = DQN(num_envs=1, epsilon_start=1.0, epsilon_end=0.5, epsilon_decay=0.9)
    state = jit(agent.init)(task, jax.random.key(0))
    values = []
    for _ in range(8):
        values.append(float(agent.monitor(state)["epsilon"]))
        state = jit(agent.observe)(state, rollout(agent, truncated=True))
    expected = [max(0.5, 0.9**i) for i in range(8)]
    np.testing.assert_allclose(values, expected, rtol=1e-5)


def test_epsilon_falls_along_a_line(task):
    """From 1 to 0.1 over 8 steps of two environments, and then no further."""
    agent = DQN(hidden=(4,), num_envs=2, epsilon_end=0.1, epsilon_steps=8.0)
    state = agent.init(task, jax.random.key(0))
    values = []
    for _ in range(6):
        values.append(float(agent.monitor(state)["epsilon"]))
        state = agent.observe(state, rollout(agent, truncated=True))
    np.testing.assert_allclose(values, [1, 0.775, 0.55, 0.325, 0.1, 0.1], rtol=1e-6)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_explores_with_probability_epsilon(task, epsilon):
    agent = DQN(num_envs=1, epsilon_start=epsilon, epsilon_end=epsilon)
    state = jit(agent.init)(task, jax.random.key(0))
    n, actions = 20_000, task.actions.n
    observation = jnp.ones((n, 3))
    taken = np.asarray(jit(agent.act)(state, observation, jax.random.key(1)))
    greedy = int(jit(agent.policy)(state.online, observation)[0])
    share = np.bincount(taken, minlength=actions) / n
    expected = np.full(actions, epsilon / actions)
    expected[greedy] += 1 - epsilon
    np.testing.assert_allclose(share, expected, atol=0.012)


def test_the_learning_rate_falls_along_a_cosine():
    schedule = CosineSchedule(2.0, 0.5, learning_rate_steps=100.0)
    rates = [float(schedule(jnp.array(i))) for i in (0, 50, 100, 1000)]
    np.testing.assert_allclose(rates, [2, 1.5, 1, 1], rtol=1e-6)


def test_adam_equals_its_formula(task):
    """One update against Adam written out (Kingma & Ba 2015, algorithm 1)."""
    agent = DQN(hidden=(8,), num_envs=1, batch_size=4, learning_rate=0.01)
    before = jit(agent.init)(task, jax.random.key(0))
    after, _ = jit(agent.learn)(Pendulum(), before, rollout(agent), jax.random.key(1))
    replay = jit(agent.observe)(before, rollout(agent)).replay
    batch = jit(replay.sample)(jax.random.key(1), 4)
    target = before.target
    assert not isinstance(target, Heads)
    loss = lambda w: agent._losses(w, target, batch, 0.99, jax.random.key(0))  # noqa: E731
    gradient = jax.jit(jax.grad(lambda w: loss(w).each.mean()))(before.online)
    # At the first step Adam's direction is g / (|g| + ε).
    step = jax.tree.map(lambda g: 0.01 * g / (np.abs(g) + 1e-8), gradient)
    expected = jax.tree.map(lambda w, d: np.asarray(w) - d, before.online, step)
    close = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5)  # noqa: E731
    jax.tree.map(close, after.online, expected)


@pytest.mark.parametrize(
    "settings",
    [
        {"discount": 1.5}, {"learning_rate": 0.0}, {"batch_size": 0}, {"hidden": ()},
        {"epsilon_start": -0.1}, {"huber_delta": 0.0},
        {"learning_starts": 100, "replay_capacity": 50},
        {"n_steps": 0}, {"n_steps": 30, "num_envs": 4, "replay_capacity": 100},
        {"priority_exponent": 1.1}, {"values": "means"}, {"atoms": 1, "values": "categorical"},
        {"v_max": -10.0, "values": "categorical"},
        {"huber_delta": float("inf"), "values": "quantile"},
        {"noise_scale": -1.0}, {"persistence": 1.5}, {"importance_steps": 0.0},
        {"epsilon_steps": -1.0}, {"train_freq": 0}, {"train_freq": 4, "persistence": 0.5},
        {"bootstrap_heads": 2}, {"outcomes": 2}, {"market_baseline": True},
    ],
)  # fmt: skip
def test_refuses_what_makes_no_sense(settings):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        DQN(**settings)


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (Pendulum(torques=0), "those of Pendulum are continuous; use sac or ppo"),
        (Merton(), "those of Merton are continuous; give it a menu of .* or use sac or ppo"),
        (Leverage(), "those of Leverage are continuous; use sac or ppo"),
        (GymnasiumTask("Pendulum-v1"), "those of Pendulum-v1 are continuous; use sac or ppo"),
    ],
)
def test_continuous_actions_are_refused_by_the_tasks_name(task, words):
    with pytest.raises(QfolioError, match=f"dqn chooses among numbered actions, but {words}"):
        DQN().init(task, jax.random.key(0))


@pytest.mark.parametrize(
    "changes", [{"values": "quantile", "huber_delta": 1.0}, {"n_steps": 2}, {"prioritized": True},
                {"noisy": True}, {"persistence": 0.5}, {"value_rescaling": True},
                {"time_limit_terminal": True}],
)  # fmt: skip
def test_all_actions_refuses_what_moves_do_not_give(changes):
    with pytest.raises(QfolioError, match=f"set {next(iter(changes))}="):
        DQN(all_actions=True, **changes)


def projected_by_hand(outcomes, probabilities, support):
    """Algorithm 1 of Bellemare et al. (2017), as it is printed."""
    low, high, count = support[0], support[-1], len(support)
    result = np.zeros((len(outcomes), count))
    for row, (values, shares) in enumerate(zip(outcomes, probabilities, strict=True)):
        for value, share in zip(values, shares, strict=True):
            b = (np.clip(value, low, high) - low) / (high - low) * (count - 1)
            lower, upper = int(np.floor(b)), int(np.ceil(b))
            if lower == upper:
                result[row, lower] += share
            else:
                result[row, lower] += share * (upper - b)
                result[row, upper] += share * (b - lower)
    return result


def test_categorical_projection_by_hand():
    support = jnp.array([0.0, 1.0, 2.0])
    outcomes = jnp.array([[0.25, 1.0], [-5.0, 9.0], [2.0, 1.5]])
    shares = jnp.array([[0.4, 0.6], [0.3, 0.7], [0.5, 0.5]])
    expected = [[0.3, 0.7, 0.0], [0.3, 0.0, 0.7], [0.0, 0.25, 0.75]]
    np.testing.assert_allclose(jit(project)(outcomes, shares, support), expected, atol=1e-6)


def test_categorical_projection_equals_the_published_algorithm():
    rng = np.random.default_rng(0)
    support = np.linspace(-3.0, 5.0, 51)
    outcomes = rng.normal(1.0, 3.0, (200, 51))
    shares = rng.dirichlet(np.ones(51), 200)
    with jax.enable_x64(True):
        result = jit(project)(jnp.array(outcomes), jnp.array(shares), jnp.array(support))
        np.testing.assert_allclose(result, projected_by_hand(outcomes, shares, support), atol=1e-12)


@pytest.mark.parametrize("spacing", ["equal", "unequal"])
def test_the_projection_keeps_means_within_the_support(spacing):
    rng = np.random.default_rng(1)
    support = np.linspace(-3.0, 5.0, 9)
    if spacing == "unequal":
        support[1:-1] = np.sort(rng.uniform(-3, 5, 7))
    outcomes = rng.uniform(-3, 5, (50, 7))
    shares = rng.dirichlet(np.ones(7), 50)
    means = (
        np.asarray(jit(project)(*map(jnp.asarray, (outcomes, shares, support)))) * support
    ).sum(1)
    np.testing.assert_allclose(means, (outcomes * shares).sum(1), atol=1e-5)


def test_the_categorical_priority_is_the_divergence():
    kind = Categorical(VALUES, 5, -2.0, 2.0)
    z = jnp.asarray(np.random.default_rng(0).normal(size=(3, 5)), jnp.float32)
    target = kind.outcomes(z)
    loss, off = jit(kind.loss)(z, target, z)  # the target is the estimate itself
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    assert (np.asarray(loss) > 0.1).all()
    assert (np.asarray(jit(kind.loss)(z, target + 1, z)[1]) > 0.01).all()


def test_values_of_roots_by_hand():
    """The root of 3 is 1, that of 8 is 2: z (2 + z)."""
    expected = Expected(ROOTS, math.inf)
    z, target = jnp.array([[1.0]]), jnp.array([[8.0]])
    np.testing.assert_allclose(expected.mean(z), [3.0])
    np.testing.assert_allclose(expected.outcomes(z), [[3.0]])
    np.testing.assert_allclose(jit(expected.loss)(z, target, z), [[0.5], [1.0]], rtol=1e-6)

    categorical = Categorical(ROOTS, 5, -8.0, 8.0)
    np.testing.assert_allclose(categorical.support, [-8, -3, 0, 3, 8], atol=1e-6)
    z = jnp.log(jnp.array([[0.1, 0.2, 0.3, 0.1, 0.3]]))
    np.testing.assert_allclose(categorical.mean(z), [-0.8 - 0.6 + 0.3 + 2.4], rtol=1e-5)

    quantile = Quantile(ROOTS, 2, 10.0)
    z, target = jnp.array([[2.0, 0.0]]), jnp.array([[15.0, 3.0]])  # whose roots are 3 and 1
    np.testing.assert_allclose(quantile.mean(z), [4.0])
    np.testing.assert_allclose(quantile.outcomes(z), [[8.0, 0.0]])
    loss, off = jit(quantile.loss)(z, target, z)
    np.testing.assert_allclose(loss, jit(quantile_huber_loss)(z, jnp.array([[3.0, 1.0]]), 10.0))
    np.testing.assert_allclose(off, [9.0 - 4.0])


def test_quantile_huber_loss_by_hand():
    """Levels ¼ and ¾ of two quantiles, errors 1 and −1 of the one and 3 and 1 of the other."""
    quantiles, outcomes = jnp.array([[2.0, 0.0]]), jnp.array([[3.0, 1.0]])
    squared = (0.25 * 0.5 + 0.75 * 0.5) / 2 + (0.75 * 4.5 + 0.75 * 0.5) / 2
    clipped = (0.25 * 0.5 + 0.75 * 0.5) / 2 + (0.75 * 2.5 + 0.75 * 0.5) / 2
    loss = jax.jit(quantile_huber_loss)
    np.testing.assert_allclose(loss(quantiles, outcomes, 10.0), [squared])
    np.testing.assert_allclose(loss(quantiles, outcomes, 1.0), [clipped])


def test_quantiles_that_minimise_the_loss_are_the_quantiles():
    """Of 0, 1, …, 99 at the middles of four parts: 12, 37, 62, 87, each half way to the next."""
    outcomes = jnp.arange(100.0)[None]
    slope = jax.jit(jax.grad(lambda q: quantile_huber_loss(q, outcomes, 0.01).sum()))
    quantiles = jnp.zeros((1, 4))
    for _ in range(3000):
        quantiles = quantiles - 100.0 * slope(quantiles)
    np.testing.assert_allclose(quantiles[0], [12, 37, 62, 87], atol=1.0)


def test_duelling_by_hand():
    z = jnp.array([[[10.0], [1.0], [2.0], [6.0]]])
    np.testing.assert_allclose(heads.duel(z)[0, :, 0], [8, 9, 13])


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("values", ["expected", "categorical"])
def test_action_values_are_the_means_in_units_of_reward(task, noisy, values):
    """And nothing of them, nor of the policy, depends on noise."""
    agent = DQN(
        hidden=(8, 8), dueling=True, noisy=noisy, values=values, atoms=5, v_min=0.0, v_max=4.0,
        reward_scale=0.5,
    )  # fmt: skip
    online = jit(agent.init)(task, jax.random.key(0)).online
    observation = jnp.asarray(np.random.default_rng(1).normal(size=(6, 3)), jnp.float32)
    assert isinstance(online, Flat)
    outputs = np.asarray(jit(online)(observation)).reshape(6, 12, -1)
    z = outputs[:, :1] + outputs[:, 1:] - outputs[:, 1:].mean(1, keepdims=True)
    shares = np.exp(z) / np.exp(z).sum(-1, keepdims=True)
    means = shares @ np.arange(5.0) if values == "categorical" else z[..., 0]
    found = jit(agent.action_values)(online, observation)
    assert found is not None
    np.testing.assert_allclose(found, 2 * means, rtol=1e-4)
    np.testing.assert_array_equal(jit(agent.policy)(online, observation), means.argmax(1))


def test_noise_is_factorised_and_of_the_size_that_it_starts_with():
    """Fortunato et al. 2018, eq. 10, 11: f(x) f(y) on a weight, f(y) on a bias; E f² = √(2/π)."""

    @jax.jit
    def drawn():
        plain = MLP((64, 32), jax.random.key(0))
        noisy = heads.NoisyMLP(plain, 0.5)
        draws = jax.vmap(noisy.draw)(jax.random.split(jax.random.key(1), 500))
        return draws.weights[0] - plain.weights[0], draws.biases[0] - plain.biases[0]

    weight, bias = (np.asarray(difference) / (0.5 / 8) for difference in drawn())
    by_input = weight / bias[:, None, :]
    np.testing.assert_allclose(by_input, by_input[:, :, :1] + 0 * by_input, rtol=2e-2, atol=1e-3)
    moment = np.sqrt(2 / np.pi)
    np.testing.assert_allclose((bias**2).mean(), moment, rtol=0.05)
    np.testing.assert_allclose((weight**2).mean(), moment**2, rtol=0.05)
    np.testing.assert_allclose(weight.mean(), 0, atol=0.02)


def test_noise_is_drawn_anew_for_each_act_and_explores(task):
    agent = DQN(hidden=(8, 8), noisy=True, epsilon_start=0.0, epsilon_end=0.0)
    state = jit(agent.init)(task, jax.random.key(0))
    observation = jnp.ones((1, 3))
    keys = jax.random.split(jax.random.key(1), 200)
    act = jit(jax.vmap(lambda state, key: agent.act(state, observation, key)[0], (None, 0)))
    assert len(set(act(state, keys).tolist())) > 1
    quiet = dataclasses.replace(agent, noise_scale=0.0)
    state = jit(quiet.init)(task, jax.random.key(0))
    greedy = int(jit(quiet.policy)(state.online, observation)[0])
    assert set(act(state, keys).tolist()) == {greedy}


def test_exploring_goes_on_with_the_last_action(task):
    """With ε = 1 and full persistence every action is the last one of its environment."""
    agent = DQN(hidden=(8,), num_envs=3, replay_capacity=7, persistence=1.0, learning_starts=3)
    state = jit(agent.init)(task, jax.random.key(0))
    for turn in range(5):  # the ring of 9 rows begins anew
        last = jnp.array([turn, 1, 2]) % 3
        steps = rollout(agent)
        state = jit(agent.observe)(state, steps._replace(action=last[None]))
        seen = jit(agent.act)(state, jnp.ones((3, 3)), jax.random.key(turn))
        np.testing.assert_array_equal(seen, last)


def test_how_often_the_last_action_comes_again():
    """ε · persistence, and else ε-greedy: 0.6 · 0.5 = 0.3, and 0.7 · (0.6 / 4) by chance."""
    values, last = jnp.array([[0.0, 9.0, 0.0, 0.0]]), jnp.array([2])
    draw = lambda key: epsilon_greedy(key, values, 0.6, last, 0.5)[0]  # noqa: E731
    actions = jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 20_000))
    shares = np.bincount(actions, minlength=4) / len(actions)
    by_chance = np.array([0.0, 0.7 * 0.4, 0.3, 0.0]) + 0.7 * 0.6 / 4
    np.testing.assert_allclose(shares, by_chance, atol=0.01)


def test_sizes_of_noise_are_learned(task, agent):
    agent = dataclasses.replace(agent, noisy=True)
    state = jit(agent.init)(task, jax.random.key(0))
    gradient, _ = gradients(agent, state, state.online)
    noisy = gradient.mlp.streams[0]
    assert largest(noisy.weight_scales) > 0
    assert largest(noisy.bias_scales) > 0


def test_targets_are_without_noise(task, agent):
    """Only the values that are compared with them are noisy."""
    agent = dataclasses.replace(agent, noisy=True, double=True, noise_scale=0.0)
    quiet = jit(agent.init)(task, jax.random.key(0)).online
    noisier = dataclasses.replace(agent, noise_scale=5.0)
    loud = jit(noisier.init)(task, jax.random.key(0)).online
    row = Experience.like((), jnp.ones(3), jnp.array(0))
    batch = jax.tree.map(lambda x: np.ones((4, *x.shape), x.dtype), row)
    batch = jax.tree.map(jnp.asarray, batch._replace(terminal=np.zeros(4, bool)))

    def spread(online, target):
        each = lambda key: agent._losses(online, target, batch, 0.9, key).each  # noqa: E731
        return np.ptp(jit(jax.vmap(each))(jax.random.split(jax.random.key(1), 5)), axis=0)

    np.testing.assert_array_equal(spread(quiet, loud), 0)
    assert (spread(loud, quiet) > 1e-3).all()


def test_prioritized_updates_set_the_priorities_of_what_was_drawn(task):
    """Written out: β = 0.4 at the first update, priorities (|error| + 10⁻⁶)^α afterwards."""
    agent = DQN(
        hidden=(8,),
        num_envs=4,
        batch_size=6,
        prioritized=True,
        importance_steps=10.0,
        replay_capacity=16,
        learning_starts=8,
    )
    before = jit(agent.init)(task, jax.random.key(0))
    for i in range(2):
        before = jit(agent.observe)(before, rollout(agent, observation=float(i), reward=i - 0.5))
    step = rollout(agent, observation=3.0)
    after, metrics = jit(agent.learn)(task, before, step, jax.random.key(1))
    replay = jit(agent.observe)(before, step).replay
    losses_of = jit(
        lambda online, target, batch: agent._losses(online, target, batch, 0.99, jax.random.key(0))
    )
    draw = jit(lambda replay, key: (replay.draw(key, 6), replay.at(replay.draw(key, 6))))
    index, batch = draw(replay, jax.random.key(1))
    losses = losses_of(before.online, before.target, batch)
    np.testing.assert_allclose(metrics["loss"], losses.each.mean(), rtol=1e-5)  # all alike so far
    expected = np.ones(16)
    expected[12:] = 0
    expected[np.asarray(index)] = (np.asarray(losses.off) + 1e-6) ** 0.6
    assert after.replay.priorities is not None
    np.testing.assert_allclose(after.replay.priorities.of(jnp.arange(16)), expected, rtol=1e-4)
    _, metrics = jit(agent.learn)(task, after, step, jax.random.key(2))
    replay = jit(agent.observe)(after, step).replay
    index, batch = draw(replay, jax.random.key(2))
    losses = losses_of(after.online, after.target, batch)
    beta = 0.4 + 0.6 / 10
    assert replay.priorities is not None
    weight = replay.priorities.importance(index, beta)
    assert float(weight.min()) < 1
    np.testing.assert_allclose(metrics["loss"], (weight * losses.each).mean(), rtol=1e-4)


def test_learning_waits_for_the_steps_that_a_return_needs():
    agent = DQN(num_envs=8, n_steps=5, learning_starts=8)
    assert agent.warm_up() == 4


def learned_abstractly(agent, task, state):
    """Shapes after acting and learning; types are checked on the way."""

    def step(state):
        states = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), agent.num_envs))
        observation = jax.vmap(task.observe)(states)
        action = agent.act(state, observation, jax.random.key(1))
        no = jnp.zeros(agent.num_envs, bool)
        step = (states, observation, action, jnp.zeros(len(no)), states, observation, no, no)
        rollout = Transition(*jax.tree.map(lambda x: x[None], step))
        return agent.learn(task, state, rollout, jax.random.key(2))[0]

    return jax.eval_shape(step, state)


@pytest.mark.parametrize("network", ["flat", "mlp"])
def test_every_option_fits_a_market(network):
    """Values of a menu with choices for each asset keep their order with several numbers each."""
    market = Merton(menu="tilts:0.1")
    agent = DQN(
        network=network, hidden=(8, 8, 8), num_envs=4, batch_size=8, learning_starts=16,
        replay_capacity=64, double=True, dueling=True, n_steps=2, prioritized=True, noisy=True,
        values="quantile", atoms=3, huber_delta=1.0,
    )  # fmt: skip
    state = jit(agent.init)(market, jax.random.key(0))
    assert structure(learned_abstractly(agent, market, state)) == structure(state)
    seen = jit(jax.vmap(lambda key: market.observe(market.reset(key))))
    view = seen(jax.random.split(jax.random.key(0), 5))
    values = jit(agent.action_values)(state.online, view)
    assert values is not None
    assert isinstance(market.actions, MenuActions)
    assert values.shape == (5, market.actions.n)
    if network == "mlp":
        mirrored = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[:, ::-1]), view)
        pooled, each = market.actions.pooled, market.actions.each
        other = jit(agent.action_values)(state.online, mirrored)
        assert other is not None
        np.testing.assert_allclose(other[:, :pooled], values[:, :pooled], atol=1e-5)
        blocks, mirror = (v[:, pooled:].reshape(5, each, 3) for v in (values, other))
        assert np.ptp(blocks, axis=2).min() > 1e-4
        np.testing.assert_allclose(mirror, blocks[:, :, ::-1], atol=1e-5)


def test_all_actions_can_duel():
    market = Ar1(menu="grid:10")
    agent = DQN(
        hidden=(8, 8), num_envs=4, batch_size=8, learning_starts=16, replay_capacity=64,
        dueling=True, double=True, all_actions=True, market_baseline=True,
    )  # fmt: skip
    state = jit(agent.init)(market, jax.random.key(0))
    assert structure(learned_abstractly(agent, market, state)) == structure(state)


def test_priorities_are_part_of_what_is_saved(task, agent, tmp_path):
    agent = dataclasses.replace(agent, prioritized=True)
    fresh = jit(agent.init)(task, jax.random.key(0))
    state = jax.tree.map(np.asarray, jit(agent.observe)(fresh, rollout(agent)))
    write_tree(tmp_path / "state", state)
    again = read_tree(tmp_path / "state", fresh)
    assert again.replay.priorities.levels[-1].sum() == agent.num_envs
    assert_same(again, state)


@pytest.mark.slow
def test_on_signals_it_departs_from_the_anchor_only_where_that_pays_for_its_costs():
    chosen = preset("fast", "portfolio", "dqn")
    prices = persistent(rows=1500, market=0.01)

    def departed(cost):
        task = Portfolio.of(prices, **{**chosen.task, "cost": cost})
        agent = chosen.build()
        population = train_to(Population(task, agent, [0, 1, 2]), chosen.episodes)
        start = begin(task, np.tile(np.append(0, np.full(6, 1 / 6)), (3, 1)))
        first = int(task.first_decision)
        targets, _ = follow(task, agent, population.weights(), first, start, 1200)
        return abs(targets[..., 1:] - 1 / 6).sum(-1).mean(-1)

    assert (departed(0.001) > 0.5).all()
    # Values that leave out the price of the way back depart here, too.
    assert (departed(0.01) < 0.15).all(), "no more than the band around the anchor"


def test_what_the_way_back_to_the_anchor_costs_is_learned():
    chosen = preset("fast", "portfolio", "dqn")
    task = Portfolio.of(persistent(rows=500, market=0.01), **{**chosen.task, "cost": 0.02})
    agent = chosen.build(bootstrap_heads=2, learning_starts=256, num_envs=8)
    learned = train_to(Population(task, agent, [0]), 128).weights().networks
    assert (learned.price > 0.1).all()
    assert (learned.way_back > 0.1).all()
