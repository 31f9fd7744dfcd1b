"""The report's settings, and what one environment step with one update of them costs.

Counted per agent and step: 2 operations for each multiply-add of the matrix products, 4 bytes for
each number.
"""

from itertools import pairwise
from typing import Any

from qfolio.agents.ddpg import DDPG
from qfolio.agents.dqn import DQN
from qfolio.agents.ppo import PPO
from qfolio.agents.sac import SAC
from qfolio.agents.td3 import TD3
from qfolio.core.mdp import Agent
from qfolio.experiments.presets import preset
from qfolio.tasks.pendulum import Pendulum

EPISODES = preset("report").episodes

PASSES = 12
"""Over arrays of the network's size, in a step with its update.

Both networks are read forward and the Q-network once more backward (3); the gradient is written and
read again (2); Adam reads and writes the weights and both moments (6); acting reads the Q-network
(1). The target network is written at few of the steps.
"""


def families() -> dict[str, Agent]:
    """Other algorithms on the pendulum with continuous torques; peers.py has the same settings."""
    off_policy: dict[str, Any] = {
        "hidden": (256, 256), "batch_size": 256, "replay_capacity": 50_000,
        "learning_starts": 256, "learning_rate": 1e-3, "tau": 0.005, "discount": 0.99,
    }  # fmt: skip
    return {
        "ppo": PPO(
            num_envs=4, rollout_length=1024, epochs=10, batch_size=64, hidden=(64, 64),
            discount=0.9, gae_lambda=0.95, learning_rate=1e-3, entropy_coef=0.0,
        ),
        "sac": SAC(**off_policy),
        "td3": TD3(**off_policy),
        "ddpg": DDPG(**off_policy),
    }  # fmt: skip


def hosted() -> dict[str, Agent]:
    """Agents by algorithm and environment of Gymnasium; peers.py has the same settings."""
    return {
        "dqn-CartPole-v1": DQN(
            hidden=(64, 64), batch_size=64, replay_capacity=50_000, learning_starts=1000,
            target_update_interval=200, learning_rate=1e-3, discount=0.99,
        ),
        "ppo-CartPole-v1": PPO(
            num_envs=8, rollout_length=128, epochs=10, batch_size=64, hidden=(64, 64),
            discount=0.99, gae_lambda=0.95, learning_rate=1e-3, entropy_coef=0.0,
        ),
        "sac-Pendulum-v1": SAC(
            num_envs=4, gradient_steps=4, batch_size=128, hidden=(64, 64), discount=0.98, tau=0.02,
            replay_capacity=50_000, learning_starts=256, learning_rate=2e-3,
        ),
    }  # fmt: skip


def report() -> tuple[Pendulum, DQN]:
    agent = preset("report").build()
    assert isinstance(agent, DQN)
    return Pendulum(), agent


def layers(task: Pendulum, agent: DQN) -> list[tuple[int, int]]:
    """Inputs and outputs of each layer; the pendulum's observation has three numbers."""
    return list(pairwise((3, *agent.hidden, task.actions.n)))


def products(task: Pendulum, agent: DQN) -> int:
    """Matrix products of an update: those that ``operations`` counts."""
    return 4 * len(layers(task, agent)) - 1


def operations(task: Pendulum, agent: DQN) -> int:
    """Of the matrix products of an update.

    Forward through the Q-network and the target network, backward to the weights of all layers and
    to the inputs of all but the first.
    """
    sizes = [inputs * outputs for inputs, outputs in layers(task, agent)]
    return 2 * agent.batch_size * (3 * sum(sizes) + sum(sizes[1:]))


def parameters(task: Pendulum, agent: DQN) -> int:
    return sum((inputs + 1) * outputs for inputs, outputs in layers(task, agent))


def bytes_moved(task: Pendulum, agent: DQN) -> int:
    """What crosses the memory of a GPU at least, whose caches do not hold all agents' networks.

    Activations and the batch are left out.
    """
    return 4 * PASSES * parameters(task, agent)
