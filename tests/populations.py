"""Training populations, and what they hold."""

import jax
import jax.numpy as jnp
import numpy as np


def train_to(population, steps, strict=True):
    """The population after that many steps of each environment."""
    while population.steps < steps:
        population.advance(steps - population.steps, strict=strict)
    return population


def first_member(tree):
    """The first member's part of what a population holds."""
    return jax.tree.map(lambda x: jnp.asarray(x[0]), tree)


def stored(population):
    """The first member's replay buffer."""
    replay = population.fetch().agent.replay
    return replay.unpack(jnp.array(replay.rows[0]))


def assert_same(one, other):
    """Requires the arrays of two trees to be equal."""
    jax.tree.map(np.testing.assert_array_equal, one, other)
