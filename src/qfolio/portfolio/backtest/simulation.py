"""Replay of decisions on real prices, in double precision, with exact costs.

The rule of timing: a decision at row t sees prices up to row t and sets target weights at the
prices of row t. This is an order in shares, scaled to the wealth. It is executed at the close of
row t + lag, after prices have moved both the holding and the order, and the cost of that trade is
charged to the return of row t + lag + 1.
"""

import operator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.errors import QfolioError
from qfolio.portfolio.costs import Context, CostModel, Proportional, traded

TOLERANCE = 1e-6
"""How far weights may be off the simplex; within it they are projected back."""

BLOCK = 60_000
"""Numbers per array in a block: several such arrays fit into a core's cache."""

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rows = NDArray[np.intp] | np.intp


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

    @cached_property
    def growth(self) -> Floats:
        """Net log growth, of shape (..., D)."""
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

    Returns:
        The returns of rows first + lag + 1 to first + lag + D, and the trades before them.

    Raises:
        QfolioError: There are too few rows, cost or lag is out of range, a price is not positive
            or missing after an asset's start, or weights are off the simplex by more than 1e-6 or
            positive before the asset's first price.
    """
    prices, begun = _prices(values)
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

    shown = prices[first : first + lag + days + 1]
    market = _Market(shown, begun[first:], first, days, lag, cost)
    orders, held = orders.reshape(-1, days, entries), held.reshape(-1, entries)
    result = [*(np.empty(orders.shape[:2]) for _ in range(3)), np.empty(orders.shape)]
    # glibc returns large freed arrays to the system, which is slower than the arithmetic on them,
    # unless a larger array has been freed before.
    np.empty(2**21)
    columns = max(1, BLOCK // entries)
    together = max(1, columns // max(1, days))
    for low in range(0, len(orders), together):
        some = slice(low, low + together)
        part = [array[some] for array in result]
        _replay(market, orders[some], held[some], columns, part)
    return Simulation(*(array.reshape(*leading, *array.shape[1:]) for array in result))


class _Market:
    """The prices from the first decision to the last return, and the cost model.

    Growth factors of cash and assets have the entries as first axis, also in memory: numpy then
    sums a few long rows instead of many short ones.
    """

    def __init__(
        self, prices: Floats, begun: Bools, first: int, days: int, lag: int, costs: CostModel
    ) -> None:
        self.prices, self.costs = prices, costs
        self.begun = None if begun.all() else np.insert(begun, 0, True, axis=1)
        self.first, self.days, self.lag = first, days, lag
        day = np.arange(days)
        to_trade, after_trade = self.moved(day, day), self.grown(day + lag, day + lag + 1)
        self.to_trade, self.after_trade = (r.T.copy()[:, None] for r in (to_trade, after_trade))

    def moved(self, decided: Rows, trade: Rows) -> Floats:
        """Growth from days of decisions to the trades of later days' decisions, cash first."""
        return self.grown(decided, trade + self.lag)

    def grown(self, start: Rows, end: Rows) -> Floats:
        """Growth factors of each entry from one row to another."""
        relatives = self.prices[end] / self.prices[start]
        return np.asarray(self.costs.carry(relatives, Context(rows=end - start)))


def _replay(
    market: _Market,
    orders: Floats,
    held: Floats,
    columns: int,
    result: list[Floats],
) -> None:
    """Computes the result of orders of shape (S, D, N + 1), some days at a time.

    Arrays in here have the shape (N + 1, S, days). Between trades, weights times relatives give
    values, which are normalised only by their sums.
    """
    returns, turnover, paid, weights = result
    start, given = _on_simplex(market, held[:, None], 0)
    if not given.all():
        raise QfolioError("The start weights are NaN; give weights that sum to 1, or none at all.")
    start = start[..., 0].T
    worth = (start * market.moved(np.array(0), np.array(0))).T  # of the holding at the next trade
    latest = np.full((len(orders), 1), -1)  # day of the last order
    for low in range(0, market.days, columns):
        now = slice(low, min(low + columns, market.days))
        after, given = _on_simplex(market, orders[:, now], low)
        after *= market.to_trade[..., now]
        day = np.where(given, np.arange(now.start, now.stop), -1)
        day = np.maximum(np.maximum.accumulate(day, axis=1), latest)
        latest = day[:, -1:]
        if not given.all():
            who, when = np.nonzero(~given)
            source = day[who, when]
            ordered = np.maximum(orders[who, source], 0)
            wanted = np.where(source[:, None] < 0, start[who], ordered)
            after[:, who, when] = (wanted * market.moved(np.maximum(source, 0), when + low)).T
        after /= after.sum(0)

        grown = np.concatenate([worth[..., None], after * market.after_trade[..., now]], axis=-1)
        worth = grown[..., -1]
        growth = grown.sum(0)
        before = grown[..., :-1] / growth[:, :-1]

        before, after = np.moveaxis(before, 0, -1), np.moveaxis(after, 0, -1)
        trade = Context(rows=market.lag)
        remainder, costs = market.costs.trade(before, after, trade)
        remainder = np.where(given, remainder, 1)
        returns[:, now] = remainder * growth[:, 1:] - 1
        turnover[:, now] = np.where(given, traded(before, after, remainder), 0)
        paid[:, now] = np.where(given, sum(costs.values()), 0)
        weights[:, now] = after


def _on_simplex(market: _Market, weights: Floats, day: int) -> tuple[Floats, Bools]:
    """Checks weights of shape (S, days, N + 1) from a day on.

    Returns them with the assets as first axis, and whether they are given, of shape (S, days).
    """
    columns = np.moveaxis(weights, -1, 0).copy()
    total, least = columns.sum(0), columns.min(0)
    given = ~np.isnan(total)
    fits = (abs(total - 1) <= TOLERANCE) & (least >= -TOLERANCE)
    if not fits.all():
        fits |= np.isnan(columns).all(0)
        if not fits.all():
            who, when = np.argwhere(~fits)[0]
            raise QfolioError(
                f"Weights at row {market.first + day + when} sum to {total[who, when]:.8g}, with a "
                f"minimum of {least[who, when]:.3g}; they must sum to 1 and not be negative "
                "(or all be NaN, which gives no order)."
            )
    if (least < 0).any():
        np.maximum(columns, 0, out=columns)
    if market.begun is not None:
        begun = market.begun[day : day + columns.shape[-1]].T[:, None]
        early = (columns > 0) & ~begun
        if early.any():
            asset, _, when = np.argwhere(early)[0]
            raise QfolioError(
                f"Weights at row {market.first + day + when} hold asset {asset - 1} (counted from "
                "0) before its first price; give it weight 0 until then."
            )
    return columns, given


def _prices(values: ArrayLike) -> tuple[Floats, Bools]:
    """Checked prices, with each asset's first price filled in before its start, and a mask."""
    prices = np.asarray(values, dtype=float)
    if prices.ndim != 2:
        raise QfolioError(f"Prices have the shape {prices.shape}; it must be (rows, assets).")
    begun = ~np.isnan(prices)
    fits = (prices > 0) & (prices < np.inf)
    if not fits.all():
        wrong = (begun & ~fits) | (np.maximum.accumulate(begun) & ~begun)
        if wrong.any():
            row, asset = np.argwhere(wrong)[0]
            raise QfolioError(
                f"The price of asset {asset} (counted from 0) at row {row} is "
                f"{prices[row, asset]:g}; from its first price on all must be positive and finite."
            )
        starts = prices[begun.argmax(0), np.arange(prices.shape[1])]
        prices = np.where(begun, prices, np.where(begun.any(0), starts, 1))
    return prices, begun
