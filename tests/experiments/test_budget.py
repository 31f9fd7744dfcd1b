import jax
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.reinforce import REINFORCE
from qfolio.core.population import Population
from qfolio.experiments.budget import unlearned
from qfolio.tasks.pendulum import Pendulum


@pytest.mark.parametrize(("starts", "freq"), [(1, 1), (8, 1), (9, 1), (10, 1), (8, 4)])
def test_an_agent_is_unlearned_until_its_weights_move(starts, freq):
    agent = DQN(
        hidden=(8,), num_envs=2, batch_size=8, replay_capacity=64, learning_starts=starts,
        train_freq=freq,
    )  # fmt: skip
    population = Population(Pendulum(horizon=20), agent, [0])
    first = population.fetch().agent
    for _ in range(6):
        population.advance(1)
        weights = agent.weights(population.fetch().agent)
        moved = not all(
            np.array_equal(*pair)
            for pair in zip(*map(jax.tree.leaves, (agent.weights(first), weights)), strict=True)
        )
        assert bool(unlearned(agent, 2 * population.steps)) is not moved


def test_an_agent_without_a_buffer_learns_at_once():
    assert unlearned(REINFORCE(), 1) == ""


def test_what_was_unlearned_has_both_numbers():
    agent = DQN(num_envs=32, learning_starts=2048, replay_capacity=4096)
    assert unlearned(agent, 896).startswith(
        "learns nothing: it begins after 2,016 environment steps, and a seed has 896."
    )
