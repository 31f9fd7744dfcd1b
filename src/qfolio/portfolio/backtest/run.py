"""A walk-forward backtest.

Agents are trained from scratch for each fold, all seeds and several folds in one program, and once
more on the latest rows, for tomorrow's weights. Their decisions are replayed with exact costs in
float64, beside classical allocators under the same rules.
"""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from itertools import groupby
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from qfolio.core import devices
from qfolio.core.errors import QfolioError, require_list, require_type, require_whole
from qfolio.core.files import locked, new_folder, path_of, tidy
from qfolio.core.mdp import Agent
from qfolio.core.notebook import card
from qfolio.core.registry import BASELINES, own_modules, short
from qfolio.core.text import amount, figure, near
from qfolio.experiments.executor import Executor, Here, Job, ListenToJob, carry_out
from qfolio.experiments.log import Log
from qfolio.experiments.machines.choice import on
from qfolio.experiments.presets import Preset
from qfolio.experiments.records import Records
from qfolio.portfolio.backtest import memory, notes
from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.backtest.benchmark import field_of, tracked
from qfolio.portfolio.backtest.bound import constant_bound
from qfolio.portfolio.backtest.folder import (
    MOST_TRIALS,
    AgentConfig,
    BacktestConfig,
    BacktestFolder,
)
from qfolio.portfolio.backtest.folds import fewest, require_tested, walk_forward
from qfolio.portfolio.backtest.kept import Kept, learning, tomorrow
from qfolio.portfolio.backtest.own import Own, place, require_levels
from qfolio.portfolio.backtest.plan import Plan
from qfolio.portfolio.backtest.replay import Entry, Replay, Stretch
from qfolio.portfolio.backtest.statistics import assessment
from qfolio.portfolio.backtest.statistics.estimates import SHORTEST
from qfolio.portfolio.backtest.trading_terms import PROPORTIONAL, TradingTerms
from qfolio.portfolio.backtest.training import FoldsJob, TrainedFold, preparing
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.limits import mandate_text, reach
from qfolio.portfolio.mandate.mandate import Mandate
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.policy_folder import state_template
from qfolio.portfolio.prices.extended import require_grown
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices, describe, load, trials_on
from qfolio.portfolio.task import Portfolio

SMALL = 10**6
"""Number of prices below which two agents are replayed or explained side by side. Compiling their
programs takes one core each, so this saves time; but the arrays of both are in memory."""


class Backtest:
    """A walk-forward test of agents on a price table, beside classical baselines.

    ``create`` or ``open`` makes one, ``run`` trains what is missing, ``entries`` replays all
    strategies and ``assess`` compares them.

    interrupted: whether Ctrl-C stopped the last ``run``.
    """

    def __init__(
        self,
        prices: Prices,
        config: BacktestConfig,
        folder: BacktestFolder | None,
        agents: Mapping[str, Agent] | None = None,
        own: Mapping[str, Own] | None = None,
        trained: Sequence[tuple[int, int]] = (),
    ) -> None:
        """Takes its arguments as ``create`` or ``open`` make them.

        trained: for each table so far, the number of updates of the policies for tomorrow before
            they were trained on it, and its number of rows (default: one table).
        """
        if len(prices) > config.prices["rows"]:
            config = msgspec.structs.replace(config, prices=describe(prices))
        self.prices, self.config, self._kept = prices, config, Kept(folder)
        self._given_own = own or {}
        self._plan = plan = Plan(prices, config, agents or {}, trained)
        self.folds, self.agents, self.tasks = plan.folds, plan.agents, plan.tasks
        self.baselines = {short(name): baseline(name) for name in config.baselines}
        if both := self.agents.keys() & self.baselines.keys():
            raise QfolioError(
                f"{min(both)} is an agent and a baseline; give the agent another name."
            )
        task, days = plan.any_task, plan.decisions
        most = config.cap if task.feasible.long_only else reach(task.mandate, config.cap)
        self._own = {
            name: place(name, each, prices, days, task, most)
            for name, each in self._given_own.items()
        }
        self.interrupted = False

    @classmethod
    def create(
        cls,
        prices: Any,
        agents: Mapping[str, Preset | Agent],
        *,
        train: str = "5y",
        test: str = "1y",
        expanding: bool = True,
        lag: int = 1,
        cost: float = 0.001,
        cap: float = 1.0,
        mandate: Mandate | Path | str | dict[str, Any] | None = None,
        cost_model: str = PROPORTIONAL,
        calendar: str = "",
        baselines: Sequence[str] = tuple(BASELINES),
        strategies: Mapping[str, Any] | None = None,
        benchmark: Any = None,
        seeds: int = 5,
        seed: int = 0,
        episodes: int | None = None,
        task: Mapping[str, Any] | None = None,
        trials: int = 0,
        command: str = "",
        title: str = "",
        out: Path | str | None = None,
    ) -> "Backtest":
        """A backtest before its first fold.

        Args:
            prices: A table, or anything else that ``load_prices`` reads.
            agents: The agents to train, by name: presets, whose task settings include window, menu,
                reward, …, or agents of your own.
            train, test: Lengths such as "5y", "6m" or "500d" (d counts rows); with ``expanding``,
                training keeps its start.
            lag: Rows from a decision to its execution.
            cost: One-way trading cost, as a fraction of the value traded.
            cap: Largest weight of one asset; with 1, a mandate that allows loans or short sales
                may set a cap above it.
            mandate: Limits that all orders obey, of agents and of baselines: a ``Mandate``, the
                path of a file, or a dictionary of its sections. Its cost always applies, its cost
                model, calendar and benchmark where the arguments of these names have defaults.
            cost_model: Cost of trading and holding, in training and replay: a name of the registry,
                or your own as ``module:Name``, with its settings as in "itemized(fixed=5)"; a cost
                among them precedes all others.
            calendar: When all strategies may trade: daily, weekly, monthly, quarterly or yearly, on
                the first row of each period; every so many rows; or "drift:0.05", when some weight
                is more than 0.05 from its target (default: at every row, and baselines by their own
                calendars). All may trade on the first row of the test.
            baselines: Names of the registry, or your own as ``module:Name``; equal weights are
                always included.
            strategies: Strategies of your own by name: a CSV or Parquet file, a data frame, or an
                array with a row for each row of prices. It has weights of shape (rows, N + 1), cash
                first, or (rows, N), NaN where there is no order; or returns of shape (rows,).
            benchmark: What all are compared with: the name of a baseline, an asset (bought and
                held) or a strategy, or a source like those (default: equal weights).
            seeds: Number of agents of each kind, with the seeds ``seed``, ``seed + 1``, ….
            episodes: Training episodes in a fold of each agent without a preset.
            task: Settings of the portfolio task for agents without a preset.
            trials: Number of earlier trials on these prices, for which verdicts and deflated Sharpe
                ratios allow; those of the default table (``prices.table.DEFAULT_TRIALS``) are
                added to them.
            command: The command that started it, for the report.
            title: The report's title (default: agents, table and years).
            out: A new or empty folder; without it nothing is written.

        Raises:
            QfolioError: There is no agent, a name or a setting is invalid, the arguments do not fit
                the table, or the machine has too little memory.
        """
        _require_arguments(agents, strategies, baselines, task, episodes, cap)
        for argument, number in (("lag", lag), ("seeds", seeds), ("seed", seed)):
            require_type(argument, number, Integral, "a whole number")
        require_whole("trials", trials, 0, MOST_TRIALS)
        require_type("expanding", expanding, bool, "True or False")
        for argument, text in (("command", command), ("title", title)):
            require_type(argument, text, str, "text")
        place = None if out is None else path_of("out", out)
        prices = load(prices)
        terms = TradingTerms.of(mandate, cost, cost_model, calendar, benchmark)
        field = field_of(prices, agents, baselines, strategies or {}, terms.benchmark)
        names = [short(name) for name in field.baselines]
        if twice := [name for name in names if names.count(name) > 1]:
            raise QfolioError(f"Two baselines are called {twice[0]}; rename one of them.")
        limits = terms.mandate
        if limits is not None:
            limits = tracked(limits, terms.benchmark, field, prices)
        rows = fewest(walk_forward(prices.dates, train, test, int(lag), expanding), prices)
        require_tested(prices.dates, train, SHORTEST)
        config = BacktestConfig(
            prices=describe(prices),
            assets=list(prices.assets),
            feature_names=list(prices.feature_names),
            train=train,
            test=test,
            expanding=expanding,
            lag=int(lag),
            cost=terms.cost,
            cap=float(cap),
            mandate=limits,
            cost_model=terms.cost_model,
            calendar=terms.calendar,
            baselines=field.baselines,
            strategies=tuple(field.own),
            benchmark=field.benchmark,
            seeds=int(seeds),
            seed=int(seed),
            trials=int(trials),
            command=command,
            title=title,
            agents={
                name: AgentConfig.of(name, agent, episodes, task or {}, rows, int(lag))
                for name, agent in agents.items()
            },
            **devices.circumstances("python", "jax", "equinox", "numpy", "skfolio"),
        )
        memory.require(prices, config)
        if config.mandate is not None:
            every = np.ones(len(prices.assets), bool)
            checks.require(mandate_text(config.mandate, prices.assets), every, config.cap)
        given = {name: agent for name, agent in agents.items() if isinstance(agent, Agent)}
        backtest = cls(prices, config, None, given, field.own)
        backtest._require_able()
        if place is not None:
            with new_folder(place) as folder:
                BacktestFolder(folder).write(config, prices, field.own)
            backtest._kept.folder = BacktestFolder(place)
        return backtest

    @classmethod
    def open(cls, folder: Path | str, agents: Mapping[str, Agent] | None = None) -> "Backtest":
        """A backtest as its last finished group of folds left it.

        agents: by name, those that are not registered with qfolio. Raises QfolioError if one is not
        the backtest's.
        """
        files = BacktestFolder(path_of("folder", folder))
        config = files.read_config()
        prices, trained = files.read_prices(config)
        return cls(prices, config, files, agents, files.read_own(config), trained)

    def extended(self, prices: Prices) -> "Backtest":
        """The same backtest on its table with more rows at the end, in the same folder.

        Finished folds keep their policies, and the last one decides up to its end. ``run`` then
        trains new folds and new policies for tomorrow; earlier ones are kept.

        Raises:
            QfolioError: The table does not begin with the backtest's rows (the error names the
                first row and column that differ), or a strategy of one's own lacks the new rows.
        """
        require_type("prices", prices, Prices, "a table that qfolio.load_prices has read")
        require_grown(self.prices, prices)
        if len(prices) == len(self.prices):
            return self
        for name, own in self._given_own.items():
            require_levels(name, own, prices)
        prices = dataclasses.replace(prices, source=self.prices.source, note=self.prices.note)
        trained = self._plan.grown(self._kept, len(prices))
        longer = Backtest(prices, self.config, None, self.agents, self._given_own, trained)
        longer._plan.require_begins_with(self.folds)
        memory.require(prices, longer.config)
        longer._kept = self._kept
        if self.folder is not None:
            with locked(self.folder):
                BacktestFolder(self.folder).grow(prices, trained)
        return longer

    def __repr__(self) -> str:
        seeds = amount(self.config.seeds, "seed")
        where = f", in {self.folder}" if self.folder else ""
        return (
            f"<Backtest: {', '.join(self.agents)} on {self._counts} "
            f"from {day(self.dates[0])} to {day(self.dates[-1])}, {seeds}{where}>"
        )

    def _repr_html_(self) -> str:
        every = [(agent, fold.name) for agent in self.agents for fold in self._plan.trainings]
        facts = [
            f"{sum(self._kept.has(*each) for each in every)} of {len(every)} trainings done",
            f"{self._counts}, {day(self.dates[0])} to {day(self.dates[-1])}",
            f"{self.config.cost * 1e4:g} bp",
            f"lag {self.config.lag}",
            *([] if self.folder is None else [str(self.folder)]),
        ]
        header, rows = ("a year, net", "growth", "Sharpe", "turnover", "drawdown"), []
        folder = self._kept.folder
        for name, measures in (folder.read_measures() if folder else {}).items():
            forms = {"growth": ".1%", "sharpe": ".2f", "turnover": ".1f", "drawdown": ".1%"}
            rows.append((name, *(figure(measures[key], form) for key, form in forms.items())))
        return card(f"Backtest of {' and '.join(self.agents)}", facts, header, rows)

    @property
    def members(self) -> int:
        """How many policies are trained in all: one for each agent, training window and seed."""
        return len(self.agents) * len(self._plan.trainings) * self.config.seeds

    @property
    def folder(self) -> Path | None:
        """The folder of the backtest, if it has one."""
        return None if self._kept.folder is None else self._kept.folder.path

    def run(
        self,
        listen: ListenToJob = lambda job, done, share: (),
        executor: Executor | str | None = None,
    ) -> None:
        """Trains every fold of every agent that is not trained yet.

        A first Ctrl-C stops after the current chunk and sets ``interrupted``; finished groups of
        folds are kept.

        Args:
            listen: Called before each job, with the share of the backtest that is finished and that
                of this job; returns the listeners of its training.
            executor: Where the jobs run (default: in this process); see ``qfolio.on``.
        """
        executor = on(executor)
        jobs = self.jobs(executor)
        self.interrupted = False
        if not jobs:
            return
        lock = contextlib.nullcontext() if self.folder is None else locked(self.folder)
        first = [next(group) for _, group in groupby(jobs, lambda job: job.agent_name)]
        ahead = preparing(first[1:] if isinstance(executor, Here) else [])
        with lock, ahead, Log(self.folder).opened(**self._about) as log:
            if self.folder is not None:
                tidy(self.folder)
            self.interrupted = carry_out(executor, jobs, listen, self.store, log, self.members)

    @property
    def _counts(self) -> str:
        return f"{amount(len(self.prices.assets), 'asset')}, {amount(len(self.folds), 'fold')}"

    @property
    def _about(self) -> dict[str, Any]:
        """What the log says about the backtest."""
        config = self.config
        return {
            "kind": config.kind,
            "task": self._counts,
            "agents": list(self.agents),
            "seeds": config.seeds,
        }

    def jobs(self, executor: Executor) -> list[FoldsJob]:
        """The training that is missing, in jobs that fill a worker; results go to ``store``."""
        return self._plan.jobs(self._kept, executor)

    def store(self, job: Job[dict[str, TrainedFold]], trained: dict[str, TrainedFold]) -> None:
        """Keeps what a job has trained."""
        self._plan.store(self._kept, job, trained)

    @property
    def parts(self) -> list[object]:
        """Agents, baselines and parts of tasks, which may be of a user's own modules."""
        tasks = [part for task in self.tasks.values() for part in task.parts]
        return [*self.agents.values(), *self.baselines.values(), *tasks]

    def policy(self, agent: str | None = None, stored: str | None = None) -> Policy:
        """The policy for tomorrow of an agent (default: the first).

        stored: its name among those of the agent (default: the newest, see ``newest``).
        """
        name = self._name(agent)
        stored = self.newest(name) if stored is None else stored
        task, trained = self._plan.part(name, stored), self.agents[name]
        state = state_template(task, trained, self.config.seeds)
        kept = self._kept.policy(name, stored, learning(state, 0, self.prices.dates[-1]))
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

    def keep(self, agent: str | None, policy: Policy) -> str:
        """Stores an updated policy as the agent's policy for tomorrow; earlier ones are kept.

        Returns its name among those of the agent.

        Raises QfolioError if that of the whole table is not trained yet, whose name it may have.
        """
        self._kept.require(self._name(agent), self._plan.current)
        kept = learning(policy.learner, policy.updates, policy.learned)
        stored = tomorrow(policy.updates)
        self._kept.write_policy(self._name(agent), stored, kept)
        return stored

    def newest(self, agent: str) -> str:
        """The name of the agent's newest policy for tomorrow, see ``kept.tomorrow``."""
        return self._kept.newest(agent)

    def stretches(self, agent: str) -> list[Stretch]:
        """The folds with an agent's policies."""
        task, trained = self.tasks[agent], self.agents[agent]
        members = trained.weights(state_template(task, trained, self.config.seeds))
        return [
            Stretch(self._plan.part(agent, f.name), self._kept.policy(agent, f.name, members), f)
            for f in self.folds
        ]

    def records(self, agent: str, fold: str) -> Records:
        """Every training episode of an agent in a fold, all seeds, in order of time."""
        return self._kept.records(agent, fold)

    def entries(self) -> tuple[dict[str, Entry], list[str]]:
        """Every strategy replayed over all folds, and notes on problems."""
        replay, seeds = self.replay, self.config.seeds

        def follow(name: str) -> dict[str, Entry]:
            return replay.agent(name, self.agents[name], self.stretches(name), seeds)

        with ThreadPoolExecutor(self.side_by_side) as threads:
            found = list(threads.map(follow, self.agents))
        others, said = replay.others(self.baselines, self._own, self.config.benchmark)
        entries = {name: entry for each in (*found, others) for name, entry in each.items()}
        return entries, [
            *notes.beforehand(self.config.agents, replay),
            *notes.left_out(replay),
            *notes.brief(replay),
            *said,
            *notes.too_risky(replay, entries),
            *notes.called(replay, entries, self._own),
            *notes.wiped_out(entries),
        ]

    @property
    def any_task(self) -> Portfolio:
        """Any agent's task; costs, lag and limits are the same for all."""
        return self._plan.any_task

    @property
    def side_by_side(self) -> int:
        """Number of agents that are replayed or explained at once."""
        return 2 if self.prices.values.size < SMALL else 1

    @cached_property
    def replay(self) -> Replay:
        """The rules that hold for all strategies."""
        return Replay(self.prices, self.folds, self.any_task, self.config.cap)

    @property
    def dates(self) -> np.ndarray:
        """Dates of the test's returns, shape (day,)."""
        return self._plan.dates

    def assess(self, entries: dict[str, Entry], since: str | None = None) -> assessment.Assessment:
        """The statistics of all strategies, over the whole test or from a date on."""
        days, table = slice(0 if since is None else self._plan.since(since), None), self.prices
        assessed = assessment.assess(
            {name: entry.track(days) for name, entry in entries.items()},
            self.dates[days],
            periods_per_year=table.periods_per_year,
            reference=self.config.benchmark,
            earlier_trials=self.config.trials + trials_on(table.source),
            risk_free=self.replay.growth[days, 0] - 1,
        )
        if not self.any_task.feasible.long_only:
            return assessed  # accounts with debts may exceed a bound for weights without debts
        bound = constant_bound(self.replay.growth[days], table.periods_per_year)
        return dataclasses.replace(assessed, bound=bound)

    def _require_able(self) -> None:
        """Raises QfolioError if orders or agents fail, which would show only after all training."""
        if self.config.mandate is not None:
            checks.require_safe(self.replay.task.mandate, self.replay.starts(), self.config.cap)
        self._plan.require_able()
        for name, each in self.baselines.items():
            if own_modules(each):
                self.replay.try_out(name, each)

    def _name(self, agent: str | None) -> str:
        """An agent's name (default: the first); raises QfolioError if it is unknown."""
        name = next(iter(self.agents)) if agent is None else agent
        if name not in self.agents:
            raise QfolioError(f"The backtest has no agent {name!r}; {near(name, self.agents)}")
        return name


def _require_arguments(
    agents: object,
    strategies: object,
    baselines: object,
    task: object,
    episodes: int | None,
    cap: Any,
) -> None:
    """Raises QfolioError for arguments of ``Backtest.create`` that no table could make right."""
    one = 'qfolio.preset("fast", "portfolio", "tilts")'
    by_name = f'presets or agents by name, such as {{"tilts": {one}}}'
    require_type("agents", agents, Mapping, f"a dictionary of {by_name}")
    assert isinstance(agents, Mapping)
    for name, agent in agents.items():
        wanted = f"a preset, such as {one}, or an agent, such as qfolio.Tilts()"
        require_type(f"agents[{name!r}]", agent, (Preset, Agent), wanted)
    if strategies is not None:
        wanted = 'a dictionary of files or tables by name, such as {"mine": "mine.csv"}'
        require_type("strategies", strategies, Mapping, wanted)
    if task is not None:
        require_type("task", task, Mapping, 'a dictionary of settings, such as {"window": 20}')
    if not agents:
        raise QfolioError("A backtest needs at least one agent; name some (--agents).")
    preset = all(isinstance(agent, Preset) for agent in agents.values())
    if preset and (episodes is not None or task):
        raise QfolioError(
            "episodes and task are for agents without a preset; change those of a preset with "
            "preset._replace(episodes=…, task=…)."
        )
    require_list("baselines", baselines, str, "a list of names")
    require_type("cap", cap, Real, "a number")
    if not 0 < cap <= 1:
        raise QfolioError(
            f"The cap is {cap:g}; it must be above 0 and at most 1. A mandate that allows "
            "loans or short sales may set one above 1 (assets.cap)."
        )
