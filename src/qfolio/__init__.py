"""qfolio: reinforcement learning for portfolio optimization.

>>> import qfolio
>>> prices = qfolio.load_prices("prices.csv")
>>> agents = {"tilts": qfolio.preset("fast", "portfolio", "tilts")}
>>> backtest = qfolio.Backtest.create(prices, agents, out="runs/mine")
>>> backtest.run()
>>> qfolio.finish(backtest)
>>> backtest.policy().weights(prices)

>>> run = qfolio.train(qfolio.Pendulum(), qfolio.DQN(), episodes=200, seeds=8)
>>> run.grade()["regret_per_seed"]
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from qfolio.core.version import __version__

if TYPE_CHECKING:
    from qfolio.adapters.progress import Progress as Progress
    from qfolio.agents.a2c import A2C as A2C
    from qfolio.agents.ddpg import DDPG as DDPG
    from qfolio.agents.dqn import DQN as DQN
    from qfolio.agents.mbpo import MBPO as MBPO
    from qfolio.agents.pathwise import Pathwise as Pathwise
    from qfolio.agents.ppo import PPO as PPO
    from qfolio.agents.reinforce import REINFORCE as REINFORCE
    from qfolio.agents.sac import SAC as SAC
    from qfolio.agents.td3 import TD3 as TD3
    from qfolio.agents.tilts import Tilts as Tilts
    from qfolio.core.errors import QfolioError as QfolioError
    from qfolio.experiments.budget import Budget as Budget
    from qfolio.experiments.fit import Listener as Listener
    from qfolio.experiments.log import Tracker as Tracker
    from qfolio.experiments.log import tracked as tracked
    from qfolio.experiments.machines.choice import on as on
    from qfolio.experiments.presets import preset as preset
    from qfolio.experiments.run import Run as Run
    from qfolio.experiments.run import train as train
    from qfolio.portfolio.backtest.run import Backtest as Backtest
    from qfolio.portfolio.desk.desk import Desk as Desk
    from qfolio.portfolio.policy import Policy as Policy
    from qfolio.portfolio.prices.table import load as load_prices  # noqa: F401
    from qfolio.portfolio.study.run import Study as Study
    from qfolio.portfolio.task import Portfolio as Portfolio
    from qfolio.report.backtest.finish import finish as finish
    from qfolio.tasks.finite import FiniteMDP as FiniteMDP
    from qfolio.tasks.pendulum import Pendulum as Pendulum

_HOMES = {
    "A2C": "qfolio.agents.a2c:A2C",
    "Backtest": "qfolio.portfolio.backtest.run:Backtest",
    "Budget": "qfolio.experiments.budget:Budget",
    "DDPG": "qfolio.agents.ddpg:DDPG",
    "DQN": "qfolio.agents.dqn:DQN",
    "Desk": "qfolio.portfolio.desk.desk:Desk",
    "FiniteMDP": "qfolio.tasks.finite:FiniteMDP",
    "Listener": "qfolio.experiments.fit:Listener",
    "PPO": "qfolio.agents.ppo:PPO",
    "MBPO": "qfolio.agents.mbpo:MBPO",
    "Pathwise": "qfolio.agents.pathwise:Pathwise",
    "Pendulum": "qfolio.tasks.pendulum:Pendulum",
    "Policy": "qfolio.portfolio.policy:Policy",
    "Portfolio": "qfolio.portfolio.task:Portfolio",
    "REINFORCE": "qfolio.agents.reinforce:REINFORCE",
    "Progress": "qfolio.adapters.progress:Progress",
    "QfolioError": "qfolio.core.errors:QfolioError",
    "Run": "qfolio.experiments.run:Run",
    "SAC": "qfolio.agents.sac:SAC",
    "Study": "qfolio.portfolio.study.run:Study",
    "TD3": "qfolio.agents.td3:TD3",
    "Tilts": "qfolio.agents.tilts:Tilts",
    "Tracker": "qfolio.experiments.log:Tracker",
    "finish": "qfolio.report.backtest.finish:finish",
    "load_prices": "qfolio.portfolio.prices.table:load",
    "on": "qfolio.experiments.machines.choice:on",
    "preset": "qfolio.experiments.presets:preset",
    "tracked": "qfolio.experiments.log:tracked",
    "train": "qfolio.experiments.run:train",
}

__all__ = ["__version__", *_HOMES]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `qfolio --help` does not wait for jax.
    if name not in _HOMES:
        raise AttributeError(f"module 'qfolio' has no attribute {name!r}")
    module, _, attribute = _HOMES[name].partition(":")
    return getattr(import_module(module), attribute)
