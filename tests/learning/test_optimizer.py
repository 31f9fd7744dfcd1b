"""Gradient steps against their formulas."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.a2c import A2C
from qfolio.agents.dqn import DQN
from qfolio.agents.ppo import PPO
from qfolio.core.errors import QfolioError
from qfolio.learning import optimizer
from qfolio.learning.optimizer import KINDS, OptimizerConfig
from qfolio.tasks.pendulum import Pendulum


def stepped(*gradients, **settings):
    """Where gradient steps lead from 0 at a learning rate of 1."""
    weight, state = jnp.zeros(()), optimizer.begin(jnp.zeros(()), OptimizerConfig(**settings))
    path = []
    for gradient in gradients:
        weight, state = optimizer.descend(weight, jnp.array(gradient), state, 1.0)
        path.append(float(weight))
    assert state.count == len(gradients)
    return path


def test_rmsprop_by_hand():
    """Of the gradients 2 and −1 with a decay of ½: mean squares 2 and 1.5."""
    path = stepped(2.0, -1.0, optimizer="rmsprop", rmsprop_decay=0.5, optimizer_epsilon=0.25)
    first, second = -2 / 2.25**0.5, 1 / 1.75**0.5
    np.testing.assert_allclose(path, [first, first + second], rtol=1e-6)


def test_centered_rmsprop_by_hand():
    """Means 1 and 0, whose squares are taken off the mean squares 2 and 1.5."""
    settings = {"optimizer": "rmsprop-centered", "rmsprop_decay": 0.5, "optimizer_epsilon": 0.25}
    first, second = -2 / 1.25**0.5, 1 / 1.75**0.5
    path = stepped(2.0, -1.0, **settings)
    np.testing.assert_allclose(path, [first, first + second], rtol=1e-6)


def test_plain_descent_by_hand():
    assert stepped(2.0, -1.0, optimizer="sgd") == [-2, -1]


def test_adam_by_hand():
    """Its first step is g / (|g| + ε); the second has means over two gradients, corrected for 0."""
    first, mean, square = -2 / 3, (0.9 * 0.2 - 0.1) / 0.19, (0.999 * 0.004 + 0.001) / 0.001999
    path = stepped(2.0, -1.0, optimizer_epsilon=1.0)
    np.testing.assert_allclose(path, [first, first - mean / (square**0.5 + 1)], rtol=1e-4)
    np.testing.assert_allclose(stepped(-2.0), [1], rtol=1e-4)


@pytest.mark.parametrize("largest", [1.0, 5.0, 10.0, math.inf])
def test_gradients_are_clipped_to_a_norm(largest):
    gradient = {"weights": jnp.array([[3.0], [0.0]]), "bias": jnp.array([4.0])}
    assert optimizer.norm(gradient) == 5
    clipped = optimizer.clip(gradient, largest)
    share = min(1, largest / 5)
    np.testing.assert_allclose(clipped["weights"], [[3 * share], [0]], rtol=1e-6)
    np.testing.assert_allclose(clipped["bias"], [4 * share], rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_every_optimizer_remembers_the_same_arrays(kind):
    """So that checkpoints of all kinds have one form."""
    state = optimizer.begin(jnp.zeros(3), DQN(optimizer=kind)._optimizer)
    assert (state.count.shape, state.mu.shape, state.nu.shape) == ((), (3,), (3,))


@pytest.mark.parametrize("kind", [A2C, DQN, PPO])
def test_agents_descend_by_the_optimizer_that_is_set(kind):
    agent = kind(hidden=(4,), optimizer="rmsprop", rmsprop_decay=0.5, optimizer_epsilon=0.25)
    state = agent.init(Pendulum(torques=3), jax.random.key(0))
    assert state.optimizer.config == OptimizerConfig("rmsprop", 0.5, 0.25)


@pytest.mark.parametrize(
    "settings", [{"optimizer": "adamw"}, {"rmsprop_decay": 1.0}, {"optimizer_epsilon": 0.0}]
)
def test_refuses_what_makes_no_sense(settings):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        DQN(**settings)
