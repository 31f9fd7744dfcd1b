"""Presets for tabular agents: finite processes and the pendulum on a grid."""

from typing import Any

from qfolio.experiments.presets.preset import Preset, Presets

_CLIFF = {"epsilon_end": 0.1}


_LAKE = {
    "num_envs": 8,
    "learning_rate": 0.5,
    "learning_rate_decay": 0.02,
    "initial_value": 1.0,
    "epsilon_end": 0.1,
    "epsilon_decay": 0.9998,
}


_RANDOM = {
    "num_envs": 8,
    "discount": 0.95,
    "learning_rate": 0.5,
    "learning_rate_decay": 0.02,
    "epsilon_end": 0.1,
    "epsilon_decay": 0.998,
}


_GRID_PENDULUM = {
    "num_envs": 16,
    "episode_steps": 40,
    "discount": 0.995,
    "learning_rate": 0.5,
    "learning_rate_decay": 0.01,
    "epsilon_start": 0.2,
    "epsilon_end": 0.2,
}


_SARSA = {"epsilon_start": 0.05, "epsilon_end": 0.05}  # SARSA's values include exploration


def _tables(task: str, settings: dict[str, Any], episodes: int) -> dict[tuple[str, str], Any]:
    """Presets of the tabular agents that differ only in their algorithm."""
    names = ("q-learning", "sarsa", "expected-sarsa", "double-q", "dyna-q")
    return {(task, name): {"fast": Preset(name, settings, episodes, seeds=8)} for name in names}


PRESETS: Presets = {
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
        "fast": Preset("dyna-q", {**_GRID_PENDULUM, "planning_steps": 16}, episodes=25_024, seeds=8)
    },
}
