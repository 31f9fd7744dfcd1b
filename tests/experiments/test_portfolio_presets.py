"""Each preset for portfolios fits the task: its agent begins, acts and decides on it."""

import jax
import jax.numpy as jnp
import pytest

from qfolio.core import settings
from qfolio.core.mdp import Discrete, Simplex
from qfolio.experiments.presets import PRESETS
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk

NAMES = [(agent, name) for (on, agent), of in PRESETS.items() if on == "portfolio" for name in of]


def test_every_kind_of_agent_has_one():
    agents = {agent for agent, name in NAMES if name == "fast"}
    assert {"dqn", "pathwise", "ppo", "a2c", "reinforce", "ddpg", "td3", "sac"} <= agents


@pytest.mark.parametrize(("agent_name", "name"), NAMES)
def test_its_actions_are_those_of_the_task(agent_name, name):
    preset = PRESETS["portfolio", agent_name][name]
    task = Portfolio.of(price_table(random_walk(600)), **settings.convert(Portfolio, preset.task))
    agent = preset.build()
    assert preset.episodes % agent.num_envs == 0
    assert isinstance(task.actions, Discrete if agent_name == "dqn" else Simplex)

    def decide(key):
        state = agent.init(task, key)
        states = jax.vmap(task.reset)(jax.random.split(key, agent.num_envs))
        views = jax.vmap(task.observe)(states)
        greedy = agent.policy(agent.weights(state), views)
        return jax.vmap(task.intent)(states, greedy), agent.act(state, views, key)

    targets, actions = jax.eval_shape(decide, jax.random.key(0))
    assert targets.shape == (agent.num_envs, 4)
    assert actions.dtype == (jnp.int32 if agent_name == "dqn" else jnp.float32)
