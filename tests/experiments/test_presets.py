"""Which preset a task and an agent have, and what is said where they have none."""

import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments import presets


@pytest.mark.parametrize(
    ("task", "agent", "says"),
    [
        ("pendulum", "q-learning", "use it on pendulum/grid, or on pendulum use dqn, ppo, "),
        ("pendulum/grid", "ppo", "use it on pendulum, or on pendulum/grid use q-learning, sarsa, "),
        ("market/merton", "dqn", "on market/regime or market/ar1, or on market/merton use pathwis"),
        ("catch", "q-learning", "q-learning has no preset for catch; on catch use dqn."),
        ("catch", "tilts", "an agent for price tables .qfolio backtest.; on catch use dqn."),
    ],
)
def test_an_agent_that_does_not_fit_gets_advice(task, agent, says):
    with pytest.raises(QfolioError, match=says):
        presets.preset("fast", task, agent)


@pytest.mark.parametrize("task", ["portfolio", "pendulum", "gym:CartPole-v1", "own:Task"])
def test_a_wrong_agent_gets_advice(task):
    with pytest.raises(QfolioError, match=r"there is no agent 'ppp'; did you mean ppo\?"):
        presets.preset("fast", task, "ppp")
    if task != "pendulum":
        assert presets.preset("fast", task, "own:Agent").agent == "own:Agent"


def test_a_wrong_preset_gets_advice():
    with pytest.raises(QfolioError, match=r"no preset 'rainbo'.*; did you mean rainbow\?"):
        presets.preset("rainbo", "pendulum", "dqn")
