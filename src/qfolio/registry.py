"""What can be named on the command line; modules are imported only when asked for."""

import difflib
from importlib import import_module
from typing import Any

from qfolio.errors import QfolioError

TASKS = {"pendulum": "qfolio.tasks.pendulum:Pendulum"}
AGENTS = {"dqn": "qfolio.agents.dqn:DQN"}

PRESETS: dict[tuple[str, str], dict[str, dict[str, Any]]] = {
    ("pendulum", "dqn"): {
        # The defaults of DQN are tuned for this preset.
        "fast": {"episodes": 7456, "seeds": 8, "settings": {}},
        "best": {"episodes": 8192, "seeds": 8, "settings": {}},
        # Every hyperparameter of the report that qfolio grew out of.
        "report": {
            "episodes": 600,
            "seeds": 1,
            "settings": {
                "hidden": (256, 256),
                "input_gain": 0.0,
                "environments": 1,
                "episode_steps": 0,
                "batch_size": 64,
                "updates": 1,
                "replay_capacity": 50_000,
                "learning_starts": 64,
                "double": False,
                "target_period": 200,
                "target_rate": 1.0,
                "discount": 0.99,
                "learning_rate": 1e-3,
                "learning_rate_end": 1e-3,
                "epsilon": 1.0,
                "epsilon_end": 0.01,
                "epsilon_decay": 0.995,
                "huber": float("inf"),
                "reward_scale": 1.0,
            },
        },
    }
}
"""For a task and an agent: each preset's episodes, seeds and settings."""


def find(kind: str, table: dict[str, str], name: str) -> type:
    """The class registered under ``name``; ``kind`` is what the message calls it."""
    if name not in table:
        close = difflib.get_close_matches(name, table, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there is {', '.join(table)}."
        raise QfolioError(f"there is no {kind} {name!r}; {hint}")
    module, _, attribute = table[name].partition(":")
    return getattr(import_module(module), attribute)


def name_of(table: dict[str, str], instance: object) -> str:
    """The registered name of an object's class, or the class's own name."""
    path = f"{type(instance).__module__}:{type(instance).__qualname__}"
    return next((name for name, where in table.items() if where == path), type(instance).__name__)


def preset(task: str, agent: str, name: str) -> dict[str, Any]:
    presets = PRESETS.get((task, agent), {})
    if name not in presets:
        raise QfolioError(
            f"there is no preset {name!r} for {agent} on {task}; "
            + (f"there is {', '.join(presets)}." if presets else "there is none at all.")
        )
    return presets[name]
