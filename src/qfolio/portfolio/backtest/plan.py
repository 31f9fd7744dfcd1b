"""The plan of a backtest: its folds, what each agent trains on, and which trainings are missing."""

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from qfolio.core import faults, settings
from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent
from qfolio.core.registry import own_modules
from qfolio.core.training import begin
from qfolio.experiments.budget import Budget, seed_range
from qfolio.experiments.described import agent_of
from qfolio.experiments.executor import Executor, Job, at_once
from qfolio.portfolio.backtest.folder import BacktestConfig
from qfolio.portfolio.backtest.folds import Fold, latest, tested, walk_forward
from qfolio.portfolio.backtest.kept import Kept, learning, tomorrow, updates_of
from qfolio.portfolio.backtest.training import FoldsJob, TrainedFold
from qfolio.portfolio.mandate.limits import mandate_text
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

FOLDS_AT_ONCE = 8
"""Folds that train at once if members advance in lockstep; results are kept after each group."""


class Plan:
    """The rows that a backtest trains on and tests, and what is still to be trained.

    folds: those of the test. trainings: what every agent trains on: the folds, and the latest rows,
    for tomorrow. agents, tasks: by name; an agent's task is on the whole table.
    """

    def __init__(
        self,
        prices: Prices,
        config: BacktestConfig,
        agents: Mapping[str, Agent],
        trained: Sequence[tuple[int, int]],
    ) -> None:
        """Takes its arguments as ``Backtest`` does."""
        self._trained = list(trained) or [(0, len(prices))]
        self._prices, self._config = prices, config
        dates, length, expanding = prices.dates, config.train, config.expanding
        folds = walk_forward(dates, length, config.test, config.lag, expanding)
        last = [latest(tomorrow(n), dates[:rows], length, expanding) for n, rows in self._trained]
        every = [*folds, *last]
        if prices.tradable is None:  # else agents also learn from assets that come and go
            every = [fold.complete(prices.values) for fold in every]
        self.folds = every[: len(folds)]
        self.trainings = [*self.folds, every[-1]]
        self.agents = {
            name: agent_of(entry.agent, entry.settings, agents.get(name))
            for name, entry in config.agents.items()
        }
        self.tasks = {name: self._task(name) for name in self.agents}
        self._parts = {
            (name, fold.name): self._part(name, task, fold)
            for name, task in self.tasks.items()
            for fold in every
        }

    @property
    def any_task(self) -> Portfolio:
        """Any agent's task; costs, lag and limits are the same for all."""
        return next(iter(self.tasks.values()))

    @property
    def decisions(self) -> slice:
        """Rows of the test's decisions."""
        return tested(self.folds)

    @property
    def dates(self) -> np.ndarray:
        """Dates of the test's returns, shape (day,)."""
        shift, days = self._config.lag + 1, self.decisions
        return self._prices.dates[days.start + shift : days.stop + shift]

    def since(self, date: str) -> int:
        """The first row of the test at or after a date."""
        try:
            first = int(np.searchsorted(self.dates, np.datetime64(date)))
        except ValueError:
            raise QfolioError(f"{date!r} is no date; write one such as 2020-01-01.") from None
        if first == len(self.dates):
            raise QfolioError(
                f"The test ends on {day(self.dates[-1])}, before {date}; give an earlier date."
            )
        return first

    def part(self, agent: str, policy: str) -> Portfolio:
        """An agent's task on the rows that one of its policies was trained on.

        policy: the name of a fold or, perhaps after more updates, of a policy for tomorrow.
        """
        updates = updates_of(policy)
        if updates >= 0:
            policy = tomorrow(max(n for n, _ in self._trained if n <= updates))
        return self._parts[agent, policy]

    def jobs(self, kept: Kept, executor: Executor) -> list[FoldsJob]:
        """The training that is missing, in jobs that fill a worker; results go to ``store``."""
        return [job for name in self.agents for job in self._missing(name, kept, executor)]

    def store(
        self, kept: Kept, job: Job[dict[str, TrainedFold]], trained: dict[str, TrainedFold]
    ) -> None:
        """Keeps what a job has trained."""
        agent = job.name.partition("/")[0]
        for fold, result in trained.items():
            policy = result.kept
            if fold == self.current:
                policy = learning(policy, self._trained[-1][0], self._prices.dates[-1])
            kept.write(agent, fold, result.rows, policy)

    def grown(self, kept: Kept, rows: int) -> list[tuple[int, int]]:
        """``trained`` of a plan for a table that has grown to some number of rows."""
        updates = 1 + max(kept.updates(name) for name in self.agents)
        earlier = [each for each in self._trained if each[0] < updates]
        return [*earlier, (updates, rows)]

    def require_able(self) -> None:
        """Raises QfolioError if an agent cannot begin, such as one with a wrong menu or rollout.

        Some settings can be checked only with a task. Only shapes are traced: of all methods of a
        user's own agent, which takes seconds, and otherwise of ``init``. The first weights of one's
        own agent are computed, too.
        """
        key, seed = jax.random.key(0), jnp.uint32(0)
        for name, agent in self.agents.items():
            task = self.part(name, self.folds[0].name)
            try:
                if own_modules(agent):
                    jax.eval_shape(partial(begin, task, agent), seed)
                    faults.require_actions(task, agent)
                else:
                    jax.eval_shape(partial(agent.init, task), key)
            except QfolioError as error:
                raise type(error)(f"{name}: {error}") from None

    def require_begins_with(self, folds: Sequence[Fold]) -> None:
        """Raises QfolioError unless its first folds are those of a table before it grew."""
        names = [*(fold.name for fold in self.folds), "none"]
        for before, now in zip(folds, names, strict=False):
            if before.name != now:
                raise QfolioError(
                    f"With the new rows, folds begin on other dates (first: {before.name}, now "
                    f"{now}); start a new backtest."
                )

    @property
    def current(self) -> str:
        """Name of the policies for tomorrow that are trained on the whole table."""
        return tomorrow(self._trained[-1][0])

    def _task(self, name: str) -> Portfolio:
        config = self._config
        own = {
            "lag": config.lag,
            "cost": config.cost,
            "cost_model": config.cost_model,
            "max_weight": config.cap,
            "calendar": config.calendar,
            "mandate": mandate_text(config.mandate, config.assets),
        }
        entry = config.agents[name].task
        task = Portfolio.of(self._prices, **settings.convert(Portfolio, {**entry, **own}))
        return task.deciding_at(self.folds[0].decisions.start)

    def _part(self, name: str, task: Portfolio, fold: Fold) -> Portfolio:
        still = self._prices.tradable is None
        usable = fold.tradable(self._prices.values) if still else None
        try:
            return task.part(fold.train.start, fold.train.stop - 1, usable)
        except QfolioError as error:
            raise type(error)(f"{name}, fold {fold.name}: {error}") from None

    def _missing(self, name: str, kept: Kept, executor: Executor) -> list[FoldsJob]:
        """The folds that are still to be trained, in groups that fill a worker's devices."""
        missing = [fold for fold in self.trainings if not kept.has(name, fold.name)]
        size = at_once(executor, FOLDS_AT_ONCE)
        most = min(size, len(missing))
        return [self._job(name, missing[i : i + size], most) for i in range(0, len(missing), size)]

    def _job(self, name: str, folds: Sequence[Fold], most: int) -> FoldsJob:
        return FoldsJob(
            name,
            self.agents[name],
            tuple(fold.name for fold in folds),
            tuple(self._parts[name, fold.name] for fold in folds),
            tuple(seed_range(self._config.seeds, self._config.seed)),
            Budget(self._config.agents[name].episodes),
            self.current,
            most,
        )
