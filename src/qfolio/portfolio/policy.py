"""A learned portfolio policy: from prices and holdings to target weights.

The policy is the mean over the agents of all seeds. ``policy_folder.py`` stores it on disk.
"""

import dataclasses
import reprlib
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from qfolio.core import settings
from qfolio.core.errors import QfolioError, require_type
from qfolio.core.files import path_of
from qfolio.core.mdp import Agent
from qfolio.core.population import Population
from qfolio.core.text import amount, near
from qfolio.core.training import episode_steps
from qfolio.experiments.budget import Budget, seed_range
from qfolio.experiments.fit import Listener, fit
from qfolio.experiments.presets import Preset, preset
from qfolio.portfolio import policy_folder, signals
from qfolio.portfolio.costs import CostModel, cashed
from qfolio.portfolio.few_rows import fitted
from qfolio.portfolio.following import begin, follow, on_table
from qfolio.portfolio.mandate.limits import mandate_text
from qfolio.portfolio.prices.findings import day, listing
from qfolio.portfolio.prices.frequency import require_alike
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.task import Portfolio

UPDATE_RATE = 0.1
"""Learning rate of an update, as a fraction of the one in training."""

MOST = 100.0
"""Largest weight that may be held, long or short, where debts are allowed."""

ROUNDING = 1e-6
"""A weight this little below zero is zero, since policies decide in float32."""

UNKNOWN = np.datetime64("NaT", "s")


def train(
    prices: Any,
    agent: str | Preset | Agent = "pathwise",
    *,
    seeds: int | None = None,
    seed: int = 0,
    episodes: int | None = None,
    listeners: Sequence[Listener] = (),
    **task: Any,
) -> "Policy":
    """A policy trained on all rows of a price table, all seeds in one program.

    Args:
        prices: Anything that ``qfolio.load_prices`` reads.
        agent: The name of an agent, for its fast preset; a preset; or an agent, which then needs
            ``episodes``.
        seeds, seed: Number of agents (default: the preset's, or 5), with the seeds ``seed``,
            ``seed + 1``, ….
        episodes: Training episodes of each agent (default: the preset's).
        task: Settings of the portfolio task (cost, lag, window, …) that replace the preset's. A
            preset's horizon becomes a half or a third if the table has too few rows for all of it.

    Raises:
        QfolioError: Table, settings and agent do not fit together, or a loss is not finite.
    """
    table = load(prices)
    if isinstance(agent, str):
        agent = preset("fast", "portfolio", agent)
    if isinstance(agent, Preset):
        task = {**agent.task, **task}
    if "mandate" in task:
        task["mandate"] = mandate_text(task["mandate"], table.assets)
    if isinstance(agent, Preset):
        agent = fitted(agent._replace(task=task), len(table))
        task = dict(agent.task)
        episodes = agent.episodes if episodes is None else episodes
        seeds = agent.seeds if seeds is None else seeds
        agent = agent.build()
    require_type("agent", agent, Agent, "an agent, such as qfolio.Pathwise(), or a preset")
    if episodes is None:
        raise QfolioError("An agent without a preset needs episodes, the length of its training.")
    count = 5 if seeds is None else seeds
    portfolio = Portfolio.of(table, **settings.convert(Portfolio, task))
    population = Population(portfolio, agent, seed_range(count, seed))
    _learn(population, episodes, listeners)
    learner = population.fetch().agent
    return Policy(
        portfolio,
        agent,
        agent.weights(learner),
        table.assets,
        table.feature_names,
        learner,
        learned=table.dates[-1],
    )


class Policy:
    """Agents of one kind and several seeds, trained on the assets of one table.

    task: the portfolio task, with the part of the table that they were trained on.
    members: the agents' learned parameters, with a leading seed axis.
    learner: the agents' whole states, likewise; without it, the policy cannot be updated.
    updates: number of updates so far.
    learned: the date of the last row that it has learned from; NaT if unknown.
    """

    def __init__(
        self,
        task: Portfolio,
        agent: Agent,
        members: PyTree,
        assets: Sequence[str],
        features: Sequence[str] = (),
        learner: PyTree = None,
        updates: int = 0,
        learned: np.datetime64 = UNKNOWN,
    ) -> None:
        self.task, self.agent, self.members = task, agent, members
        self.assets, self.features = tuple(assets), tuple(features)
        self.learner, self.updates, self.learned = learner, updates, learned

    def __repr__(self) -> str:
        of = f"{amount(len(self.assets), 'asset')}, {amount(self.seeds, 'seed')}"
        when = "" if np.isnat(self.learned) else f", learned until {day(self.learned)}"
        return f"<Policy: {type(self.agent).__name__} on {of}{when}>"

    def weights(
        self, prices: Any, holdings: Any = None, *, spent: float = 0.0, **options: Any
    ) -> dict[str, float]:
        """Target weights after the last row of a price table, by asset, with "cash" first.

        Args:
            prices: A price table with the assets that the policy was trained on, in any order, and
                more rows than its window; anything that ``prices.load`` reads, with its options.
            holdings: Weights held now, by asset; the rest is cash (default: all cash).
            spent: Turnover since the calendar year began, for a mandate that limits it.

        Raises:
            QfolioError: The assets are not those of the policy, or prices are missing in its
                window.
        """
        require_type("spent", spent, Real, "a number of at least 0")
        if not 0 <= spent < float("inf"):
            raise QfolioError(f"spent is {spent!r}; it must be a number of at least 0.")
        table = self.table(prices, **options)
        held, last = self.holdings(holdings), len(table) - 1
        held = held if table.listed is None else cashed(held, table.listed[-1])
        (targets,), _ = self.decide(table, last, held, 1, spent=spent, whole=True)
        weights = np.where((targets < 0) & (targets > -ROUNDING), 0.0, targets)
        return dict(zip(("cash", *self.assets), (weights / weights.sum()).tolist(), strict=True))

    def update(
        self,
        prices: Any,
        episodes: int | None = None,
        *,
        listeners: Sequence[Listener] = (),
        **options: Any,
    ) -> "Policy":
        """The policy after further learning from the last rows of a newer table.

        It learns from as many rows as in its first training, and keeps the scale of its
        observations. Networks and optimizer continue from their states, at a constant tenth of the
        learning rate; experience from the old table is dropped. Agents that weigh evidence, such as
        tilts, learn anew, for as long as before.

        Args:
            prices: As for ``weights``.
            episodes: Learning episodes of each agent (default: one for each of its environments; as
                many as before if it learns anew).

        Raises:
            QfolioError: The learning state was not saved, the table does not fit, has fewer rows
                than the policy was trained on, or has none newer than those already learned from.
        """
        if self.learner is None:
            raise QfolioError(
                "This policy was saved without its learning state and cannot be updated; train it "
                "again."
            )
        if episodes is not None:
            _ = Budget(episodes)
        table = self.table(prices, **options)
        if table.dates[-1] <= self.learned:
            raise QfolioError(
                f"The prices end on {day(table.dates[-1])}, but the policy has already learned "
                f"from those up to {day(self.learned)}; give newer prices, or leave out the update."
            )
        if len(table) < self.rows:
            raise QfolioError(
                f"The price table has {amount(len(table), 'row')}, too few for an update: the "
                f"policy learned from {self.rows}; give earlier prices, too, or leave out the "
                "update."
            )
        task = self.task.on_rows(table, len(table) - self.rows)
        task = task.having(center=self.task.center, scale=self.task.scale)
        rollouts = self.agent.relearned(self.learner)
        agent = self.agent if rollouts else _slowed(self.agent)
        draws = [np.random.SeedSequence((i, self.updates + 1)) for i in range(self.seeds)]
        seeds = [int(draw.generate_state(1)[0]) for draw in draws]
        lasting = lambda steps: -(-steps // episode_steps(task, agent)) * agent.num_envs  # noqa: E731
        unlearned = lasting(agent.warm_up())
        wanted = lasting(rollouts * agent.rollout_steps) or agent.num_envs
        population = Population(task, agent, seeds)
        if not rollouts:
            state = population.fetch()
            learner = agent.carry_over(self.learner, state.agent)
            population.restore(eqx.tree_at(lambda s: s.agent, state, learner))
        _learn(population, unlearned + (wanted if episodes is None else episodes), listeners)
        learner = population.fetch().agent
        return Policy(
            task,
            self.agent,
            agent.weights(learner),
            self.assets,
            self.features,
            learner,
            self.updates + 1,
            table.dates[-1],
        )

    @property
    def costs(self) -> CostModel:
        """The cost model of the market that the policy was trained on."""
        return self.task.costs

    @property
    def mandate(self) -> str:
        """Text of the mandate that the policy was trained under."""
        return self.task.mandate

    @property
    def seeds(self) -> int:
        """How many members the policy has, one for each seed."""
        return int(jax.tree.leaves(self.members)[0].shape[0])

    @property
    def rows(self) -> int:
        """Number of rows that the policy was trained on."""
        return (
            int(self.task.last_decision - self.task.first_decision)
            + self.task.window
            + self.task.lag
            + 2
        )

    def table(self, prices: Any, **options: Any) -> Prices:
        """The prices with the policy's assets in its order; see ``weights``."""
        table = load(prices, **options).exactly(self.assets, "the policy")
        if table.feature_names != self.features:
            raise QfolioError(
                f"The price table has {listing(table.feature_names) or 'none'} as further "
                f"features; the policy was trained with {listing(self.features) or 'none'}."
            )
        require_alike(table.dates, float(self.task.year), "the policy learned from prices with")
        if len(table) <= self.task.window:
            raise QfolioError(
                f"The price table has {amount(len(table), 'row')}; the policy's window "
                f"needs at least {self.task.window + 1}."
            )
        # A policy that learned from a shorter table has never known its longest signals.
        chosen = signals.parse(self.task.signals, table.periods_per_year)
        looked = min(signals.lookback(chosen), self.rows - 1)
        if len(table) <= looked:
            raise QfolioError(
                f"The price table has {amount(len(table), 'row')}; the policy's signals "
                f"look back on {looked}, so it needs at least {looked + 1}."
            )
        if table.tradable is not None:  # it may hold whichever assets are available
            return table
        # An asset that may be held needs prices in the whole window, the others at its end.
        tradable, last = np.asarray(self.task.limits) > 0, len(table) - 1
        begin = last - self.task.window
        late = table.first_rows > np.where(tradable, begin, last)
        if late.any():
            names = [name for name, is_late in zip(self.assets, late, strict=True) if is_late]
            raise QfolioError(
                f"The policy's window begins on {day(table.dates[begin])}, when there was no price "
                f"of {listing(names)} "
                "yet; give earlier prices, or wait until there are enough."
            )
        return table

    def holdings(self, holdings: Mapping[str, Any] | None) -> np.ndarray:
        """Weights with cash first, from weights by asset."""
        held, long_only = np.zeros(1 + len(self.assets)), self.task.feasible.long_only
        try:
            given = {} if holdings is None else dict(holdings)
        except (TypeError, ValueError):
            raise QfolioError(
                f"holdings is {reprlib.repr(holdings)}; it must be a dictionary of the weights "
                f"held by asset, such as {{{self.assets[0]!r}: 0.5}}."
            ) from None
        for name, weight in given.items():
            if name != "cash" and name not in self.assets:
                raise QfolioError(
                    f"The holdings name {name!r}, which the policy does not know; "
                    f"{near(name, self.assets)}"
                )
            low, high = (0.0, 1 + 1e-9) if long_only else (-MOST, MOST)
            if not isinstance(weight, Real) or not low <= float(weight) <= high:
                raise QfolioError(
                    f"The weight of {name!r} is {weight!r}; it must be a number"
                    f"{' from 0 to 1' if long_only else ''}."
                )
            held[0 if name == "cash" else 1 + self.assets.index(name)] = weight
        total = held[1:].sum()
        excessive = long_only and total > 1 + 1e-9
        if excessive or ("cash" in given and abs(held.sum() - 1) > 1e-6):
            raise QfolioError(f"The weights held sum to {held.sum():.6g}; they must sum to 1.")
        held[0] = max(0.0, 1 - total) if long_only else 1 - total
        return held / held.sum()

    def decide(
        self,
        prices: Prices,
        first: int,
        held: np.ndarray,
        count: int,
        *,
        spent: float = 0.0,
        whole: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Target weights at ``count`` rows from ``first`` on, and the weights held after each.

        held: at row ``first``, shape (entry,). spent: as for ``weights``. whole: whether orders are
        filled at once. Both results are (count, entry); the second is drifted to the row after each
        decision.
        """
        task = on_table(self.task, prices)
        task = task.filled_at_once() if whole else task
        start = begin(task, held[None], spent)
        found, after = follow(task, self.agent, self.members, first, start, count, together=True)
        both = (np.asarray(x[0], float) for x in (found, after.weights))
        targets, then = (x / x.sum(-1, keepdims=True) for x in both)
        return targets, then

    def save(self, folder: Path | str) -> None:
        """Writes the policy into a new or empty folder."""
        policy_folder.save(self, path_of("folder", folder))

    @classmethod
    def open(cls, folder: Path | str, agent: Agent | None = None) -> "Policy":
        """Reads what ``save`` wrote.

        agent: the agent itself, if its settings alone do not make it.

        Raises QfolioError if the folder holds no policy, or one of another agent.
        """
        return cls(**policy_folder.read(path_of("folder", folder), agent))


def _slowed(agent: Agent) -> Agent:
    """An agent at a constant share of its learning rate; a user's may have none."""
    of_now: Any = agent
    rates = {}
    known = {field.name for field in dataclasses.fields(of_now)}
    if "learning_rate" in known:
        rates["learning_rate"] = of_now.learning_rate * UPDATE_RATE
    if "learning_rate_final" in known:
        rates["learning_rate_final"] = 1.0  # the schedule may have ended
    slowed: Agent = dataclasses.replace(of_now, **rates)
    return slowed


def _learn(population: Population, episodes: int, listeners: Sequence[Listener]) -> None:
    """Trains; raises KeyboardInterrupt if Ctrl-C stopped it before the end."""
    if not fit(population, Budget(episodes), listeners).finished:
        raise KeyboardInterrupt
