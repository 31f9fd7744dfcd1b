"""Hyperparameters that belong together: what was tuned for which task."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.registry import AGENTS, GYM, find

if TYPE_CHECKING:
    from qfolio.core.mdp import Agent


class Preset(NamedTuple):
    """An agent's settings, and how far it is trained, with how many seeds, unless told otherwise.

    That is a number of episodes, or of steps of an agent's environments where episodes end early.
    """

    agent: str
    settings: dict[str, Any]
    episodes: int = 0
    seeds: int = 1
    task: Mapping[str, Any] = MappingProxyType({})  # of the task's settings, those it goes with
    steps: int = 0

    def build(self, **changes: Any) -> "Agent":
        """The agent, with some settings changed."""
        return settings.build(find("agent", AGENTS, self.agent), {**self.settings, **changes})

    @property
    def budget(self) -> dict[str, int]:
        """How far, as ``Run.create`` takes it."""
        return {"steps": self.steps} if self.steps else {"episodes": self.episodes}


_FAST = {
    "hidden": (128, 128),
    "input_gain": 6.0,
    "environments": 32,
    "episode_steps": 28,
    "batch_size": 256,
    "replay_capacity": 65_536,
    "learning_starts": 1024,
    "target_period": 1,
    "target_rate": 0.03,
    "discount": 0.995,
    "learning_rate": 3e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 7500.0,
    "epsilon_decay": 0.995,
    "huber": 0.3,
    "reward_scale": 0.3,
    "v_min": -100.0,
    "v_max": 100.0,
}

_BEST = {
    **_FAST,
    "hidden": (192, 192),
    "episode_steps": 40,
    "replay_capacity": 262_144,
    "learning_rate": 2e-3,
    "learning_rate_steps": 30_000.0,
}

_RAINBOW = {
    **_FAST,
    "double": True,
    "dueling": True,
    "n_steps": 2,
    "prioritised": True,
    "values": "quantile",
    "atoms": 8,
    "noisy": True,
    "noise_scale": 0.1,
    "updates": 2,
    "learning_rate_steps": 15_000.0,
}

_CATEGORICAL = {
    **_FAST,
    "values": "categorical",
    "rescale_values": True,
    "reward_scale": 1.0,
    "v_min": -400.0,
    "v_max": 400.0,
    "n_steps": 2,
    "target_rate": 0.02,
    "updates": 2,
    "learning_rate_steps": 15_000.0,
}

_HIDDEN = {**_FAST, "network": "lstm", "hidden": (64, 128), "input_gain": 12.0}

_CATCH = {
    "network": "cnn",
    "hidden": (128,),
    "environments": 32,
    "batch_size": 64,
    "replay_capacity": 32_768,
    "learning_starts": 1024,
    "target_period": 1,
    "target_rate": 0.05,
    "discount": 0.97,
    "learning_rate": 1e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 36_000.0,
    "epsilon_end": 0.1,
    "epsilon_decay": 0.9995,
}

_ON_POLICY = {
    "episode_steps": 64,
    "input_gain": 6.0,
    "reward_scale": 0.1,
    "learning_rate_final": 0.0,
}

_PPO = {
    **_ON_POLICY,
    "environments": 64,
    "rollout": 64,
    "batch_size": 512,
    "discount": 0.99,
    "trace": 0.9,
    "learning_rate": 3e-3,
    "learning_rate_steps": 19_520.0,
    "entropy_weight": 0.02,
}

_A2C = {
    **_ON_POLICY,
    "environments": 8,
    "rollout": 8,
    "trace": 0.95,
    "discount": 0.99,
    "learning_rate": 1e-3,
    "learning_rate_steps": 15_616.0,
    "entropy_weight": 0.02,
}

_REINFORCE = {
    **_ON_POLICY,
    "environments": 16,
    "rollout": 64,
    "discount": 0.99,
    "learning_rate": 2e-3,
    "learning_rate_steps": 3906.0,
}

_TORQUE = {
    "hidden": (128, 128),
    "input_gain": 6.0,
    "environments": 12,
    "episode_steps": 28,
    "batch_size": 256,
    "n_steps": 2,
    "replay_capacity": 131_072,
    "learning_starts": 1024,
    "target_rate": 0.02,
    "discount": 0.995,
    "learning_rate": 3e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 8000.0,
    "actor_rate": 0.6,
    "huber": 0.3,
    "rescale_values": True,
}

_MODEL = {  # 2,000 real steps, with 4 gradient steps of SAC for each behind the first 200
    **_TORQUE,
    "environments": 1,
    "episode_steps": 40,
    "n_steps": 1,
    "replay_capacity": 2048,
    "learning_starts": 200,
    "target_rate": 0.03,
    "discount": 0.99,
    "learning_rate_steps": 7200.0,
    "huber": math.inf,
    "updates": 4,
    "model_updates": 2,
    "members": 3,
    "spread": 0.05,
}

_PORTFOLIO_TASK = {"window": 60, "horizon": 50, "reward": "crra", "risk_aversion": 5.0}

_PORTFOLIO_DQN = {
    "network": "mlp",
    "hidden": (16, 16),
    "all_actions": True,
    "market_baseline": True,
    "environments": 8,
    "batch_size": 64,
    "replay_capacity": 8192,
    "learning_starts": 3200,
    "target_period": 1,
    "target_rate": 0.05,
    "discount": 0.99,
    "learning_rate": 3e-4,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 600.0,
    "reward_scale": 100.0,
}

_PORTFOLIO_PATHWISE = {
    "hidden": (16, 16),
    "rollout": 25,
    "environments": 16,
    "learning_rate": 5e-4,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 100.0,
    "reward_scale": 100.0,
    "gradient_norm": 1.0,
}

_MARKET_PATHWISE = {"hidden": (16, 16), "learning_rate": 1e-2, "learning_rate_final": 0.0}

_MARKET_DQN = {
    "hidden": (32,),
    "all_actions": True,
    "double": True,
    "environments": 1024,
    "replay_capacity": 524_288,
    "learning_starts": 1024,
    "target_period": 1,
    "target_rate": 0.05,
    "discount": 0.97,
    "learning_rate": 3e-2,
    "learning_rate_final": 0.0,
    "epsilon_end": 1.0,  # what is explored does not matter where all actions are learned
    "reward_scale": 100.0,
}


def _pathwise(episodes: int, **changes: Any) -> dict[str, Preset]:
    """An episode is a rollout, so that each starts from a holding drawn anew."""
    changes["episode_steps"] = changes["rollout"]
    return {"fast": Preset("pathwise", {**_MARKET_PATHWISE, **changes}, episodes, seeds=5)}


def _all_actions(episodes: int, **changes: Any) -> dict[str, Preset]:
    changes = {**_MARKET_DQN, **changes}
    return {"fast": Preset("dqn", changes, episodes, seeds=5, task={"menu": "grid:10"})}


# Small inputs count (input_gain), and the few bad ends travel back fast (n_steps).
_GYM_DQN = {
    "hidden": (128, 128),
    "input_gain": 3.0,
    "dueling": True,
    "double": True,
    "n_steps": 4,
    "environments": 8,
    "batch_size": 256,
    "replay_capacity": 65_536,
    "learning_starts": 1000,
    "target_period": 1,
    "target_rate": 0.03,
    "learning_rate": 2e-3,
    "learning_rate_final": 0.0,
    "epsilon_decay": 0.99,
    "epsilon_end": 0.02,
    "huber": 1.0,
    "reward_scale": 0.1,
}

_GYM_PPO: dict[str, Any] = {
    "environments": 8,
    "rollout": 32,
    "batch_size": 256,
    "epochs": 20,
    "discount": 0.98,
    "trace": 0.8,
    "learning_rate": 1e-3,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 7800.0,
}


def _gym(id: str, agent: str, steps: int, **changes: Any) -> Preset:
    return Preset(agent, changes, steps=steps, seeds=4, task={"id": id})


def _gym_dqn(id: str, steps: int, **changes: Any) -> dict[str, Preset]:
    """DQN whose learning rate has fallen to zero at the end."""
    settings = {**_GYM_DQN, **changes}
    settings["learning_rate_steps"] = float(steps // settings["environments"])
    return {"fast": _gym(id, "dqn", steps, **settings)}


def _torque(agent: str, **changes: Any) -> dict[str, Preset]:
    """The pendulum with any torque; 8,000 steps of all environments."""
    changes = {**_TORQUE, **changes}
    episodes = 289 * changes["environments"]
    return {"fast": Preset(agent, changes, episodes, seeds=8, task={"torques": 0})}


_CLIFF = {"epsilon_end": 0.1}

_LAKE = {
    "environments": 8,
    "learning_rate": 0.5,
    "learning_rate_decay": 0.02,
    "initial_value": 1.0,
    "epsilon_end": 0.1,
    "epsilon_decay": 0.9998,
}

_RANDOM = {
    "environments": 8,
    "discount": 0.95,
    "learning_rate": 0.5,
    "learning_rate_decay": 0.02,
    "epsilon_end": 0.1,
    "epsilon_decay": 0.998,
}

_GRID_PENDULUM = {
    "environments": 16,
    "episode_steps": 40,
    "discount": 0.995,
    "learning_rate": 0.5,
    "learning_rate_decay": 0.01,
    "epsilon": 0.2,
    "epsilon_end": 0.2,
}

_SARSA = {"epsilon": 0.05, "epsilon_end": 0.05}  # what SARSA learns counts its exploration


def _tables(task: str, settings: dict[str, Any], episodes: int) -> dict[tuple[str, str], Any]:
    """Presets of the tabular agents that differ in nothing but their algorithm."""
    names = ("q-learning", "sarsa", "expected-sarsa", "double-q", "dyna-q")
    return {(task, name): {"fast": Preset(name, settings, episodes, seeds=8)} for name in names}


PRESETS = {
    ("pendulum", "dqn"): {
        "fast": Preset("dqn", _FAST, episodes=8608, seeds=8),
        "best": Preset("dqn", _BEST, episodes=24_032, seeds=8),
        "categorical": Preset("dqn", _CATEGORICAL, episodes=8608, seeds=8),
        "rainbow": Preset("dqn", _RAINBOW, episodes=8608, seeds=8),
        # Each hyperparameter of the report that qfolio grew out of; they are DQN's defaults.
        "report": Preset("dqn", {}, episodes=600, seeds=1),
    },
    ("pendulum/hidden", "dqn"): {
        "fast": Preset("dqn", _HIDDEN, episodes=8608, seeds=8, task={"window": 2}),
    },
    ("catch", "dqn"): {
        "fast": Preset(
            "dqn",
            _CATCH,
            episodes=115_200,
            seeds=8,
            task={"rows": 12, "columns": 11, "decoys": 3},
        ),
    },
    ("pendulum", "ppo"): {
        "fast": Preset("ppo", _PPO, episodes=15_616, seeds=8),
    },
    ("pendulum", "a2c"): {
        "fast": Preset("a2c", _A2C, episodes=15_616, seeds=8, task={"torques": 0}),
    },
    ("pendulum", "reinforce"): {
        "fast": Preset("reinforce", _REINFORCE, episodes=62_496, seeds=8, task={"torques": 0}),
    },
    ("pendulum", "ddpg"): _torque(
        "ddpg",
        environments=32,
        replay_capacity=262_144,
        updates=2,
        learning_rate_steps=16_000.0,
        exploration=0.3,
        actor_rate=0.3,
    ),
    ("pendulum", "td3"): _torque("td3", policy_delay=1, target_noise=0.05, exploration=0.3),
    ("pendulum", "sac"): _torque("sac", spread=0.05),
    ("pendulum", "mbpo"): {"fast": Preset("mbpo", _MODEL, 50, seeds=8, task={"torques": 0})},
    ("market/kelly", "pathwise"): _pathwise(
        307_200, environments=1024, rollout=5, learning_rate_steps=300.0, reward_scale=10.0
    ),
    ("market/merton", "pathwise"): _pathwise(
        153_600, environments=512, rollout=5, learning_rate_steps=300.0, reward_scale=10.0
    ),
    ("market/regime", "pathwise"): _pathwise(
        12_800, environments=64, rollout=50, learning_rate_steps=200.0, reward_scale=100.0
    ),
    ("market/regime", "dqn"): _all_actions(2048, batch_size=512, learning_rate_steps=500.0),
    ("market/ar1", "pathwise"): _pathwise(
        25_600, environments=64, rollout=63, tail=21, learning_rate_steps=400.0, reward_scale=100.0
    ),
    ("market/ar1", "dqn"): _all_actions(8192, batch_size=1024, learning_rate_steps=2016.0),
    ("market/no-trade", "pathwise"): _pathwise(
        19_200,
        environments=64,
        rollout=120,
        tail=60,
        learning_rate_steps=300.0,
        reward_scale=1000.0,
    ),
    ("market/garleanu-pedersen", "pathwise"): _pathwise(
        25_600,
        environments=64,
        rollout=50,
        tail=20,
        learning_rate_steps=400.0,
        reward_scale=10.0,
        gradient_norm=0.3,
    ),
    ("gym:CartPole-v1", "dqn"): _gym_dqn("CartPole-v1", 120_000, discount=0.98, epsilon_end=0.05),
    ("gym:CartPole-v1", "ppo"): {"fast": _gym("CartPole-v1", "ppo", 100_000, **_GYM_PPO)},
    ("gym:Acrobot-v1", "dqn"): _gym_dqn("Acrobot-v1", 60_000),
    # The goal is hardly ever found by chance. A push that lasts gets there; and what was never
    # tried keeps its value of about 0, above all that was, unless returns over steps, a stream for
    # V or a flat first layer level it down.
    ("gym:MountainCar-v0", "dqn"): _gym_dqn(
        "MountainCar-v0",
        400_000,
        input_gain=10.0,
        dueling=False,
        n_steps=1,
        discount=0.98,
        environments=16,
        replay_capacity=262_144,
        persistence=0.9,
        reward_scale=0.03,
    ),
    ("gym:LunarLander-v3", "dqn"): _gym_dqn(
        "LunarLander-v3",
        300_000,
        replay_capacity=131_072,
        input_gain=1.0,
        learning_rate=1e-3,
        reward_scale=0.03,
    ),
    ("portfolio", "dqn"): {
        "fast": Preset(
            "dqn",
            _PORTFOLIO_DQN,
            episodes=160,
            seeds=5,
            task={**_PORTFOLIO_TASK, "menu": "overweight:0.1"},
        ),
    },
    ("portfolio", "pathwise"): {
        "fast": Preset("pathwise", _PORTFOLIO_PATHWISE, episodes=800, seeds=5, task=_PORTFOLIO_TASK)
    },
    **_tables("finite/cliff", _CLIFF, episodes=1000),
    **_tables("finite/frozen-lake", _LAKE, episodes=20_000),
    **_tables("finite/random", _RANDOM, episodes=8000),
    **_tables("pendulum/grid", _GRID_PENDULUM, episodes=100_000),
    ("pendulum/grid", "sarsa"): {
        "fast": Preset("sarsa", {**_GRID_PENDULUM, **_SARSA}, episodes=100_000, seeds=8)
    },
    ("pendulum/grid", "expected-sarsa"): {
        "fast": Preset("expected-sarsa", {**_GRID_PENDULUM, **_SARSA}, 100_000, seeds=8)
    },
    ("pendulum/grid", "dyna-q"): {
        "fast": Preset("dyna-q", {**_GRID_PENDULUM, "planning": 16}, episodes=25_024, seeds=8)
    },
}
"""By task and agent."""


def default_agent(task: str) -> str:
    """The first agent that has presets for a task, which may be none that there is."""
    default = "ppo" if task.startswith(GYM) else "dqn"
    return next((agent for name, agent in PRESETS if name == task), default)


def presets_of(task: str, agent: str) -> dict[str, Preset]:
    """By name; for any environment of Gymnasium there are at least the agent's own defaults."""
    known = PRESETS.get((task, agent), {})
    if task.startswith(GYM) and not known:
        return {"fast": _gym(task.removeprefix(GYM), agent, 100_000)}
    return known


def preset(name: str, task: str = "pendulum", agent: str = "dqn") -> Preset:
    """The preset of that name; raises QfolioError where there is none."""
    presets = presets_of(task, agent)
    if name not in presets:
        there = f"there is {', '.join(presets)}" if presets else "there is none at all"
        raise QfolioError(f"there is no preset {name!r} for {agent} on {task}; {there}.")
    return presets[name]
