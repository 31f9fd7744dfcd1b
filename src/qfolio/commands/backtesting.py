"""The options that ``backtest`` and ``study`` share, and the settings made from them."""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from qfolio.commands.arguments import (
    Assignments,
    Count,
    File,
    Folder,
    Limits,
    Modules,
    Name,
    Sources,
    Trackers,
    continues,
    executor_of,
    fresh_name,
    sources,
    typed,
)
from qfolio.commands.tables import READING, Reading
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError
from qfolio.core.text import hint, near

if TYPE_CHECKING:
    from qfolio.experiments.executor import Executor
    from qfolio.experiments.presets import Preset
    from qfolio.portfolio.mandate.mandate import Mandate

BASIS_POINT = 1e-4


@dataclasses.dataclass(frozen=True)
class Options(Reading):
    """How agents are trained and tested on a table, and how it is read.

    Args:
        agents: Agents, separated by commas: tilts, mean-variance-learned, minimum-variance-learned,
            dqn, pathwise, ppo, a2c, reinforce, sac, ddpg, td3, or your own as module:Name, each
            with an optional preset after a colon, as in tilts,tilts:low-risk.
        preset: Preset of the agents that name none.
        cost_bps: Cost of buying or selling, in basis points of the value traded.
        lag: Rows between the close that a decision sees and the close at which it trades.
        train: Length of the first training window: 5y, 6m, 8w or 500d (d counts rows).
        test: Length of a fold, after which agents are retrained.
        rolling: Train on a window of fixed length instead of all rows so far.
        cap: Largest weight of one asset, above 0 and at most 1; a mandate that allows loans or
            short sales may set a cap above 1 instead.
        mandate: File with the limits of all orders (TOML; see docs/guides/mandate.md).
        limits: Keys of a mandate with their values, such as assets.cap=0.2 trading.turnover=0.3;
            they take precedence over the file.
        cost_model: Cost of trading and holding: proportional, itemized or your own as module:Name;
            settings follow in brackets, as in "itemized(fixed=5, cash_rate=0.03)".
        calendar: When all strategies may trade: daily, weekly, monthly, quarterly, yearly, a number
            of rows, or drift:0.05 to trade when a weight is more than 0.05 from its target
            (default: at every row; baselines keep their own calendars).
        signals: Signals that agents observe beside returns, separated by commas, each with its
            lookback and the latest rows that it skips (drift and volatility-ratio: that it
            measures), in rows (momentum:252-21) or as times (momentum:1y-1m), or your own as
            module:Name (default: the preset's).
        strategy: Strategies of your own, each a CSV of target weights (date, and a column for
            each asset), of orders in shares (date, asset, shares), of returns (date, return) or
            of an index (date, level); may be repeated.
        benchmark: Benchmark of all strategies: the name of a baseline, an asset (bought
            and held) or a strategy of your own, or such a CSV (default: equal-weight).
        baselines: Baselines, separated by commas, by name or your own as module:Name; equal-weight
            is always among them (default: all of qfolio's).
        seeds: Number of seeds of each agent (default: the largest of the presets' numbers).
        seed: First seed; the others follow it.
        episodes: Training episodes of each agent in a fold (default: the preset's number).
        trials: Number of earlier trials on these prices, such as settings tried before, for which
            verdicts and deflated Sharpe ratios allow; known trials on the default table are added.
        assignments: Hyperparameters of all agents that have them (learning_rate=1e-3) or of one
            (dqn.discount=0.9), or of the task (window=20 reward=crra).
        out: New folder (default: one in runs/).
        resume: Folder to resume; a backtest may be given a table with more rows at its end.
        on: Where agents train: here, processes:4 (or another number), ray or ray://HOST:10001.
        track: Trackers that follow the training: tensorboard, wandb, trackio, or your own as
            module:Name (default: none).
        trust: Modules of your own code that the folder may name (default: none).
    """

    agents: str = "tilts,dqn"
    preset: str = "fast"
    cost_bps: float = 10.0
    lag: int = 1
    train: str = "5y"
    test: str = "1y"
    rolling: bool = False
    cap: float = 1.0
    mandate: File = None
    limits: Limits = ()
    cost_model: str = "proportional"
    calendar: str = ""
    signals: Name = None
    strategy: Sources = ()
    benchmark: Name = None
    baselines: Name = None
    seeds: Count = None
    seed: int = 0
    episodes: Count = None
    trials: int = 0
    assignments: Assignments = ()
    out: Folder = None
    resume: Folder = None
    on: str = "here"
    track: Trackers = ()
    trust: Modules = ()

    def only_resumes(self, table: bool = False) -> bool:
        """Whether no options but ``--resume``, ``--on``, ``--track`` and ``--trust`` were typed.

        table: Whether those for reading a table may be typed, too.
        """
        return continues(*(READING.reading if table else ()))

    @property
    def executor(self) -> "Executor":
        return executor_of(self.on, self.out, self.resume)

    def folder(self, kind: str) -> Path:
        """The path of the new folder: ``out``, or runs/KIND-TIME."""
        return self.out or fresh_name(kind)

    def presets(self) -> "dict[str, Preset]":
        """The agents by their names in tables, with all settings; imports their modules."""
        chosen = {
            name: _preset(entry, self.preset, self.episodes)
            for name, entry in _split(self.agents, registry.entrant).items()
        }
        observed = {} if self.signals is None else {"signals": self.signals}
        made = _assign(chosen, observed | settings.parse(self.assignments))
        for one, other in itertools.combinations(made, 2):
            if made[one] == made[other]:
                raise QfolioError(
                    f"--agents names {one} and {other}, which have the same settings; leave one "
                    f"out, or set one of {other} alone, as in --set {other}.horizon=250."
                )
        return made

    def terms(self) -> "Mandate | None":
        """The mandate from the file and the limits on the command line; None without either."""
        from qfolio.portfolio.mandate.mandate import Mandate

        if self.mandate is None and not self.limits:
            return None
        if self.mandate is None:
            return Mandate().changed(self.limits)
        return Mandate.read(self.mandate, self.limits)

    def settings(self) -> dict[str, Any]:
        """The other arguments of ``Backtest.create``, except lag, cost and folder."""
        seeds = (preset.seeds for preset in self.presets().values())
        return {
            "train": self.train,
            "test": self.test,
            "expanding": not self.rolling,
            "cap": self.cap,
            "mandate": self.terms(),
            "cost_model": _known("cost", settings.called(self.cost_model)[0]) and self.cost_model,
            "calendar": self.calendar,
            "strategies": sources(self.strategy),
            "benchmark": self.benchmark,
            "baselines": list(registry.BASELINES)
            if self.baselines is None
            else [
                _known("baseline", name) for name in _split(self.baselines, registry.short).values()
            ],
            "seeds": max(seeds, default=1) if self.seeds is None else self.seeds,
            "seed": self.seed,
            "trials": self.trials,
            "command": typed(),
        }


DEFAULTS = Options()

Shared = Annotated[Options, arg(name="")]
"""The options, without a prefix on the command line."""


def basis_points(option: str, value: float) -> float:
    """A cost in basis points as a fraction; raises QfolioError outside 0 to 2,000.

    option: the option's name, for the message.
    """
    if not 0 <= value <= 2000:
        raise QfolioError(f"{option} is {value:g}; it must be from 0 to 2000.")
    return value * BASIS_POINT


def _split(text: str, short: Callable[[str], str]) -> dict[str, str]:
    """The entries of a comma-separated option, by their short names in the backtest."""
    entries = [entry.strip() for entry in text.split(",") if entry.strip()]
    names = {short(entry): entry for entry in entries}
    if len(names) < len(entries):
        raise QfolioError(f"{text} has a name twice; give each once.")
    return names


def _known(kind: registry.Kind, name: str) -> str:
    """The name itself, once it is known to exist; imports its module."""
    registry.find(kind, name)
    return name


def _named(setting: str, value: str) -> list[tuple[registry.Kind, str]]:
    """The signals, baselines or reward that a setting of the task names, each with its kind."""
    from qfolio.portfolio import anchors, signals

    if setting == "signals":
        return [("signal", name) for name in signals.names(value)]
    if setting == "anchor":
        return [("baseline", name) for name in anchors.baselines(value)]
    return [("reward", value)] if setting == "reward" else []


def _preset(entry: str, preset: str, episodes: int | None) -> "Preset":
    """The preset of an agent: its own if the entry names one, as in tilts:low-risk."""
    from qfolio.experiments import presets

    agent, own = registry.parted(entry)
    registry.find("agent", agent)
    chosen = presets.preset(own or preset, "portfolio", agent)
    return chosen if episodes is None else chosen._replace(episodes=episodes)


def _assign(presets: dict[str, "Preset"], chosen: dict[str, str]) -> dict[str, "Preset"]:
    """The presets with changed settings of one agent, of all agents that have them, or of the task.

    A key such as dqn.discount is for one agent. Imports the modules that settings name.
    """
    from qfolio.portfolio.task import Portfolio

    used = set()
    changed = {}
    own_options = {"lag", "cost", "cost_model", "max_weight", "mandate", "calendar"}
    for name, preset in presets.items():
        kind = registry.find("agent", preset.agent)
        own, task = {}, {}
        for key, value in chosen.items():
            who, dot, rest = key.rpartition(".")
            if dot and who != name:
                continue
            if rest in settings.names(kind):
                own[rest] = value
            elif rest in settings.names(Portfolio) - own_options:
                for part, named in _named(rest, value):
                    registry.find(part, named)
                task[rest] = value
            else:
                continue
            used.add(key)
        changed[name] = preset._replace(
            settings={**preset.settings, **settings.convert(kind, own)},
            task={**preset.task, **settings.convert(Portfolio, task)},
        )
    for key in chosen.keys() - used if presets else ():  # no agent is an error of its own
        kinds: list[type] = [
            Portfolio,
            *(registry.find("agent", preset.agent) for preset in presets.values()),
        ]
        known = set().union(*map(settings.names, kinds)) - own_options
        who, dot, name = key.rpartition(".")
        if dot and who not in presets:
            raise QfolioError(f"--set {key}: no agent is named {who}; {near(who, presets)}")
        raise QfolioError(
            f"--set {key}: neither {', '.join(presets)} nor the portfolio task has this setting"
            f"{hint(name, known)}; its lag, costs, cap and mandate have options of their own."
        )
    return changed
