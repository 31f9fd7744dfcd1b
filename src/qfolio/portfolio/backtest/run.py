"""A walk-forward backtest and its folder on disk.

Agents are trained anew for each fold, all seeds and several folds in one program, and once more on
the latest rows, for tomorrow's weights. What they then decide is replayed with exact costs in
float64, beside classical allocators under the same rules.

The folder holds config.json (settings, written once), prices.safetensors (the table),
policies/AGENT/FOLD.safetensors (weights, written as soon as a group of folds is trained; a run
that was stopped goes on behind them; of the latest, the whole learning state) and, at the end,
returns.csv, weights.csv, summary.json and the report.
"""

import csv
import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np

from qfolio.core import devices, settings
from qfolio.core.errors import QfolioError
from qfolio.core.files import (
    new_folder,
    read_arrays,
    read_json,
    read_tree,
    require_types,
    write_arrays,
    write_bytes,
    write_json,
    write_tree,
)
from qfolio.core.mdp import Agent
from qfolio.core.population import Population
from qfolio.core.registry import AGENTS, find
from qfolio.core.version import __version__
from qfolio.experiments.presets import Preset
from qfolio.experiments.run import FORMAT, check_counts, interruptible
from qfolio.portfolio.backtest import assessment, baselines
from qfolio.portfolio.backtest.folds import Fold, latest, spell, walk_forward
from qfolio.portfolio.backtest.simulation import Simulation, simulate
from qfolio.portfolio.policy import Policy, follow, state_template
from qfolio.portfolio.prices.table import Prices, describe
from qfolio.portfolio.task import Portfolio

LATEST = "latest"
"""Name of the policies that were trained on the last rows of the table."""

EQUAL_WEIGHT = "equal-weight"

TOGETHER = "-together"
"""Behind an agent's name: all its seeds as one, which is the policy for tomorrow."""

FOLDS_AT_ONCE = 8
"""Folds that train at once where members advance in lockstep; what is done after them stays."""


@dataclass(frozen=True)
class Progress:
    """Where a backtest is, after each chunk of training."""

    agent: str
    done: float  # share of all training
    seconds_left: float


@dataclass(frozen=True)
class Entry:
    """A strategy in the backtest."""

    kind: str  # "agent" or "baseline"
    decisions: np.ndarray  # (seed, day, entry), cash first
    simulation: Simulation  # of shape (seed, day)


class Backtest:
    """Made by ``create`` or ``open``; ``run`` trains what is missing and ``entries`` replays it."""

    def __init__(self, prices: Prices, config: dict[str, Any], folder: Path | None) -> None:
        self.prices, self.config, self.folder = prices, config, folder
        _check(config)
        for entry in config["agents"].values():
            check_counts(entry["episodes"], config["seeds"], config["seed"])
        dates, length, expanding = prices.dates, config["train"], config["expanding"]
        folds = walk_forward(dates, length, config["test"], config["lag"], expanding)
        self.folds = [fold.complete(prices.values) for fold in folds]
        last = latest(LATEST, dates, length, expanding).complete(prices.values)
        self._jobs = [*self.folds, last]
        self.agents = {name: _agent(entry) for name, entry in config["agents"].items()}
        self.tasks = {name: self._task(name) for name in self.agents}
        self.interrupted = False
        self._policies: dict[tuple[str, str], Any] = {}  # of a backtest without a folder
        for task in self.tasks.values():
            for job in self._jobs:
                self._part(task, job)

    @classmethod
    def create(
        cls,
        prices: Prices,
        agents: dict[str, Preset],
        *,
        train: str = "5y",
        test: str = "1y",
        expanding: bool = True,
        lag: int = 1,
        cost: float = 0.001,
        cap: float = 1.0,
        seeds: int = 5,
        seed: int = 0,
        trials: int = 0,
        command: str = "",
        out: Path | str | None = None,
    ) -> "Backtest":
        """A backtest before its first fold.

        Args:
            prices: The table.
            agents: By name, what to train; its preset's task settings say window, menu, reward, ….
            train, test: Lengths such as "5y", "6m" or "500d"; with ``expanding``, training keeps
                its start.
            lag: Rows from a decision to its execution.
            cost: Of trading one way, as a fraction.
            cap: Most that one asset may weigh.
            seeds: Agents of each kind, with the seeds ``seed``, ``seed + 1``, ….
            trials: Earlier trials on these prices, which the deflated Sharpe ratio must count too.
            command: What was typed to start it, for the report.
            out: A new or empty folder; without it nothing is written.
        """
        if not agents:
            raise QfolioError("A backtest needs at least one agent; name some with --agents.")
        config = {
            "format": FORMAT,
            "kind": "backtest",
            "version": __version__,
            "prices": describe(prices),
            "assets": list(prices.assets),
            "feature_names": list(prices.feature_names),
            "train": train,
            "test": test,
            "expanding": expanding,
            "lag": int(lag),
            "cost": float(cost),
            "cap": float(cap),
            "seeds": int(seeds),
            "seed": int(seed),
            "trials": int(trials),
            "command": command,
            "agents": {
                name: {
                    "agent": preset.agent,
                    "settings": settings.describe(preset.build()),
                    "task": dict(preset.task),
                    "episodes": preset.episodes,
                }
                for name, preset in agents.items()
            },
            **devices.circumstances("python", "jax", "equinox", "numpy", "skfolio"),
        }
        backtest = cls(prices, config, None)
        if out is not None:
            with new_folder(Path(out)) as folder:
                write_json(folder / "config.json", config)
                write_arrays(folder / "prices.safetensors", _price_arrays(prices))
            backtest.folder = Path(out)
        return backtest

    @classmethod
    def open(cls, folder: Path | str) -> "Backtest":
        """A backtest as its last finished group of folds left it."""
        folder = Path(folder)
        config = read_config(folder)
        return cls(_read_prices(folder, config), config, folder)

    def run(self, listener: Callable[[Progress], None] | None = None) -> None:
        """Trains every fold of every agent that is not on disk yet.

        A first Ctrl-C stops after the current chunk and sets ``interrupted``; the folds of groups
        that are finished stay.
        """
        groups = [(name, group) for name in self.agents for group in self._groups(name)]
        begun, finished = perf_counter(), 0
        with interruptible() as stop:
            for name, group in groups:
                for share in self._train(name, group):
                    if stop.is_set() and share < 1:
                        self.interrupted = True
                        return
                    done = (finished + share) / len(groups)
                    if listener is not None and done > 0:
                        left = (perf_counter() - begun) * (1 / done - 1)
                        listener(Progress(name, done, left))
                finished += 1

    def policy(self, agent: str | None = None) -> Policy:
        """The policy for tomorrow of an agent (the first, if not named)."""
        name = self._name(agent)
        task, trained = self._part(self.tasks[name], self._jobs[-1]), self.agents[name]
        state = state_template(task, trained, self.config["seeds"])
        kept = self._load(name, LATEST, _learning(state, 0, self.prices.dates[-1]))
        return Policy(
            task,
            trained,
            trained.weights(kept["learner"]),
            self.prices.assets,
            self.prices.feature_names,
            kept["learner"],
            int(kept["updates"]),
            kept["learned"].astype("datetime64[s]")[()],
        )

    def keep(self, agent: str | None, policy: Policy) -> None:
        """Keeps a policy that has gone on learning as the agent's for tomorrow."""
        name = self._name(agent)
        self._keep(name, LATEST, _learning(policy.learner, policy.updates, policy.learned))

    def entries(self) -> tuple[dict[str, Entry], list[str]]:
        """Every strategy replayed over all folds, and notes on what went wrong on the way."""
        notes = [
            f"Fold {fold.name} does without {', '.join(self._late(fold))}, which started too late."
            for fold in self.folds
            if self._late(fold)
        ]
        entries = {}
        for name in self.agents:
            entries[name] = self._entry("agent", self._decide(name))
            if self.config["seeds"] > 1:
                together = self._decide(name, together=True)
                entries[f"{name}{TOGETHER}"] = self._entry("agent", together)
        for name in baselines.BASELINES:
            decided = baselines.decisions(
                name, self.folds, self.prices.values, cap=self.config["cap"]
            )
            entries[name] = self._entry("baseline", decided.decisions[None])
            notes += decided.notes
        return entries, notes

    @property
    def dates(self) -> np.ndarray:
        """Of the returns of the test, shape (day,)."""
        shift = self.config["lag"] + 1
        first, last = self.folds[0].decisions.start, self.folds[-1].decisions.stop
        return self.prices.dates[first + shift : last + shift]

    def assess(self, entries: dict[str, Entry], since: str | None = None) -> assessment.Assessment:
        """The statistics of all strategies, over all days of the test or those from a date on."""
        first = 0 if since is None else int(np.searchsorted(self.dates, np.datetime64(since)))
        days = slice(first, None)
        return assessment.assess(
            {
                name: assessment.Strategy(
                    entry.kind,
                    entry.simulation.returns[:, days],
                    entry.simulation.turnover[:, days],
                    entry.simulation.cost[:, days],
                )
                for name, entry in entries.items()
            },
            self.dates[days],
            periods_per_year=self.prices.periods_per_year,
            reference=EQUAL_WEIGHT,
            other_trials=self.config["trials"],
        )

    def write_tables(self, entries: dict[str, Entry], assessed: assessment.Assessment) -> None:
        """returns.csv (a column per strategy and seed), weights.csv (means) and summary.json."""
        assert self.folder is not None
        days = [spell(date, self.prices.dates) for date in self.dates]
        columns = {
            f"{name}/{self.config['seed'] + i}" if name in self.agents else name: series
            for name, entry in entries.items()
            for i, series in enumerate(entry.simulation.returns)
        }
        rows = zip(days, *columns.values(), strict=True)
        write_bytes(self.folder / "returns.csv", _csv(["date", *columns], rows))
        weights = (
            (day, name, *row)
            for name, entry in entries.items()
            for day, row in zip(days, entry.simulation.weights.mean(0).round(6), strict=True)
        )
        header = ["date", "strategy", "cash", *self.prices.assets]
        write_bytes(self.folder / "weights.csv", _csv(header, weights))
        write_json(self.folder / "summary.json", assessed.to_json())

    def _name(self, agent: str | None) -> str:
        """Of an agent: the first, if none is named."""
        name = next(iter(self.agents)) if agent is None else agent
        if name not in self.agents:
            raise QfolioError(
                f"The backtest has no agent {name!r}; there is {', '.join(self.agents)}."
            )
        return name

    # Training ------------------------------------------------------------------------------------

    def _task(self, name: str) -> Portfolio:
        config = self.config
        own = {key: config[key] for key in ("lag", "cost", "cap")}
        entry = config["agents"][name]["task"]
        return Portfolio.of(self.prices, **settings.convert(Portfolio, {**entry, **own}))

    def _part(self, task: Portfolio, job: Fold) -> Portfolio:
        values = self.prices.values
        return task.part(job.train.start, job.train.stop - 1, job.tradable(values))

    def _groups(self, name: str) -> list[list[Fold]]:
        """The folds that are still to be trained, in groups that fill the devices."""
        missing = [job for job in self._jobs if not self._is_trained(name, job.name)]
        lockstep = jax.devices()[0].platform in devices.LOCKSTEP
        size = max(len(jax.devices()), FOLDS_AT_ONCE if lockstep else 1)
        return [missing[i : i + size] for i in range(0, len(missing), size)]

    def _train(self, name: str, group: list[Fold]) -> Iterator[float]:
        """Trains all seeds of some folds, yields the share that is done, and keeps the weights."""
        seeds = [self.config["seed"] + i for i in range(self.config["seeds"])]
        tasks = [self._part(self.tasks[name], job) for job in group for _ in seeds]
        members = seeds * len(group)
        population = Population(tasks, self.agents[name], members)
        episodes = self.config["agents"][name]["episodes"]
        total = population.steps_left(episodes)
        while left := population.steps_left(episodes):
            yield population.steps / total
            population.advance(left)
        weights, state = population.weights(), population.fetch().agent
        for i, job in enumerate(group):
            mine = slice(i * len(seeds), (i + 1) * len(seeds))
            if job.name == LATEST:
                learner = jax.tree.map(lambda x, s=mine: x[s], state)
                self._keep(name, job.name, _learning(learner, 0, self.prices.dates[-1]))
            else:
                self._keep(name, job.name, jax.tree.map(lambda x, s=mine: x[s], weights))
        yield 1.0

    def _late(self, fold: Fold) -> list[str]:
        """Assets that a fold does without."""
        tradable = fold.tradable(self.prices.values)
        return [name for name, yes in zip(self.prices.assets, tradable, strict=True) if not yes]

    def _is_trained(self, name: str, job: str) -> bool:
        if self.folder is None:
            return (name, job) in self._policies
        return self._place(name, job).exists()

    def _place(self, name: str, job: str) -> Path:
        assert self.folder is not None
        return self.folder / "policies" / name / f"{job}.safetensors"

    def _keep(self, name: str, job: str, tree: Any) -> None:
        if self.folder is None:
            self._policies[name, job] = tree
        else:
            write_tree(self._place(name, job), tree)

    def _members(self, name: str, job: str) -> Any:
        """What the agents of a fold learned."""
        agent = self.agents[name]
        state = state_template(self.tasks[name], agent, self.config["seeds"])
        return self._load(name, job, agent.weights(state))

    def _load(self, name: str, job: str, template: Any) -> Any:
        if not self._is_trained(name, job):
            where = f"qfolio backtest --resume {self.folder}" if self.folder else "run()"
            raise QfolioError(f"The backtest is not finished; go on with {where} first.")
        if self.folder is None:
            return self._policies[name, job]
        return read_tree(self._place(name, job), template)

    # Deciding ------------------------------------------------------------------------------------

    def _decide(self, name: str, together: bool = False) -> np.ndarray:
        """Decisions over all folds, (seed, day, entry); each goes on with what the last one held.

        With ``together`` it is the mean of all seeds that trades, as one. The agents see their
        portfolio in float32; the replay is in float64.
        """
        seeds = 1 if together else self.config["seeds"]
        held = np.zeros((seeds, 1 + len(self.prices.assets)))
        held[:, 0] = 1.0
        longest = max(fold.decisions.stop - fold.decisions.start for fold in self.folds)
        parts = []
        for fold in self.folds:
            task = self._part(self.tasks[name], fold)
            count = fold.decisions.stop - fold.decisions.start
            # One length serves all folds; what lies behind a fold's end is cut off.
            targets, after = follow(
                task,
                self.agents[name],
                self._members(name, fold.name),
                fold.decisions.start,
                held,
                longest,
                together=together,
            )
            parts.append(targets[:, :count])
            held = after[:, count - 1]
        return np.concatenate(parts, axis=1)

    def _entry(self, kind: str, decisions: np.ndarray) -> Entry:
        simulation = simulate(
            self.prices.values,
            decisions,
            first=self.folds[0].decisions.start,
            cost=self.config["cost"],
            lag=self.config["lag"],
        )
        return Entry(kind, decisions, simulation)


def _learning(learner: Any, updates: int, learned: np.datetime64) -> dict[str, Any]:
    """What is kept of the policy for tomorrow: one file, so that it is always of one piece."""
    seconds = np.array(learned, "datetime64[s]").astype(np.int64)
    return {"learner": learner, "updates": np.array(updates), "learned": seconds}


def read_config(folder: Path) -> dict[str, Any]:
    """config.json, or QfolioError where ``folder`` is no backtest of this version."""
    path = folder / "config.json"
    if not path.is_file():
        raise QfolioError(f"{folder} is no backtest: it has no config.json.")
    config = read_json(path)
    if config.get("format") != FORMAT or config.get("kind") != "backtest":
        what = "is a training run" if "task" in config else "was written in another format"
        raise QfolioError(f"{folder} {what}; this needs the folder of a qfolio backtest.")
    try:
        _check(config)
    except QfolioError as error:
        raise QfolioError(f"{path} is damaged: {error}") from None
    return config


def _check(config: dict[str, Any]) -> None:
    """Raises QfolioError where settings are missing, of the wrong type or out of range."""
    wanted = {
        "assets": list, "feature_names": list, "train": str, "test": str, "expanding": bool,
        "lag": int, "cost": float, "cap": float, "seeds": int, "seed": int, "trials": int,
        "command": str, "agents": dict, "prices": dict,
    }  # fmt: skip
    require_types(config, wanted)
    if not {"source", "rows", "first", "last", "digest"} <= config["prices"].keys():
        raise QfolioError("prices is not described.")
    if not 0 <= config["trials"] <= 10**9:
        raise QfolioError(f"trials is {config['trials']}; it must be from 0 to 10⁹.")
    parts = {"agent": str, "settings": dict, "task": dict, "episodes": int}
    for name, entry in config["agents"].items():
        if not (isinstance(entry, dict) and all(isinstance(entry.get(k), parts[k]) for k in parts)):
            raise QfolioError(f"the agent {name!r} is not described.")
        # Names become folders, and stand beside those of the baselines.
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or name in baselines.BASELINES:
            raise QfolioError(
                f"an agent cannot be called {name!r}; take letters, digits, - and _, and no "
                "name of a baseline."
            )


def _agent(entry: dict[str, Any]) -> Agent:
    agent: Agent = settings.build(find("agent", AGENTS, entry["agent"]), entry["settings"])
    return agent


def _price_arrays(prices: Prices) -> dict[str, np.ndarray]:
    return {
        "dates": prices.dates.astype("datetime64[s]").astype(np.int64),
        "values": prices.values,
        "features": prices.features,
    }


def _read_prices(folder: Path, config: dict[str, Any]) -> Prices:
    path = folder / "prices.safetensors"
    arrays = read_arrays(path)
    try:
        prices = Prices(
            arrays["dates"].astype("datetime64[s]"),
            tuple(config["assets"]),
            arrays["values"],
            arrays["features"],
            tuple(config["feature_names"]),
            source=config["prices"].get("source", ""),
            note=config["prices"].get("note", ""),
        )
    except (KeyError, ValueError, QfolioError) as error:
        raise QfolioError(f"{path} is damaged ({error}); restore it or run anew.") from None
    if prices.digest != config["prices"].get("digest"):
        raise QfolioError(f"{path} does not belong to config.json beside it; restore the two.")
    return prices


def _csv(header: list[str], rows: Any) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()
