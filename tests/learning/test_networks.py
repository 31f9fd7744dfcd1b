from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from qfolio.agents.dqn import DQN
from qfolio.agents.ppo import PPO
from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.market import View
from qfolio.core.mdp import Step
from qfolio.core.population import Population
from qfolio.experiments import presets
from qfolio.learning import networks
from qfolio.learning.encoders import CNN, LSTM, MLP, RNN
from qfolio.learning.networks import SHARED, NetworkConfig, Outputs, Shared
from qfolio.tasks.catch import Catch
from qfolio.tasks.hidden_pendulum import HiddenPendulum
from qfolio.tasks.pendulum import Pendulum

from populations import first_member, train_to
from probes import TERMINATED, TwoStates

KEY = jax.random.key(3)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def normal(*shape):
    return jax.random.normal(KEY, shape)


def test_an_image_is_convolved_as_xla_does_it():
    x, cnn = normal(5, 6, 7, 2), CNN((6, 7, 2), 24, KEY)
    # Our neighborhoods run by column, then row, then channel.
    kernel = cnn.first.weights[0].reshape(3, 3, 2, 3).transpose(1, 0, 2, 3)
    found = lax.conv_general_dilated(
        x, kernel, (1, 1), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    found = jnp.maximum(found + cnn.first.biases[0], 0).reshape(5, -1)
    expected = found @ cnn.second.weights[0] + cnn.second.biases[0]
    np.testing.assert_allclose(cnn(x), expected, atol=1e-5)


def test_a_window_is_convolved_as_xla_does_it():
    x, cnn = normal(4, 9, 2), CNN((9, 2), 16, KEY)
    kernel = cnn.first.weights[0].reshape(3, 2, 2)
    found = lax.conv_general_dilated(
        x, kernel, (1,), "VALID", dimension_numbers=("NWC", "WIO", "NWC")
    )
    found = jnp.maximum(found + cnn.first.biases[0], 0).reshape(4, -1)
    expected = found @ cnn.second.weights[0] + cnn.second.biases[0]
    np.testing.assert_allclose(cnn(x), expected, atol=1e-5)


def test_a_gated_recurrent_unit_by_hand():
    x, rnn = normal(4, 6, 2), RNN((6, 2), 3, KEY)
    w, b, u = rnn.inputs.weights[0], rnn.inputs.biases[0], rnn.state
    state = np.zeros((4, 3))
    for row in np.moveaxis(x, 1, 0):
        reset = sigmoid(row @ w[:, :3] + b[:3] + state @ u[:, :3])
        update = sigmoid(row @ w[:, 3:6] + b[3:6] + state @ u[:, 3:6])
        candidate = np.tanh(row @ w[:, 6:] + b[6:] + reset * (state @ u[:, 6:]))
        state = update * state + (1 - update) * candidate
    np.testing.assert_allclose(rnn(x), state, atol=1e-5)


def test_long_short_term_memory_by_hand():
    x, lstm = normal(4, 6, 2), LSTM((6, 2), 3, KEY)
    w, b, u = lstm.inputs.weights[0], lstm.inputs.biases[0], lstm.state
    output = cell = np.zeros((4, 3))
    for row in np.moveaxis(x, 1, 0):
        write, keep, show, new = np.split(row @ w + b + output @ u, 4, axis=1)
        cell = sigmoid(keep) * cell + sigmoid(write) * np.tanh(new)
        output = sigmoid(show) * np.tanh(cell)
    np.testing.assert_allclose(lstm(x), output, atol=1e-5)
    assert float(b[3:6].min()) > 1 - 2**-0.5  # the forget gate starts open


def test_orthogonal_layers_by_hand():
    """Columns are orthogonal, √2 long (1 in the last layer), and tanh stands between the layers."""
    mlp = MLP((5, 3, 2), KEY, 2.0, "tanh", "orthogonal")
    first, last = (np.asarray(weight) for weight in mlp.weights)
    np.testing.assert_allclose(first.T @ first, 2.0**2 * 2 * np.eye(3), atol=1e-5)
    np.testing.assert_allclose(last.T @ last, np.eye(2), atol=1e-5)
    assert not any(bias.any() for bias in mlp.biases)
    x = normal(4, 5)
    np.testing.assert_allclose(mlp(x), np.tanh(x @ first) @ last, rtol=1e-5)


@pytest.mark.parametrize("name", ["activation", "initialization"])
def test_refuses_other_layers_than_there_are(name):
    wrong: dict[str, Any] = {name: "sine"}
    with pytest.raises(QfolioError, match=f"{name} is sine; it must be one of"):
        PPO(**wrong)
    with pytest.raises(QfolioError, match=f"{name} is .*; it must be .* unless network=flat"):
        PPO(network="mlp", activation="tanh" if name == "activation" else "relu",
            initialization="orthogonal")  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "task"),
    [
        ("flat", Catch()), ("cnn", Catch()), ("flat", HiddenPendulum()), ("cnn", HiddenPendulum()),
        ("rnn", HiddenPendulum()), ("lstm", HiddenPendulum()),
    ],
)  # fmt: skip
def test_every_network_fits_what_is_observed(kind, task):
    observation = jax.vmap(lambda key: task.observe(task.reset(key)))(jax.random.split(KEY, 6))
    network = networks.build(NetworkConfig(kind, (16, 8)), task, observation[0], Outputs(3), KEY)
    assert jax.eval_shape(network, observation).shape == (6, 3)
    gradient = jax.jit(jax.grad(lambda n: (n(observation) ** 2).sum()))(network)
    for leaf in jax.tree.leaves(gradient):  # every part takes part
        assert jnp.abs(leaf).max() > 0


@pytest.mark.parametrize("kind", ["cnn", "rnn", "lstm"])
def test_the_input_gain_is_of_each_channel(kind):
    class Scaled(HiddenPendulum):
        @property
        def observation_scale(self):
            return (1.0, 4.0) * self.window

    task = Scaled()
    observation = task.observe(task.reset(KEY))
    plain, gained = (
        networks.build(NetworkConfig(kind, (16,), gain), task, observation, Outputs(3), KEY)
        for gain in (0.0, 2.0)
    )
    first = lambda n: (n.encoder.first if kind == "cnn" else n.encoder.inputs).weights[0]  # noqa: E731
    ratio = first(gained) / first(plain)
    np.testing.assert_allclose(ratio[::2], 2.0, rtol=1e-6)
    np.testing.assert_allclose(ratio[1::2], 0.5, rtol=1e-6)


@pytest.mark.parametrize("kind", SHARED)
def test_assets_share_a_network_whatever_their_order(kind):
    view = View(normal(2, 4, 5, 3), normal(2, 4))
    one = jax.tree.map(lambda x: x[0], view)
    network = Shared(kind, one, (16, 8), pooled=2, each=3, key=KEY)
    order = jnp.array([2, 0, 3, 1])
    market, each = eqx.filter_jit(network)(view)
    moved = View(view.features[:, order], view.holding[:, order])
    market_again, each_again = eqx.filter_jit(network)(moved)
    np.testing.assert_allclose(market_again, market, atol=1e-5)
    np.testing.assert_allclose(each_again, each[:, order], atol=1e-5)
    assert jnp.abs(each_again - each).max() > 1e-3


@pytest.mark.parametrize(
    ("kind", "task", "message"),
    [
        ("rnn", Catch(), "windows"),
        ("lstm", Pendulum(), "windows"),
        ("cnn", Pendulum(), "images"),
        ("mlp", Catch(), "network=flat"),
        ("cnn", HiddenPendulum(window=2), "3 rows"),
    ],
)
def test_a_network_says_what_it_cannot_read(kind, task, message):
    with pytest.raises(QfolioError, match=message):
        DQN(network=kind, hidden=(16,)).init(task, KEY)


class Blind(TwoStates):
    def observe(self, state):
        return jnp.zeros(0)


@pytest.mark.parametrize("kind", ["flat", "rnn"])
def test_a_network_needs_something_to_read(kind):
    with pytest.raises(QfolioError, match="Observations of Blind hold no number, but a network"):
        DQN(network=kind, hidden=(16,)).init(Blind(), KEY)


class Recall(TwoStates):
    """One step; the action must match the first row of three: Q(s, a) = s · (2a − 1)."""

    def observe(self, state):
        return jnp.stack([state, 0.0 * state, 0.0 * state])[:, None]

    def step(self, state, action, key):
        return Step(state, state * (2.0 * action - 1.0), TERMINATED)


LEARNER: dict[str, Any] = {
    "num_envs": 4, "batch_size": 32, "replay_capacity": 1000, "learning_starts": 100,
    "target_update_interval": 1, "tau": 0.05, "learning_rate": 3e-3, "learning_rate_steps": 800.0,
    "learning_rate_final": 0.0, "epsilon_end": 0.2,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rnn", "lstm"])
def test_an_agent_recalls_what_it_saw_first(kind):
    agent = DQN(**{**LEARNER, "network": kind, "hidden": (16,)})
    weights = first_member(train_to(Population(Recall(), agent, [100]), 800).weights())
    seen = jax.vmap(Recall().observe)(jnp.array([1.0, -1.0]))
    values = agent.action_values(weights, seen)
    assert values is not None
    np.testing.assert_allclose(values, [[-1, 1], [1, -1]], atol=0.02)


@pytest.mark.optimized
def test_an_agent_learns_to_catch_what_it_sees():
    agent = DQN(
        **{**LEARNER, "network": "cnn", "hidden": (64,), "num_envs": 32, "batch_size": 64,
           "replay_capacity": 16_384, "learning_starts": 1024, "discount": 0.97,
           "learning_rate": 1e-3, "learning_rate_steps": 1500.0, "epsilon_decay": 0.999},
    )  # fmt: skip
    population = train_to(Population(Catch(), agent, [100, 101]), 1500)
    np.testing.assert_array_equal(population.evaluate(start_keys(256), tail=0).returns, 1.0)


@pytest.mark.optimized
def test_the_hidden_pendulum_is_swung_up_and_held():
    preset = presets.preset("fast", "pendulum/hidden", "dqn")
    task = settings.build(HiddenPendulum, preset.task)
    population = Population(task, preset.build(), [100])
    while left := population.steps_left(preset.episodes):
        population.advance(left)
    optimum = task.optimum()
    assert optimum is not None
    best = optimum.returns(start_keys()).mean()
    returns = population.evaluate(start_keys(), tail=0).returns.mean(1)
    assert (best - returns) / abs(best) < 0.1
