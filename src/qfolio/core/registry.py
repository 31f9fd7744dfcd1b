"""Tasks and agents by name; their modules are imported only when asked for."""

import difflib
from importlib import import_module

from qfolio.core.errors import QfolioError

TASKS = {
    "pendulum": "qfolio.tasks.pendulum:Pendulum",
    "pendulum/grid": "qfolio.tasks.grid_pendulum:GridPendulum",
    "finite/cliff": "qfolio.tasks.finite:Cliff",
    "finite/frozen-lake": "qfolio.tasks.finite:FrozenLake",
    "finite/random": "qfolio.tasks.finite:Garnet",
    "pendulum/hidden": "qfolio.tasks.hidden_pendulum:HiddenPendulum",
    "catch": "qfolio.tasks.catch:Catch",
    "market/kelly": "qfolio.portfolio.synthetic.kelly:Kelly",
    "market/merton": "qfolio.portfolio.synthetic.merton:Merton",
    "market/regime": "qfolio.portfolio.synthetic.regime:Regime",
    "market/ar1": "qfolio.portfolio.synthetic.ar1:Ar1",
    "market/no-trade": "qfolio.portfolio.synthetic.no_trade:NoTrade",
    "market/garleanu-pedersen": "qfolio.portfolio.synthetic.garleanu_pedersen:GarleanuPedersen",
}
AGENTS = {
    "dqn": "qfolio.agents.dqn:DQN",
    "pathwise": "qfolio.agents.pathwise:Pathwise",
    "q-learning": "qfolio.agents.tabular:QLearning",
    "sarsa": "qfolio.agents.tabular:Sarsa",
    "expected-sarsa": "qfolio.agents.tabular:ExpectedSarsa",
    "double-q": "qfolio.agents.tabular:DoubleQ",
    "dyna-q": "qfolio.agents.dyna_q:DynaQ",
    "ddpg": "qfolio.agents.ddpg:DDPG",
    "td3": "qfolio.agents.td3:TD3",
    "sac": "qfolio.agents.sac:SAC",
    "mbpo": "qfolio.agents.mbpo:MBPO",
    "reinforce": "qfolio.agents.reinforce:REINFORCE",
    "a2c": "qfolio.agents.a2c:A2C",
    "ppo": "qfolio.agents.ppo:PPO",
}

GYM = "gym:"
"""What begins the name of a task that is an environment of Gymnasium; its ID follows."""

_ANY = {"task": " and any environment of Gymnasium, such as gym:CartPole-v1"}

_GYMNASIUM = "qfolio.tasks.gymnasium:GymnasiumTask"


def find(kind: str, table: dict[str, str], name: str) -> type:
    """The class registered under ``name``; ``kind`` is what the message calls it."""
    if table is TASKS and name.startswith(GYM):
        table = {name: _GYMNASIUM}
    if name not in table:
        close = difflib.get_close_matches(name, table, n=1)
        hint = (
            f"did you mean {close[0]}?"
            if close
            else f"there is {', '.join(table)}{_ANY.get(kind, '')}."
        )
        raise QfolioError(f"there is no {kind} {name!r}; {hint}")
    module, _, attribute = table[name].partition(":")
    return getattr(import_module(module), attribute)


def name_of(table: dict[str, str], instance: object) -> str:
    """The registered name of an object's class, or the class's own name."""
    path = f"{type(instance).__module__}:{type(instance).__qualname__}"
    if path == _GYMNASIUM:
        return GYM + instance.id  # type: ignore[attr-defined]
    return next((name for name, where in table.items() if where == path), type(instance).__name__)
