"""Replays agents and baselines over the folds of a backtest."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from qfolio.core.mdp import Agent
from qfolio.portfolio.backtest.baselines import Baseline
from qfolio.portfolio.backtest.baselines.equal_weight import SPEEDS, EqualWeightAt
from qfolio.portfolio.backtest.folder import EQUAL_WEIGHT, TOGETHER
from qfolio.portfolio.backtest.folds import Fold, days_of, tested
from qfolio.portfolio.backtest.growth import Growth, filled_in
from qfolio.portfolio.backtest.orders import Orders, orders
from qfolio.portfolio.backtest.own import Placed, compliance
from qfolio.portfolio.backtest.simulation import Simulation, simulate
from qfolio.portfolio.backtest.statistics.assessment import Strategy
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel
from qfolio.portfolio.execution import Terms
from qfolio.portfolio.following import begin, follow, ordered
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.feasible import Mandated
from qfolio.portfolio.mandate.limits import feasible, largest_weight
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio
from qfolio.portfolio.universe import Patterns


@dataclass(frozen=True)
class Entry:
    """A strategy in the backtest."""

    kind: str  # one of assessment.KINDS
    decisions: np.ndarray  # (seed, day, entry), cash first
    simulation: Simulation  # of shape (seed, day)

    @property
    def weighted(self) -> bool:
        """Whether weights, turnover and costs are known; not if only returns were given."""
        return not bool(np.isnan(self.simulation.turnover[0, 0]))

    def track(self, days: slice) -> Strategy:
        """The track record over some days, for the assessment."""
        result = self.simulation
        returns = result.returns[:, days]
        if not self.weighted:
            return Strategy(self.kind, returns, None, None)
        rest = (result.turnover[:, days], result.cost[:, days], result.weights[:, days])
        return Strategy(self.kind, returns, *rest)

    @cached_property
    def mean_weights(self) -> np.ndarray:
        """Weights after each trade, cash first, the mean over the seeds, shape (day, entry)."""
        weights = self.simulation.weights
        return weights[0] if len(weights) == 1 else np.asarray(weights.mean(0))


class Stretch(NamedTuple):
    """A fold with the agents trained on it."""

    task: Portfolio  # the part of the table that the fold trained on
    members: PyTree  # the agents' weights, with a leading seed axis
    fold: Fold


def decide(agent: Agent, stretches: Sequence[Stretch], seeds: int, *, together: bool) -> np.ndarray:
    """Decisions over all folds, (seed, day, entry); each fold starts with the last one's holding.

    They are NaN where the calendar has no decision, or nothing is to be traded. With ``together``,
    one portfolio follows the mean of all seeds, and ``seeds`` is 1. The agents see their portfolio
    in float32; the replay is in float64.
    """
    cash = np.eye(1 + len(stretches[0].task.limits))[:1]
    held = begin(stretches[0].task, np.repeat(cash, seeds, 0))
    longest = max(fold.days for *_, fold in stretches)
    parts = []
    for task, members, fold in stretches:
        # One length for all folds, so that one program serves all; the surplus is cut off.
        start = fold.decisions.start
        targets, after = follow(task, agent, members, start, held, longest, together=together)
        given = ordered(task, targets, held.weights, np.asarray(after.weights))
        parts.append(np.where(given[..., None], targets, np.nan)[:, : fold.days])
        held = jax.tree.map(lambda x, last=fold.days - 1: x[:, last], after)
    return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class Replay:
    """The rules that hold for all strategies of a backtest.

    task: of any agent; all have the same costs and lag. cap: largest weight that baselines order.
    """

    prices: Prices
    folds: Sequence[Fold]
    task: Portfolio
    cap: float

    @cached_property
    def _complete(self) -> list[Fold]:
        return [fold.complete(self.prices.known) for fold in self.folds]

    @cached_property
    def _conditions(self) -> Conditions:
        return Conditions.of(self.prices, self.task.costs)

    @cached_property
    def rows(self) -> np.ndarray:
        """The row at which each of the test's returns begins, shape (day,)."""
        decided = tested(self.folds)
        return np.arange(decided.start, decided.stop) + self.task.lag

    @cached_property
    def relatives(self) -> np.ndarray:
        """Price relatives over the test's returns, shape (day, asset); 1 before a first price."""
        values = self.prices.values
        return np.nan_to_num(values[self.rows + 1] / values[self.rows], nan=1.0)

    @cached_property
    def growth(self) -> np.ndarray:
        """Growth factors of cash and each asset over the test's returns, shape (day, entry).

        Where an asset has no price, its factor is that of cash.
        """
        context = self._conditions.holding(self.rows, self.rows + 1)
        growth = np.array(self.task.costs.factors(self.relatives, context)[0])
        unpriced = np.isnan(self.prices.values[self.rows])
        growth[:, 1:] = np.where(unpriced, growth[:, :1], growth[:, 1:])
        return growth

    @cached_property
    def relaxed(self) -> list[tuple[Mandated, list[str]]]:
        """What the mandate allows in each fold, and which of its limits yield there, in words."""
        mandate, values = self.task.mandate, self.prices.values
        every = np.ones(values.shape[1], bool) if self.prices.tradable is not None else None
        return [
            checks.relaxed(
                feasible(mandate, fold.tradable(values) if every is None else every, self.cap)
            )
            for fold in self.folds
            if mandate
        ]

    @cached_property
    def patterns(self) -> tuple[Patterns, list[str]] | None:
        """What the mandate allows where assets come and go, if they do."""
        tradable, mandate = self.prices.tradable, self.task.mandate
        return (
            Patterns.of(mandate, tradable, self.cap) if mandate and tradable is not None else None
        )

    def starts(self) -> Iterator[Mandated]:
        """What the mandate allows at the first decision of each fold."""
        return (self._feasible(i, fold.decisions.start) for i, fold in enumerate(self.folds))

    def _feasible(self, fold: int, row: int) -> Mandated:
        """What the mandate allows at a row of a fold."""
        made = self.relaxed[fold][0]
        if self.patterns is not None:
            made = self.patterns[0].at(row, made)
        return made.knowing(self.task.risk_at(jnp.array(row))) if made.limits_risk else made

    @property
    def terms(self) -> Terms:
        """When and how orders are carried out, as arrays of numpy."""
        terms = self.task.terms
        return terms._replace(decides=np.asarray(terms.decides), elapsed=np.asarray(terms.elapsed))

    def agent(
        self, name: str, agent: Agent, stretches: Sequence[Stretch], seeds: int
    ) -> dict[str, Entry]:
        """Each seed of an agent by itself and, if there are several, all together."""
        each = decide(agent, stretches, seeds, together=False)
        entries = {name: self.entry("agent", each)}
        if seeds > 1:
            together = decide(agent, stretches, 1, together=True)
            entries[f"{name}{TOGETHER}"] = self.entry("ensemble", together)
        return entries

    def baseline(self, kind: str, name: str, baseline: Baseline) -> tuple[Entry, tuple[str, ...]]:
        """A baseline, and notes on its decisions."""
        given = self._orders(name, baseline, self._complete)
        return self.entry(kind, given.decisions[None]), given.notes

    def try_out(self, name: str, baseline: Baseline) -> None:
        """Asks a baseline for its first decision; raises QfolioError if that is invalid."""
        fold = self._complete[0]
        start = fold.decisions.start
        self._orders(name, baseline, [fold._replace(decisions=slice(start, start + 1))])

    def _orders(self, name: str, baseline: Baseline, folds: Sequence[Fold]) -> Orders:
        table, text = self.prices, self.task.mandate
        return orders(
            name,
            baseline,
            folds,
            table.dates,
            table.values,
            universe=table.tradable,
            costs=self.task.costs,
            conditions=self._conditions,
            cap=min(self.cap, largest_weight(text)) if text else self.cap,
            feasible=self._feasible if text else None,
            month=table.month,
            terms=self.terms,
        )

    def own(self, kind: str, placed: Placed) -> Entry:
        """A strategy of the user's own; with returns only, all else is NaN."""
        if placed.returns is None:
            return self.entry(kind, placed.decisions[None])
        unknown = np.full((1, len(placed.returns)), np.nan)
        weights = placed.decisions[None]
        return Entry(kind, weights, Simulation(placed.returns[None], unknown, unknown, weights))

    def others(
        self, baselines: Mapping[str, Baseline], own: Mapping[str, Placed], benchmark: str
    ) -> tuple[dict[str, Entry], list[str]]:
        """All strategies but the agents, and notes; equal weights at every speed as a benchmark."""
        notes: list[str] = []
        entries: dict[str, Entry] = {}
        for name, placed in own.items():
            entries[name] = self.own("baseline" if name == benchmark else "strategy", placed)
            notes += placed.notes
            if self.task.mandate and name != benchmark:
                notes.append(self._compliance(name, entries[name]))
        speeds = SPEEDS if benchmark == EQUAL_WEIGHT else ()
        slower = {f"{EQUAL_WEIGHT} at {speed:g}": EqualWeightAt(speed) for speed in speeds}
        for kind, rules in (("baseline", baselines), ("rebalancing", slower)):
            for name, rule in rules.items():
                entries[name], said = self.baseline(kind, name, rule)
                notes += said
        return entries, notes

    def _compliance(self, name: str, entry: Entry) -> str:
        """Says whether a strategy of the user's own keeps the mandate."""
        if not entry.weighted:
            return f"{name} has returns only, so whether it keeps the mandate is not known."
        allowed = []
        for fold, days, (made, _) in zip(
            self.folds, days_of(self.folds), self.relaxed, strict=True
        ):
            rows = np.arange(fold.decisions.start, fold.decisions.stop)
            here = made if self.patterns is None else self.patterns[0].at(rows, made)
            allowed.append((days, here))
        decisions, first = entry.decisions[0], self.folds[0].decisions.start
        held = self._held(decisions, first)
        spent, elapsed = np.nan_to_num(abs(decisions - held)[:, 1:].sum(1)), self.terms.elapsed
        spare = np.full(len(spent), np.inf)
        if len(elapsed):
            year = elapsed[first : first + len(spent)].astype(int)
            before = np.append(0.0, spent.cumsum())[np.searchsorted(year, year)]
            spare = self.terms.turnover - (spent.cumsum() - before)
        return compliance(name, decisions, held, allowed, spare)

    def _held(self, decisions: np.ndarray, first: int) -> np.ndarray:
        """The weights before each of some decisions, (day, entry), the first of them at a row."""
        growth = Growth(filled_in(self.prices.values)[0], self.task.costs, self._conditions)
        held, weights, row = np.full_like(decisions, np.nan), np.eye(decisions.shape[1])[0], first
        for day in np.flatnonzero(~np.isnan(decisions[:, 0])).tolist():
            held[day] = growth.held(weights, row, first + day)
            weights, row = decisions[day], first + day
        return held

    def entry(self, kind: str, decisions: np.ndarray, costs: CostModel | None = None) -> Entry:
        """A strategy by its decisions of shape (seed, day, entry); costs: default, the task's."""
        simulation = simulate(
            self.prices.values,
            decisions,
            first=self.folds[0].decisions.start,
            cost=self.task.costs if costs is None else costs,
            lag=self.task.lag,
            conditions=self._conditions,
            long_only=self.task.feasible.long_only,
        )
        return Entry(kind, decisions, simulation)
