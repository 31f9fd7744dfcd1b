"""A baseline's orders over the folds of a test, row by row without look-ahead."""

import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.baselines.base import Baseline, Bools, Floats, History
from qfolio.portfolio.backtest.growth import Growth, filled_in
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel, Proportional, cashed
from qfolio.portfolio.execution import Terms
from qfolio.portfolio.mandate.feasible import Feasible, Mandated, exactly

TOLERANCE = 1e-6
"""How far weights may be off the simplex or above the cap."""

AT_EVERY_ROW = Terms(np.zeros(0, bool), np.zeros(0))


@runtime_checkable
class Fold(Protocol):
    """Rows of the price table: where to learn and where to decide."""

    @property
    def name(self) -> str: ...
    @property
    def train(self) -> slice: ...
    @property
    def decisions(self) -> slice: ...


class Orders(NamedTuple):
    """Decisions of shape (D, N + 1), cash first, NaN for no order, and notes.

    Notes are sentences for the report about problems in the decisions.
    """

    decisions: Floats
    notes: tuple[str, ...]


def orders(
    name: str,
    baseline: Baseline,
    folds: Sequence[Fold],
    dates: NDArray[np.datetime64],
    values: ArrayLike,
    *,
    cap: float = 1.0,
    feasible: Callable[[int, int], Feasible] | None = None,
    month: int = 21,
    terms: Terms = AT_EVERY_ROW,
    universe: Bools | None = None,
    costs: CostModel | None = None,
    conditions: Conditions | None = None,
) -> Orders:
    """Ask a baseline for its decisions on every row of the folds.

    Args:
        name: The baseline's name in notes and errors.
        baseline: The baseline; it sees only the rows up to each decision.
        folds: Folds whose decisions follow one another without gaps, in order of time. The
            training rows of a fold end with the row of its first decision or earlier.
        dates: Dates of the rows, shape (rows,).
        values: Prices of shape (rows, N); NaN before an asset's first price.
        cap: Largest weight of one asset when it is ordered.
        feasible: The weights that a mandate allows, given the number of a fold and a row. Every
            target is projected onto them; with the calendar "fold", there is one at every row.
            Assets of which it allows no weight above 0 may not be held.
        month: Rows in a month.
        terms: When orders are given and how they are filled, in numpy; its rows for decisions
            replace the baseline's calendar.
        universe: Which assets may be bought at each row, of shape (rows, N), if they come and go
            (default: those with prices in all of the fold's training rows). A baseline that
            estimates may hold only those of them with prices in all of these rows. With the
            calendar "fold", it then decides at every row.
        costs: What holding costs and earns (default: nothing), as in the replay, so that a margin
            call or a band comes at the same row for baselines as for agents.
        conditions: What the costs read at each row, and which assets are listed; holdings of
            delisted assets become cash.

    Returns:
        Decisions for all rows of the folds, and notes that name the fold.

    Raises:
        QfolioError: The folds have a gap or look ahead, no asset has a price in all training rows
            of a fold, or the baseline returns weights that are off the simplex, above the cap or in
            an asset that may not be held.
    """
    prices = np.array(values, dtype=float)
    prices.flags.writeable = False  # shared by all baselines
    _check(folds)
    conditions = Conditions(np.empty(0), {}, {}) if conditions is None else conditions
    growth = Growth(filled_in(prices)[0], costs or Proportional(), conditions)
    limited = lru_cache(1)(feasible) if feasible is not None else lambda *_: None
    nothing = np.eye(prices.shape[1] + 1)[0]
    last, row_last, plan = nothing, folds[0].decisions.start, terms.begin(nothing)
    watched = plan is not None or terms.called < np.inf
    parts, notes = [], []
    for number, fold in enumerate(folds):
        priced = ~np.isnan(prices[fold.train]).any(axis=0)
        if universe is None and not priced.any():
            raise QfolioError(
                f"Fold {fold.name} has no asset with a price in all of its training rows; begin "
                "later or drop the assets that start late."
            )
        allowed = priced if universe is None else universe & (priced | (not baseline.estimates))
        rows = range(len(prices))[fold.decisions]
        decides = terms.decides if len(terms.decides) else None
        asked = set(_asked(baseline, rows, folds[0].decisions.start, month, decides))
        trading = np.ones(len(rows), bool) if decides is None else decides[fold.decisions]
        stands = baseline.calendar == "fold"  # its target holds for every row
        each = universe is not None and stands
        asked |= {row for row in rows if each and (decides is None or decides[row])}
        again = stands and (feasible is not None or terms.band > 0)
        part = np.full((len(rows), len(last)), np.nan)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for row in rows if again or watched else sorted(asked):
                held = growth.held(last, row_last, row)
                called = terms.calls(held)
                if row in asked or (called and not stands):
                    known = slice(0, row + 1)
                    mandated = limited(number, row)
                    open_to = holdable(allowed if universe is None else allowed[row], mandated)
                    history = History(dates[known], prices[known], fold.train, open_to, cap, month)
                    wanted = baseline.decide(history, held) if open_to.any() else nothing
                elif not stands:
                    wanted = None
                due = trading[row - rows[0]] or called or not (again or watched or each)
                order, given = held, False
                if called or (wanted is not None and due):
                    mandated = limited(number, row)
                    left = terms.unspent(plan)
                    if left is not None and isinstance(mandated, Mandated):
                        mandated = mandated.spending(left)
                    if wanted is not None:
                        order = obeying(name, wanted, held, history, mandated)
                    elif mandated is not None:  # a lender does not wait for the baseline
                        order = exactly(mandated, held, held)
                    given = terms.beyond(held, order)
                target, plan = terms.trade(held, order, given, plan)
                if given or (target != held).any():
                    last, row_last = target, row
                    part[row - rows[0]] = target
                if plan is not None and row + 1 < len(prices):
                    coming = growth.held(plan.order, row, row + 1)
                    coming = coming if universe is None else cashed(coming, universe[row + 1])
                    plan = terms.next_row(row, plan, coming)
        if stands and not (again or watched or each or np.isnan(part[0]).any()):
            part[:] = np.where(trading[:, None], part[0], np.nan)
            row_last = rows[np.flatnonzero(trading)[-1]] if trading.any() else row_last
        said = dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught)
        notes += [f"{name}, fold {fold.name}: {note}" for note in said]
        parts.append(part)
    return Orders(np.concatenate(parts), tuple(notes))


def _asked(
    baseline: Baseline, rows: range, first: int, month: int, decides: Bools | None
) -> Sequence[int]:
    """The rows of a fold at which a baseline decides; months count from the first of the test."""
    if baseline.calendar == "fold":
        return rows[:1]
    if decides is not None:
        return [row for row in rows if decides[row]]
    return rows[(first - rows[0]) % month :: month] if baseline.calendar == "month" else rows


def holdable(tradable: Bools, mandated: Feasible | None) -> Bools:
    """Those of the tradable assets of which a mandate, if there is one, allows a weight above 0."""
    if not isinstance(mandated, Mandated):
        return tradable
    return tradable & (np.asarray(mandated.limits.high) > 0)


def obeying(
    name: str, wanted: ArrayLike, held: Floats, history: History, mandated: Feasible | None
) -> Floats:
    """A baseline's target weights, projected onto what a mandate allows, if there is one.

    Raises QfolioError if they are invalid.
    """
    if mandated is None:
        return checked(name, wanted, history)
    return exactly(mandated, checked(name, wanted, history._replace(cap=np.inf)), held)


def checked(name: str, wanted: ArrayLike, history: History) -> Floats:
    """A baseline's target weights; raises QfolioError if they are invalid."""
    target = np.asarray(wanted, dtype=float)
    where = f"The baseline {name} at {str(history.dates[-1])[:10]}"
    if target.shape != (len(history.tradable) + 1,):
        raise QfolioError(
            f"{where} gives weights of the shape {target.shape}; it must be "
            f"({len(history.tradable) + 1},), cash first."
        )
    if not abs(target.sum() - 1) <= TOLERANCE or target.min() < -TOLERANCE:
        raise QfolioError(
            f"{where} gives weights that sum to {target.sum():.8g}, with a minimum of "
            f"{target.min():.3g}; they must sum to 1 and not be negative."
        )
    if (target[1:][~history.tradable] > 0).any():
        raise QfolioError(f"{where} gives weight to an asset that this fold may not hold.")
    if target[1:].max() > history.cap + TOLERANCE:
        raise QfolioError(
            f"{where} gives an asset {target[1:].max():.4g}, more than the cap of {history.cap:g}."
        )
    return target


def _check(folds: Sequence[Fold]) -> None:
    if not folds:
        raise QfolioError("There is no fold to decide for; the prices are too few.")
    for fold in folds:
        if fold.train.stop > fold.decisions.start + 1:
            raise QfolioError(
                f"Fold {fold.name} trains on rows up to {fold.train.stop - 1}, but decides from "
                f"row {fold.decisions.start} on; end its training there or earlier."
            )
    for one, following in pairwise(folds):
        if one.decisions.stop != following.decisions.start:
            raise QfolioError(
                f"Fold {following.name} decides from row {following.decisions.start} on, but fold "
                f"{one.name} before row {one.decisions.stop}; leave no gap between them."
            )
