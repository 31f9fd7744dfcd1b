"""Replays agents and baselines over the folds of a backtest."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from qfolio.core.mdp import Agent
from qfolio.portfolio.backtest.baselines import Baseline
from qfolio.portfolio.backtest.baselines.equal_weight import SPEEDS, EqualWeightAt
from qfolio.portfolio.backtest.folder import EQUAL_WEIGHT, TOGETHER
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.orders import Orders, orders
from qfolio.portfolio.backtest.own import Placed, kept
from qfolio.portfolio.backtest.simulation import Simulation, simulate
from qfolio.portfolio.backtest.statistics.assessment import Strategy
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel
from qfolio.portfolio.execution import Terms
from qfolio.portfolio.following import begin, follow, ordered
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.feasible import Mandated
from qfolio.portfolio.mandate.limits import feasible, largest_weight
from qfolio.portfolio.prices.findings import first_of, listing
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio
from qfolio.portfolio.universe import Patterns

BARELY = 1e-3
"""Risk that exceeds a limit by a smaller share of it is a rounding error."""


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
    days = [fold.decisions.stop - fold.decisions.start for *_, fold in stretches]
    parts = []
    for (task, members, fold), count in zip(stretches, days, strict=True):
        # One length for all folds, so that one program serves all; the surplus is cut off.
        start = fold.decisions.start
        targets, after = follow(task, agent, members, start, held, max(days), together=together)
        given = ordered(task, targets, held.weights, np.asarray(after.weights))
        parts.append(np.where(given[..., None], targets, np.nan)[:, :count])
        held = jax.tree.map(lambda x, last=count - 1: x[:, last], after)
    return np.concatenate(parts, axis=1)


@eqx.filter_jit
def _risks(
    task: Portfolio, rows: Int[Array, " trade"], weights: Float[Array, "trade asset"]
) -> tuple[Float[Array, " trade"], Float[Array, " trade"]]:
    """Annual volatility and tracking error of weights, as known at their rows."""

    def each(row: Array, held: Array) -> tuple[Array, Array]:
        risk = task.risk_at(row)
        return risk.of(held), risk.of(held - risk.benchmark)

    found: tuple[Array, Array] = lax.map(lambda given: each(*given), (rows, weights))
    return found


@dataclass(frozen=True)
class Replay:
    """The rules that hold for all strategies of a backtest.

    task: of any agent; all have the same costs and lag. cap: largest weight that baselines order.
    """

    prices: Prices
    folds: Sequence[Fold]
    task: Portfolio
    cap: float

    def left_out(self) -> list[str]:
        """A note on each fold that leaves out assets, or one on all that are delisted."""
        listed, assets = self.prices.listed, self.prices.assets
        if self.prices.tradable is not None:
            last = np.ones(len(assets), bool) if listed is None else listed[-1]
            names = [assets[j] for j in np.flatnonzero(~last)]
            return [f"Delisted: {listing(names)}."] if names else []
        folds = ((fold.name, fold.tradable(self.prices.values)) for fold in self.folds)
        return [
            f"Fold {name} leaves out {listing(late)}, which started too late."
            for name, tradable in folds
            if (late := [assets[j] for j in np.flatnonzero(~tradable)])
        ]

    def mandated(self) -> list[str]:
        """Notes on what is unusual about caps and the mandate, and on what a fold cannot meet."""
        every = np.ones(len(self.prices.assets), bool)
        notes = checks.unusual(self.task.mandate, every, self.cap)
        if not self.task.mandate:
            return notes
        if self._patterns is not None and (yields := self._patterns[1]):
            said = ", ".join(yields)
            notes.append(f"The mandate is relaxed to fit the assets that can be traded: {said}.")
        return notes + [
            f"In fold {fold.name} the mandate is relaxed to fit the assets that can be traded: "
            f"{said}."
            for fold, (_, lowered) in zip(self.folds, self._relaxed, strict=True)
            for said in lowered
        ]

    @cached_property
    def _complete(self) -> list[Fold]:
        return [fold.complete(self.prices.values) for fold in self.folds]

    @cached_property
    def _conditions(self) -> Conditions:
        return Conditions.of(self.prices, self.task.costs.columns)

    @cached_property
    def growth(self) -> np.ndarray:
        """Growth factors of cash and each asset over the test's returns, shape (day, entry)."""
        begin, end = self.folds[0].decisions.start, self.folds[-1].decisions.stop
        rows, values = np.arange(begin, end) + self.task.lag, self.prices.values
        relatives = np.nan_to_num(values[rows + 1] / values[rows], nan=1.0)
        return np.asarray(
            self.task.costs.carry(relatives, self._conditions.holding(rows, rows + 1))
        )

    @cached_property
    def _relaxed(self) -> list[tuple[Mandated, list[str]]]:
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
    def _patterns(self) -> tuple[Patterns, list[str]] | None:
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
        made = self._relaxed[fold][0]
        if self._patterns is not None:
            made = self._patterns[0].at(row, made)
        return made.knowing(self.task.risk_at(jnp.array(row))) if made.limits_risk else made

    @property
    def _terms(self) -> Terms:
        terms = self.task.terms
        return terms._replace(decides=np.asarray(terms.decides), elapsed=np.asarray(terms.elapsed))

    def too_risky(self, entries: Mapping[str, Entry]) -> list[str]:
        """A note on each limit of risk that trades exceed, with the strategies and how often."""
        allowed = self.task.allowed
        if allowed is None or not allowed.limits_risk:
            return []
        limits = {"volatility": allowed.volatility, "tracking error": allowed.tracking_error}
        over: dict[str, list[str]] = {said: [] for said in limits}
        for name, entry in entries.items():
            if not entry.weighted:
                continue
            traded = ~np.isnan(entry.decisions[..., 0])
            rows = self.folds[0].decisions.start + np.nonzero(traded)[1]
            found = _risks(self.task, jnp.asarray(rows), jnp.asarray(entry.decisions[traded, 1:]))
            for (said, most), risk in zip(limits.items(), np.asarray(found), strict=True):
                if count := int((risk > most * (1 + BARELY)).sum()):
                    most_of_all = f"{count:,} of {len(rows):,}, up to {risk.max():.3g}"
                    over[said].append(f"{name} ({most_of_all})")
        return [
            f"Trades that leave a {said} above {limits[said]:.4g}: {first_of(names)}."
            for said, names in over.items()
            if names
        ]

    def called(self, entries: Mapping[str, Entry], own: Container[str]) -> list[str]:
        """A note on margin calls: who traded at rows where the calendar had no decision.

        own: names of strategies of the user's own, which have no margin calls.
        """
        terms, first = self._terms, self.folds[0].decisions.start
        if terms.called == np.inf or not len(terms.decides):
            return []
        planned = np.convolve(terms.decides, np.ones(terms.fill))[first:] > 0
        said = []
        for name, entry in entries.items():
            traded = ~np.isnan(entry.decisions[..., 0]) & (entry.simulation.wealth[:, :-1] > 0)
            count = int((traded & ~planned[: traded.shape[1]]).sum())
            if count and name not in own:
                said.append(f"{name} ({count:,})")
        return [f"Trades that margin calls forced: {first_of(said)}."] if said else []

    def wiped_out(self, entries: Mapping[str, Entry]) -> list[str]:
        """A note on each strategy that lost everything."""
        counts = {name: int(entry.simulation.ruined.sum()) for name, entry in entries.items()}
        return [
            f"{name} was wiped out: its debts exceeded what it owned"
            + (f", with {count} of {len(entries[name].decisions)} seeds." if count > 1 else ".")
            for name, count in counts.items()
            if count
        ]

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
        folds = self.folds if self.prices.tradable is None else self._complete
        given = self._orders(name, baseline, folds)
        return self.entry(kind, given.decisions[None]), given.notes

    def try_out(self, name: str, baseline: Baseline) -> None:
        """Asks a baseline for its first decision; raises QfolioError if that is invalid."""
        fold = self.folds[0] if self.prices.tradable is None else self._complete[0]
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
            terms=self._terms,
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
                notes.append(self._kept(name, entries[name]))
        speeds = SPEEDS if benchmark == EQUAL_WEIGHT else ()
        slower = {f"{EQUAL_WEIGHT} at {speed:g}": EqualWeightAt(speed) for speed in speeds}
        for kind, rules in (("baseline", baselines), ("rebalancing", slower)):
            for name, rule in rules.items():
                entries[name], said = self.baseline(kind, name, rule)
                notes += said
        return entries, notes

    def _kept(self, name: str, entry: Entry) -> str:
        """Says whether a strategy of the user's own keeps the mandate."""
        if not entry.weighted:
            return f"{name} has returns only, so whether it keeps the mandate is not known."
        first, allowed = self.folds[0].decisions.start, []
        for fold, (made, _) in zip(self.folds, self._relaxed, strict=True):
            rows = np.arange(fold.decisions.start, fold.decisions.stop)
            here = made if self._patterns is None else self._patterns[0].at(rows, made)
            allowed.append((slice(rows[0] - first, rows[-1] + 1 - first), here))
        return kept(name, entry.decisions[0], entry.simulation.turnover[0], allowed)

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
