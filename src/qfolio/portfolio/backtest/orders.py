"""A baseline's orders over the folds of a test, row by row without look-ahead."""

import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Bools, Floats, numbers
from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.baselines.base import Baseline, Calendar, History
from qfolio.portfolio.backtest.folds import Fold, tested
from qfolio.portfolio.backtest.growth import Growth, filled_in
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel, Proportional, cashed
from qfolio.portfolio.execution import Terms
from qfolio.portfolio.mandate.feasible import Feasible, Mandated, exactly
from qfolio.portfolio.prices.findings import day

TOLERANCE = 1e-6
"""How far weights may be off the simplex or above the cap."""

AT_EVERY_ROW = Terms(np.zeros(0, bool), np.zeros(0))


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
            calendar "fold", it then decides anew where they have changed, too.
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
    decided = tested(folds)
    first = decided.start
    account = _Account(growth, terms, universe, first)
    asks, gives = _calendar(baseline, folds, len(prices), month, terms, universe)
    decisions, notes = np.full((decided.stop - first, prices.shape[1] + 1), np.nan), []
    wanted, entering = None, baseline.buys_once
    for number, fold in enumerate(folds):
        tradable = _tradable(baseline, fold, prices, universe)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for row in range(fold.decisions.start, fold.decisions.stop):
                if not (asks[row] or gives[row] or account.watched):
                    continue  # nothing can happen, as on most days of a monthly calendar
                held = account.held(row)
                called = terms.calls(held)
                # What is bought once is bought whole, before anything else is asked for.
                waits = baseline.buys_once and account.filling
                anew = asks[row] and not waits and (wanted is None or not entering)
                # A margin call asks for a new target, unless that of the fold stands.
                asked = anew or (called and baseline.calendar != "fold")
                due = (gives[row] and not waits) or called
                mandated = feasible(number, row) if feasible and (asked or due) else None
                if asked:
                    known = slice(0, row + 1)
                    open_to = holdable(tradable[row], mandated)
                    history = History(dates[known], prices[known], fold.train, open_to, cap, month)
                    wanted = ask(name, baseline, history, held, mandated)
                # A margin call must be met even if the baseline has no target.
                goal = held if called and wanted is None else wanted
                if entering and goal is not None and not asked:
                    goal = _topped_up(held, goal)
                order = None
                if due and goal is not None:
                    order = obeying(goal, held, account.within_turnover(mandated))
                    entering = entering and _cut(order, goal, held, mandated)
                decisions[row - first] = account.trade(row, held, order)
        said = dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught)
        notes += [f"{name}, fold {fold.name}: {note}" for note in said]
    return Orders(decisions, tuple(notes))


def _tradable(baseline: Baseline, fold: Fold, prices: Floats, universe: Bools | None) -> Bools:
    """The assets that a baseline may hold in a fold, were there no mandate, of shape (rows, N)."""
    priced = ~np.isnan(prices[fold.train]).any(axis=0)
    if universe is not None:
        return universe & (priced | (not baseline.estimates))
    if not priced.any():
        raise QfolioError(
            f"Fold {fold.name} has no asset with a price in all of its training rows; begin "
            "later or drop the assets that start late."
        )
    return np.tile(priced, (len(prices), 1))


def _calendar(
    baseline: Baseline,
    folds: Sequence[Fold],
    rows: int,
    month: int,
    terms: Terms,
    universe: Bools | None,
) -> tuple[Bools, Bools]:
    """At which rows a baseline is asked, and at which its last answer is an order, both (rows,)."""
    if baseline.calendar not in get_args(Calendar):
        raise QfolioError(
            f"calendar of {type(baseline).__name__} is {baseline.calendar!r}; it must be one of "
            f"{', '.join(get_args(Calendar))}."
        )
    gives = np.asarray(terms.decides) if len(terms.decides) else np.ones(rows, bool)
    if baseline.calendar == "month":
        gives = _monthly(gives, folds[0].decisions.start, month)
    if baseline.calendar != "fold":
        return gives, gives
    asks = np.zeros(rows, bool)
    asks[[fold.decisions.start for fold in folds]] = True
    if universe is not None:
        where = np.flatnonzero(asks | gives)
        asks[where[1:]] |= (universe[where[1:]] != universe[where[:-1]]).any(axis=1)
    return asks, gives


def _monthly(gives: Bools, first: int, month: int) -> Bools:
    """Those of some rows that are nearest to a month apart, from the first decision on."""
    rows = first + np.flatnonzero(gives[first:])
    apart = month - np.median(np.diff(rows)) / 2 if len(rows) > 1 else 0
    found, last = np.zeros(len(gives), bool), -np.inf
    for row in rows.tolist():
        if row - last >= apart:
            found[row], last = True, row
    return found


class _Account:
    """The weights that a baseline holds; it is all in cash at its first row."""

    def __init__(self, growth: Growth, terms: Terms, universe: Bools | None, first: int) -> None:
        self.growth, self.terms, self.universe = growth, terms, universe
        self.weights, self.row = np.eye(growth.prices.shape[1] + 1)[0], first  # of the last trade
        self.plan = terms.begin(self.weights)

    @property
    def filling(self) -> bool:
        """Whether a part of an order is still to be filled."""
        return self.plan is not None and bool(self.plan.left > 0)

    @property
    def watched(self) -> bool:
        """Whether it may trade at any row, for a lender or by a plan."""
        return self.plan is not None or self.terms.called < np.inf

    def held(self, row: int) -> Floats:
        """The weights at a row before it trades."""
        return self.growth.held(self.weights, self.row, row)

    def within_turnover(self, mandated: Feasible | None) -> Feasible | None:
        """What a mandate allows with the turnover that is left this year."""
        return mandated and mandated.spending(self.terms.unspent(self.plan))

    def trade(self, row: int, held: Floats, order: Floats | None) -> Floats:
        """The weights after a row's trade; NaN if there is none."""
        given = order is not None and self.terms.beyond(held, order)
        goal = held if order is None else order
        target, self.plan = self.terms.trade(held, goal, given, self.plan)
        traded = given or (target != held).any()
        if traded:
            self.weights, self.row = target, row
        if self.plan is not None and row + 1 < len(self.growth.prices):
            coming = self.growth.held(self.plan.order, row, row + 1)
            if self.universe is not None:
                coming = cashed(coming, self.universe[row + 1])
            self.plan = self.terms.next_row(row, self.plan, coming)
        return target if traded else np.full_like(held, np.nan)


def holdable(tradable: Bools, mandated: Feasible | None) -> Bools:
    """Those of the tradable assets of which a mandate, if there is one, allows a weight above 0."""
    return tradable & mandated.buyable if isinstance(mandated, Mandated) else tradable


def ask(
    name: str, baseline: Baseline, history: History, held: Floats, mandated: Feasible | None
) -> Floats | None:
    """A baseline's target weights before a mandate, if there is one, is applied; None for no order.

    All cash if it may hold no asset. Raises QfolioError if the weights are invalid.
    """
    if not history.tradable.any():
        return np.eye(len(held))[0]
    wanted = baseline.decide(history, held)
    if wanted is None:
        return None
    return checked(name, wanted, history if mandated is None else history._replace(cap=np.inf))


def obeying(wanted: Floats, held: Floats, mandated: Feasible | None) -> Floats:
    """Target weights, projected onto what a mandate allows, if there is one."""
    return wanted if mandated is None else exactly(mandated, wanted, held)


def _topped_up(held: Floats, wanted: Floats) -> Floats:
    """What is held, with idle cash invested in what is held less than wanted; nothing is sold."""
    lacking = np.maximum(wanted - held, 0.0)[1:]
    idle = max(held[0] - wanted[0], 0.0)
    if not lacking.any():
        return held
    bought = idle * lacking / lacking.sum()
    return held + np.append(-bought.sum(), bought)


def _cut(order: Floats, wanted: Floats, held: Floats, mandated: Feasible | None) -> bool:
    """Whether a mandate's limit on turnover has cut an order."""
    if not isinstance(mandated, Mandated):
        return False
    whole = obeying(wanted, held, mandated.at_once)
    return bool(abs(order - whole).max() > TOLERANCE)


def checked(name: str, wanted: ArrayLike, history: History) -> Floats:
    """A baseline's target weights; raises QfolioError if they are invalid."""
    target = numbers(f"decide of the baseline {name}", wanted)
    where = f"The baseline {name} at {day(history.dates[-1])}"
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
        raise QfolioError(
            f"{where} gives weight to an asset that this fold may not hold; its decide must heed "
            "history.tradable."
        )
    if target[1:].max() > history.cap + TOLERANCE:
        raise QfolioError(
            f"{where} gives an asset {target[1:].max():.4g}, more than the cap of {history.cap:g}; "
            "its decide must heed history.cap."
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
