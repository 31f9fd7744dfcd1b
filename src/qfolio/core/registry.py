"""Classes by name: qfolio's own, those of installed packages, and a user's own.

A user's own class is named ``module:Name``; the module may lie in the current directory. An
installed package offers its classes as entry points in the groups ``qfolio.tasks``,
``qfolio.agents``, ``qfolio.baselines``, ``qfolio.rewards``, ``qfolio.costs``, ``qfolio.signals``
and ``qfolio.trackers``. Names that a user types are imported (``find``). Names in a folder may come
from someone else: they must be in modules that have already been imported (``imported``,
``build``).
"""

import dataclasses
import os
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

from qfolio.core import settings
from qfolio.core.errors import QfolioError, one_line, require_methods
from qfolio.core.text import closest, shell

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
    "market/signals": "qfolio.portfolio.synthetic.garleanu_pedersen:Signals",
    "market/leverage": "qfolio.portfolio.synthetic.leverage:Leverage",
    "market/liquidation": "qfolio.portfolio.synthetic.liquidation:Liquidation",
}
AGENTS = {
    "dqn": "qfolio.agents.dqn:DQN",
    "pathwise": "qfolio.agents.pathwise:Pathwise",
    "tilts": "qfolio.agents.tilts:Tilts",
    "mean-variance-learned": "qfolio.agents.mean_variance:MeanVariance",
    "minimum-variance-learned": "qfolio.agents.mean_variance:MinimumVariance",
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
_CLASSICS = "qfolio.portfolio.backtest.baselines"
BASELINES = {
    "equal-weight": f"{_CLASSICS}.equal_weight:EqualWeight",
    "equal-weight-monthly": f"{_CLASSICS}.equal_weight:EqualWeightMonthly",
    "equal-weight-band": f"{_CLASSICS}.equal_weight:EqualWeightBand",
    "buy-and-hold": f"{_CLASSICS}.equal_weight:BuyAndHold",
    "inverse-volatility": f"{_CLASSICS}.timing:InverseVolatility",
    "volatility-timing": f"{_CLASSICS}.timing:VolatilityTiming",
    "reward-to-risk-timing": f"{_CLASSICS}.timing:RewardToRiskTiming",
    "momentum": f"{_CLASSICS}.trend:Momentum",
    "trend": f"{_CLASSICS}.trend:Trend",
    "minimum-variance": f"{_CLASSICS}.minimum_variance:MinimumVariance",
    "minimum-variance-ledoit-wolf": f"{_CLASSICS}.minimum_variance:MinimumVarianceLedoitWolf",
    "minimum-variance-nonlinear": f"{_CLASSICS}.minimum_variance:MinimumVarianceNonlinear",
    "minimum-variance-ewma": f"{_CLASSICS}.minimum_variance:MinimumVarianceEwma",
    "maximum-ratio": f"{_CLASSICS}.optimizers:MaximumRatio",
    "risk-budgeting": f"{_CLASSICS}.optimizers:RiskBudgeting",
    "hierarchical-risk-parity": f"{_CLASSICS}.optimizers:HierarchicalRiskParity",
    "pamr": f"{_CLASSICS}.online:Pamr",
    "olmar": f"{_CLASSICS}.online:Olmar",
}
REWARDS = {
    "log": "qfolio.portfolio.rewards:Log",
    "crra": "qfolio.portfolio.rewards:CRRA",
    "mean-variance": "qfolio.portfolio.rewards:MeanVariance",
    "differential-sharpe": "qfolio.portfolio.rewards:DifferentialSharpe",
}
SIGNALS = {
    "momentum": "qfolio.portfolio.signals.formulas:Momentum",
    "reversal": "qfolio.portfolio.signals.formulas:Reversal",
    "drift": "qfolio.portfolio.signals.formulas:Drift",
    "volatility": "qfolio.portfolio.signals.formulas:Volatility",
    "volatility-ratio": "qfolio.portfolio.signals.formulas:VolatilityRatio",
    "high": "qfolio.portfolio.signals.formulas:High",
    "moving-average": "qfolio.portfolio.signals.formulas:MovingAverage",
    "maximum": "qfolio.portfolio.signals.formulas:Maximum",
    "beta": "qfolio.portfolio.signals.formulas:Beta",
    "residual-volatility": "qfolio.portfolio.signals.formulas:ResidualVolatility",
    "correlation": "qfolio.portfolio.signals.formulas:Correlation",
    "market-momentum": "qfolio.portfolio.signals.formulas:MarketMomentum",
    "market-volatility": "qfolio.portfolio.signals.formulas:MarketVolatility",
}
COSTS = {
    "proportional": "qfolio.portfolio.costs:Proportional",
    "itemized": "qfolio.portfolio.itemized:Itemized",
}
TRACKERS = {
    "tensorboard": "qfolio.adapters.trackers:TensorBoard",
    "wandb": "qfolio.adapters.trackers:WeightsAndBiases",
    "trackio": "qfolio.adapters.trackers:Trackio",
}

Kind = Literal["task", "agent", "baseline", "reward", "cost", "signal", "tracker"]


class Entries(NamedTuple):
    """The classes of one kind."""

    table: dict[str, str]  # qfolio's own: where each name is defined
    base: str  # what each class inherits from

    def where(self, kind: Kind) -> dict[str, str]:
        """Where each name is defined, including those of installed packages."""
        installed = entry_points(group=f"qfolio.{kind}s")
        return {point.name: f"{point.module}:{point.attr}" for point in installed} | self.table


ENTRIES: dict[Kind, Entries] = {
    "task": Entries(TASKS, "qfolio.core.mdp:Task"),
    "agent": Entries(AGENTS, "qfolio.core.mdp:Agent"),
    "baseline": Entries(BASELINES, f"{_CLASSICS}:Baseline"),
    "reward": Entries(REWARDS, "qfolio.portfolio.rewards:Reward"),
    "cost": Entries(COSTS, "qfolio.portfolio.costs:CostModel"),
    "signal": Entries(SIGNALS, "qfolio.portfolio.signals:Signal"),
    "tracker": Entries(TRACKERS, "qfolio.experiments.log:Tracker"),
}

GYM = "gym:"
"""Prefix of tasks that are environments of Gymnasium; the environment's ID follows."""

_GYMNASIUM = "qfolio.tasks.gymnasium:GymnasiumTask"


def of(family: str, names: Iterable[str] = tuple(TASKS)) -> list[str]:
    """Those names (default: qfolio's tasks) that begin with a family, such as "market"."""
    return [name for name in names if name.startswith(f"{family}/")]


def find(kind: Kind, name: str) -> type[Any]:
    """The class that a user names; imports its module, also from the current directory.

    Raises QfolioError if there is none, or if it is not of that kind.
    """
    where = _where(kind, name)
    module, _, attribute = (where or name).partition(":")
    if not attribute or (where is None and not exists(module)):
        raise _unknown(kind, name)
    if "<locals>" in attribute:
        raise QfolioError(
            f"the {kind} {name} is of a class within a function, which no name finds; define the "
            f"class outside, or pass the {kind}, as in qfolio.Run.open(folder, {kind}=…)."
        )
    found = getattr(import_own(module), attribute, None)
    home, _, above = ENTRIES[kind].base.partition(":")
    base = getattr(import_module(home), above)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise QfolioError(
            f"there is no {kind} {name!r}: {module} has no class {attribute} that inherits from "
            f"{home}.{above}."
        )
    missing = {*getattr(found, "__abstractmethods__", ()), *getattr(found, "__abstractvars__", ())}
    if missing:
        raise QfolioError(
            f"the {kind} {name} is not complete: it lacks {', '.join(sorted(missing))}."
        )
    require_methods(found, base)
    return found


def imported(kind: Kind, name: str) -> type[Any]:
    """The class that a folder or a setting names.

    Raises QfolioError if importing it would run code that only a file has named.
    """
    if _where(kind, name) is None:
        _require_imported(kind, name, name.rpartition(":")[0])
    return find(kind, name)


def build(kind: Kind, name: str, chosen: Mapping[str, Any]) -> Any:
    """The object that a folder names, with its settings.

    Raises QfolioError as ``imported`` does, and if the settings do not suffice to make the object.
    """
    found = imported(kind, name)
    if _where(kind, name) == _GYMNASIUM:
        _require_imported(kind, name, str(chosen.get("id", "")).rpartition(":")[0])
    try:
        return settings.build(found, chosen)
    except TypeError as error:
        if not dataclasses.is_dataclass(found):
            raise QfolioError(
                f"the {kind} {name} is no dataclass, so that its settings cannot be given by name "
                f"({error}); write @dataclass(frozen=True) before its class."
            ) from None
        raise QfolioError(
            f"the {kind} {name} cannot be made from the folder's settings alone ({error}); make it "
            "in Python and pass it when opening the folder."
        ) from None


def name_of(instance: object) -> str:
    """The name by which ``find`` and ``build`` know an object's class."""
    path = f"{type(instance).__module__}:{type(instance).__qualname__}"
    if path == _GYMNASIUM:
        return GYM + instance.id  # type: ignore[attr-defined]
    known = (entries.table for entries in ENTRIES.values())
    installed = (entries.where(kind) for kind, entries in ENTRIES.items())  # slow to find
    tables = chain(known, installed)
    return next((name for table in tables for name, where in table.items() if where == path), path)


def short(name: str) -> str:
    """A short name for tables and folders: ``Name`` of ``module:Name``."""
    return name if name.startswith(GYM) else name.rpartition(":")[2]


def parted(entry: str) -> tuple[str, str]:
    """The agent and the preset of an entry such as dqn:fast or module:Name:fast; "" without one."""
    parts = entry.split(":")
    count = 2 if _where("agent", parts[0]) is None else 1
    return ":".join(parts[:count]), ":".join(parts[count:])


def entrant(entry: str) -> str:
    """The name of such an entry in tables: the agent's short name, and the preset if it has one."""
    agent, preset = parted(entry)
    return ":".join(filter(None, (short(agent), preset)))


def own_modules(*instances: object) -> list[str]:
    """The modules that must be trusted before ``build`` can make these objects again."""
    names = [name_of(instance).removeprefix(GYM) for instance in instances]
    modules = [name.rpartition(":")[0] for name in names]
    return sorted({name for name in modules if name and not name.startswith("qfolio.")})


def again(command: str, folder: Path, *parts: object, on: str = "here") -> str:
    """The command line that resumes the work in a folder.

    parts: the tasks and agents; modules of a user's own must be trusted again. on: where it ran.
    """
    modules = own_modules(*parts)
    words = [*command.split(), str(folder), *(["--trust", *modules] if modules else [])]
    return shell(*words, *(["--on", on] if on != "here" else []))


def trust(modules: Iterable[str]) -> None:
    """Imports modules whose code folders may then name."""
    for module in modules:
        import_own(module)


def trusted() -> list[str]:
    """The user's own modules that this process has imported by name."""
    return sorted(name for name in _trusted if not name.startswith("qfolio."))


_trusted: set[str] = set()


def import_own(module: str) -> ModuleType:
    """Imports a module that a user has named, also from the current directory.

    Raises QfolioError if there is no such module, or importing it fails.
    """
    if not exists(module):
        raise QfolioError(
            f"{module} cannot be imported: it is neither installed nor in this folder."
        )
    try:
        found = import_module(module)
    except Exception as error:
        raise QfolioError(f"{module} cannot be imported: {one_line(error)}.") from error
    _trusted.add(module)
    return found


def _where(kind: Kind, name: str) -> str | None:
    """Where qfolio or an installed package defines a name; None if neither does."""
    if kind == "task" and name.startswith(GYM):
        return _GYMNASIUM
    entries = ENTRIES[kind]
    return entries.table.get(name) or entries.where(kind).get(name)


def _require_imported(kind: Kind, name: str, module: str) -> None:
    if module and module not in sys.modules and not module.startswith("qfolio."):
        raise QfolioError(
            f"the {kind} {name} is code of the module {module}, which is not run because a folder "
            f"names it; if you trust it, add --trust {module} (in Python, import it first)."
        )


def _unknown(kind: Kind, name: str) -> QfolioError:
    table = ENTRIES[kind].where(kind)
    first, colon, _ = name.partition(":")
    family, slash, own = first.partition("/")
    kin = {each.removeprefix(f"{family}/"): each for each in of(family, table)} if slash else {}
    agent, preset = parted(name) if kind == "agent" else (name, "")
    if preset:
        hint = f"set agent to {agent} and preset to {preset}."
    elif kin:  # what follows the slash tells its members apart
        close = closest(own, kin)
        hint = f"did you mean {kin[close]}?" if close else f"choose from {', '.join(kin.values())}."
    elif close := closest(first, table):
        hint = f"did you mean {close}?"
    elif colon:
        hint = f"a module {first} is neither installed nor in this folder."
    else:
        gym = ", any environment of Gymnasium, such as gym:CartPole-v1," if kind == "task" else ""
        hint = f"choose from {', '.join(table)}{gym} or your own as module:Name."
    return QfolioError(f"there is no {kind} {name!r}; {hint}")


def exists(module: str) -> bool:
    """Whether there is such a module, installed or in the current directory.

    Imports the packages that it is in.
    """
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)  # last, so that a file here cannot shadow a library
    try:
        return module in sys.modules or find_spec(module) is not None
    except ModuleNotFoundError:
        return False
    except Exception:  # raised by a parent package; importing will report it
        return True
