"""Replay of decisions on real prices, in double precision, with exact costs.

The rule of timing: a decision at row t sees prices up to row t and sets target weights at the
prices of row t. This is an order in shares, scaled to the wealth. It is executed at the close of
row t + lag, after prices have moved both the holding and the order, and the cost of that trade is
charged to the return of row t + lag + 1.

An account whose debts exceed what it owns is wiped out: its return is −1, and 0 from then on. The
same holds if the debts of its order exceed what the order buys by the time of the trade.
"""

import operator
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.growth import Growth, Rows, filled_in
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import (
    Context,
    CostModel,
    Proportional,
    by_sign,
    cashed,
    traded,
    with_cash,
)

TOLERANCE = 1e-6
"""How far weights may be off the simplex; within it they are projected back."""

ROUNDS = 100
"""Most repetitions until costs and the wealth that they depend on agree."""

MOST = 1 - 1e-6
"""Largest cost of a trade, as a share of wealth, even if its fees exceed the wealth."""

BLOCK = 60_000
"""Numbers per array in a block: several such arrays fit into a core's cache."""


@dataclass(frozen=True)
class Simulation:
    """The result of D decisions; every array begins with the decisions' leading axes."""

    returns: Floats
    """Net returns, of shape (..., D)."""

    turnover: Floats
    """Value bought plus value sold, over the wealth before the trade, of shape (..., D)."""

    cost: Floats
    """Share of the wealth that the trade cost, of shape (..., D)."""

    weights: Floats
    """Weights right after the trade, cash first, of shape (..., D, N + 1)."""

    costs: dict[str, Floats] = field(default_factory=dict)
    """``cost`` by kind, each of shape (..., D)."""

    financing: Floats | None = None
    """Share of the wealth after the trade that interest, fees and carry earned until the next one,
    negative if they cost, of shape (..., D); None if the cost model has none."""

    @property
    def ruined(self) -> Bools:
        """Whether an account was wiped out, of shape (...)."""
        return np.asarray((self.returns <= -1).any(-1))

    @cached_property
    def growth(self) -> Floats:
        """Net log growth, of shape (..., D); minus infinity where an account is wiped out."""
        with np.errstate(divide="ignore"):
            return np.log1p(self.returns)

    @cached_property
    def wealth(self) -> Floats:
        """Wealth at the start, which is 1, and after each return, of shape (..., D + 1)."""
        start = np.ones_like(self.returns, shape=(*self.returns.shape[:-1], 1))
        return np.cumprod(np.concatenate([start, 1 + self.returns], axis=-1), axis=-1)


def simulate(
    values: ArrayLike,
    decisions: ArrayLike,
    *,
    first: int,
    cost: float | CostModel,
    lag: int = 1,
    start: ArrayLike | None = None,
    conditions: Conditions | None = None,
    long_only: bool = True,
    wealth: float = 1.0,
) -> Simulation:
    """Replay decisions made at the rows first, first + 1, …; each earns one return.

    Args:
        values: Prices of shape (rows, N), positive; NaN before an asset's first price.
        decisions: Target weights of shape (..., D, N + 1), cash first, for D rows in succession;
            a row of NaN gives no order.
        first: Row of the first decision.
        cost: One-way trading cost, as a fraction of the value traded, 0 ≤ cost < 1; or a model
            of the costs of trading and holding.
        lag: Rows between a decision and its trade, 0 or more.
        start: Weights held at row ``first``, of shape (N + 1,) or (..., N + 1) (default: all cash).
        conditions: The columns of the table that the cost model reads, at the rows of ``values``,
            and which assets are listed: at a trade, holdings of others are cash.
        long_only: Whether negative weights are refused.
        wealth: Wealth before the first trade, as a multiple of the initial one that costs in money
            refer to.

    Returns:
        The returns of rows first + lag + 1 to first + lag + D, and the trades before them.

    Raises:
        QfolioError: There are too few rows, cost or lag is out of range, a price is not positive
            or missing after an asset's start, or weights do not sum to 1, are negative though
            long-only (both by more than 1e-6), or held before the asset's first price.
    """
    prices, begun = filled_in(values)
    orders = np.asarray(decisions, dtype=float)
    first, lag = operator.index(first), operator.index(lag)
    rows, assets = prices.shape
    if orders.ndim < 2 or orders.shape[-1] != assets + 1:
        raise QfolioError(
            f"Decisions have the shape {orders.shape}; for {assets} assets it must be "
            f"(…, days, {assets + 1}), cash first."
        )
    *leading, days, entries = orders.shape
    if isinstance(cost, float | int):
        if not 0 <= cost < 1:
            raise QfolioError(f"The cost is {cost}; it must be a fraction, at least 0 and below 1.")
        cost = Proportional(float(cost))
    if lag < 0 or first < 0:
        raise QfolioError(f"Lag and first row are {lag} and {first}; both must be at least 0.")
    if first + lag + days >= rows:
        raise QfolioError(
            f"{days} decisions from row {first} with a lag of {lag} need prices up to row "
            f"{first + lag + days}, but row {rows - 1} is the last; decide for fewer days."
        )
    held = np.eye(entries)[0] if start is None else np.asarray(start, dtype=float)
    try:
        held = np.broadcast_to(held, (*leading, entries))
    except ValueError:
        raise QfolioError(
            f"The start weights have the shape {held.shape}; for {assets} assets it must "
            f"be {(entries,)} or {(*leading, entries)}, cash first."
        ) from None

    if conditions is None:
        if cost.columns:
            read = ", ".join(cost.columns)
            raise QfolioError(f"{type(cost).__name__} reads {read}; give the table's conditions.")
        conditions = Conditions(np.empty(0), {}, {})
    shown = prices[first : first + lag + days + 1]
    orders, held = orders.reshape(-1, days, entries), held.reshape(-1, entries)
    market = _Market(shown, begun[first:], first, lag, cost, conditions, long_only)
    returns, turnover, paid = (np.empty(orders.shape[:2]) for _ in range(3))
    financing = None if market.income is None else np.empty(orders.shape[:2])
    result = Simulation(returns, turnover, paid, np.empty(orders.shape), {}, financing)
    # glibc returns large freed arrays to the system, which is slower than the arithmetic on them,
    # unless a larger array has been freed before.
    np.empty(2**21)
    columns = max(1, BLOCK // entries)
    together = max(1, columns // max(1, days))
    for low in range(0, len(orders), together):
        some = slice(low, low + together)
        _replay(market, orders, held, wealth, columns, result, some)
    shaped = lambda array: array.reshape(*leading, *array.shape[1:])  # noqa: E731
    return Simulation(
        shaped(returns),
        shaped(turnover),
        shaped(paid),
        shaped(result.weights),
        {kind: shaped(array) for kind, array in result.costs.items()},
        None if financing is None else shaped(financing),
    )


class _Market:
    """The prices from the first decision to the last return, the cost model and its columns.

    Growth factors of cash and assets have the entries as first axis, also in memory: numpy then
    sums a few long rows instead of many short ones. Those of what is owned come before those of
    what is owed; there is only the first if they are the same.
    """

    def __init__(
        self,
        prices: Floats,
        begun: Bools,
        first: int,
        lag: int,
        costs: CostModel,
        conditions: Conditions,
        long_only: bool,
    ) -> None:
        self.prices, self.costs, self.conditions = prices, costs, conditions
        self.listed = conditions.listed  # at all rows of the table
        self.growth = Growth(prices, costs, conditions, first)
        self.begun = None if begun.all() else np.insert(begun, 0, True, axis=1)
        self.first, self.lag, self.long_only = first, lag, long_only
        self.days = len(prices) - lag - 1
        day = np.arange(self.days)
        columns = lambda growth: growth.T.copy()[:, None]  # noqa: E731
        self.to_trade = [columns(x) for x in self.moved(day, day)]
        self.after_trade = [columns(x) for x in self.growth.between(day + lag, day + lag + 1)]
        plain = columns(with_cash(prices[day + lag + 1] / prices[day + lag]))
        income = [growth - plain for growth in self.after_trade]
        self.income = income if any(x.any() for x in income) else None

    def moved(self, decided: Rows, trade: Rows) -> list[Floats]:
        """Growth from days of decisions to the trades of later days' decisions, cash first."""
        return self.growth.between(decided, trade + self.lag)

    def cashed(self, weights: Floats, days: slice) -> Floats:
        """Weights at the trades of some days, of shape (S, days, N + 1), after cash-outs."""
        if self.listed is None:
            return weights
        begin = self.first + self.lag
        return np.asarray(cashed(weights, self.listed[begin + days.start : begin + days.stop]))

    def trades(self, days: slice, wealth: Floats) -> Context:
        """The circumstances of the trades of some days."""
        begin = self.first + self.lag
        rows = slice(begin + days.start, begin + days.stop)
        return self.conditions.trade(rows, self.lag, wealth)


def _replay(
    market: _Market,
    orders: Floats,
    held: Floats,
    begun: float,
    columns: int,
    result: Simulation,
    some: slice,
) -> None:
    """Computes the result of some orders of shape (S, D, N + 1), a few days at a time.

    Arrays in here have the shape (N + 1, S, days). Between trades, weights times relatives give
    values, which are normalized only by their sums.
    """
    orders, held = orders[some], held[some]
    start, given = _checked(market, held[:, None], 0)
    if not given.all():
        raise QfolioError("The start weights are NaN; give weights that sum to 1, or none at all.")
    start = start[..., 0].T
    # The value of the holding's entries at the next trade.
    worth = start * by_sign(start, market.moved(np.array(0), np.array(0)))
    latest = np.full((len(orders), 1), -1)  # day of the last order
    wealth, ruined = np.full((len(orders), 1), begun), np.zeros((len(orders), 1), bool)
    for low in range(0, market.days, columns):
        now = slice(low, min(low + columns, market.days))
        after, given = _checked(market, orders[:, now], low)
        after *= by_sign(after, [growth[..., now] for growth in market.to_trade])
        day = np.where(given, np.arange(now.start, now.stop), -1)
        day = np.maximum(np.maximum.accumulate(day, axis=1), latest)
        latest = day[:, -1:]
        if not given.all():
            who, when = np.nonzero(~given)
            source = day[who, when]
            ordered = orders[who, source]
            if market.long_only:
                ordered = np.maximum(ordered, 0)
            wanted = np.where(source[:, None] < 0, start[who], ordered)
            moved = market.moved(np.maximum(source, 0), when + low)
            after[:, who, when] = (wanted * by_sign(wanted, moved)).T
        broke = False if market.long_only else _settled(after)
        after /= after.sum(0)

        growing = by_sign(after, [growth[..., now] for growth in market.after_trade])
        grown = np.concatenate([worth.T[..., None], after * growing], axis=-1)
        worth = grown[..., -1].T
        lost = False if market.long_only else _settled(grown)[:, 1:]
        growth = grown.sum(0)
        before = grown[..., :-1] / growth[:, :-1]

        before, after = (market.cashed(np.moveaxis(x, 0, -1), now) for x in (before, after))
        remainder, costs, wealth = _traded(market, before, after, given, growth[:, 1:], wealth, now)
        here = some, now
        result.returns[here] = remainder * growth[:, 1:] - 1
        result.turnover[here] = np.where(given, traded(before, after, remainder), 0)
        total = sum(costs.values())
        charged = given * MOST / np.maximum(total, MOST)
        result.cost[here] = charged * total
        result.weights[here] = after
        for kind, paid in costs.items():
            of_kind = result.costs.setdefault(kind, np.zeros_like(result.cost))
            of_kind[here] = charged * paid
        if result.financing is not None and market.income is not None:
            entries = np.moveaxis(after, -1, 0)
            income = by_sign(entries, [rate[..., now] for rate in market.income])
            result.financing[here] = (entries * income).sum(0)
        lost = broke | lost | (remainder <= 0)
        if lost.any() or ruined.any():
            ruined = _stop(result, here, lost, ruined)


def _traded(
    market: _Market,
    before: Floats,
    after: Floats,
    given: Bools,
    growth: Floats,
    wealth: Floats,
    now: slice,
) -> tuple[Floats, Mapping[str, Floats], Floats]:
    """Remainder factors and costs of some days, and the wealth after them, of shape (S, 1).

    A trade's costs may depend on the wealth, which earlier trades' costs have lowered. Starting
    from no costs, each repetition settles at least one more day; in practice, few are needed.
    """
    remainder = np.ones(given.shape)
    for _ in range(ROUNDS if market.costs.depends_on_wealth else 1):
        before_trades = (remainder * growth)[:, :-1].cumprod(1)
        paths = wealth * np.concatenate([np.ones_like(wealth), before_trades], axis=1)
        last = remainder
        remainder, costs = market.costs.trade(before, after, market.trades(now, paths))
        remainder = np.where(given, remainder, 1)
        if np.array_equal(last, remainder):
            break
    return remainder, costs, wealth * np.prod(remainder * growth, axis=1, keepdims=True)


def _settled(worth: Floats) -> Bools:
    """Whether debts exceed what is owned, of shape (S, days); such accounts then hold cash."""
    broke = worth.sum(0) <= 0
    if broke.any():
        worth[:, broke] = np.eye(len(worth))[:, :1]
    return np.asarray(broke)


def _stop(result: Simulation, here: tuple[slice, slice], lost: Bools, ruined: Bools) -> Bools:
    """Ends the accounts that are wiped out, or were before; returns which, of shape (S, 1)."""
    before = np.maximum.accumulate(np.concatenate([ruined, lost[:, :-1]], axis=1), axis=1)
    over = before | lost
    series = [result.turnover, result.cost, *result.costs.values()]
    for array in (*series, *([] if result.financing is None else [result.financing])):
        array[here] = np.where(before, 0, array[here])
    result.returns[here] = np.where(before, 0, np.where(lost, -1, result.returns[here]))
    cash = np.eye(result.weights.shape[-1])[0]
    result.weights[here] = np.where(before[..., None], cash, result.weights[here])
    return over[:, -1:]


def _checked(market: _Market, weights: Floats, day: int) -> tuple[Floats, Bools]:
    """Checks weights of shape (S, days, N + 1) from a day on.

    Returns them with the assets as first axis, and whether they are given, of shape (S, days).
    """
    columns = np.moveaxis(weights, -1, 0).copy()
    total, least = columns.sum(0), columns.min(0)
    given = ~np.isnan(total)
    fits = abs(total - 1) <= TOLERANCE
    if market.long_only:
        fits &= least >= -TOLERANCE
    if not fits.all():
        fits |= np.isnan(columns).all(0)
        if not fits.all():
            who, when = np.argwhere(~fits)[0]
            positive = " and not be negative" if market.long_only else ""
            raise QfolioError(
                f"Weights at row {market.first + day + when} sum to {total[who, when]:.8g}, with a "
                f"minimum of {least[who, when]:.3g}; they must sum to 1{positive} (or all be NaN, "
                "which gives no order)."
            )
    if market.long_only and (least < 0).any():
        np.maximum(columns, 0, out=columns)
    if market.begun is not None:
        begun = market.begun[day : day + columns.shape[-1]].T[:, None]
        early = (columns != 0) & ~begun & given
        if early.any():
            asset, _, when = np.argwhere(early)[0]
            raise QfolioError(
                f"Weights at row {market.first + day + when} hold asset {asset - 1} (counted from "
                "0) before its first price; give it weight 0 until then."
            )
    return columns, given
