"""qfolio: reinforcement learning for portfolio optimization.

>>> import qfolio
>>> run = qfolio.train(qfolio.Pendulum(), qfolio.DQN(), episodes=200, seeds=8)
>>> run.grade()["regret_per_seed"]
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from qfolio.agents.dqn import DQN as DQN
    from qfolio.errors import QfolioError as QfolioError
    from qfolio.presets import preset as preset
    from qfolio.runs import Run as Run
    from qfolio.runs import train as train
    from qfolio.tasks.pendulum import Pendulum as Pendulum

_HOMES = {
    "DQN": "qfolio.agents.dqn",
    "Pendulum": "qfolio.tasks.pendulum",
    "QfolioError": "qfolio.errors",
    "Run": "qfolio.runs",
    "preset": "qfolio.presets",
    "train": "qfolio.runs",
}

__all__ = ["DQN", "Pendulum", "QfolioError", "Run", "__version__", "preset", "train"]


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `qfolio --help` does not wait for jax.
    if name not in _HOMES:
        raise AttributeError(f"module 'qfolio' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
