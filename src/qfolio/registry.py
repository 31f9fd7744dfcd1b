"""Tasks and agents by name; their modules are imported only when asked for."""

import difflib
from importlib import import_module

from qfolio.errors import QfolioError

TASKS = {
    "pendulum": "qfolio.tasks.pendulum:Pendulum",
    "market/kelly": "qfolio.tasks.synthetic:Kelly",
    "market/merton": "qfolio.tasks.synthetic:Merton",
    "market/regime": "qfolio.tasks.synthetic:Regime",
    "market/ar1": "qfolio.tasks.synthetic:Ar1",
    "market/no-trade": "qfolio.tasks.synthetic:NoTrade",
    "market/garleanu-pedersen": "qfolio.tasks.synthetic:GarleanuPedersen",
}
AGENTS = {"dqn": "qfolio.agents.dqn:DQN", "pathwise": "qfolio.agents.pathwise:Pathwise"}


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
