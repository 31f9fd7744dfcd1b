"""Strategies of the user's own: their orders and returns on the days of a test.

``own_tables.py`` reads them from files and data frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Bools, Floats
from qfolio.core.errors import QfolioError
from qfolio.core.text import amount
from qfolio.portfolio.backtest.folds import spell
from qfolio.portfolio.backtest.growth import Growth, filled_in
from qfolio.portfolio.backtest.orders import TOLERANCE
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.mandate.feasible import TURNOVER_OF_YEAR, Mandated
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.frequency import one_a_day
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

Kind = Literal["weights", "returns", "levels"]
KINDS: tuple[Kind, ...] = get_args(Kind)

PERCENT = 100.0
"""What weights sum to if they are percentages."""

OLDEST = np.timedelta64(7, "D")
"""How long a level is carried forward to later rows, which bridges holidays of other exchanges."""
OFTEN = 0.8
"""The share of rows with a new level below which a note says that there are few of them."""

Dates = NDArray[np.datetime64]
Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Own:
    """A strategy as it was given.

    kind: "weights": targets at the close of a date, executed with the backtest's lag and costs,
        with no orders in between. "returns": net returns. "levels": those of an index.
    dates: increasing, of shape (k,).
    values: of shape (k, N + 1) for weights, cash first; otherwise of shape (k,).
    """

    kind: Kind
    dates: Dates
    values: Floats


@dataclass(frozen=True)
class Placed:
    """A strategy on the days of a test, with sentences for the report.

    decisions: (D, N + 1), cash first, NaN for no order. returns: (D,); None if it has weights.
    """

    decisions: Floats
    returns: Floats | None
    notes: tuple[str, ...]


def buy_and_hold(asset: str, prices: Prices) -> Own:
    """One asset, bought at its first price and never sold."""
    place = prices.assets.index(asset)
    weights = np.zeros((1, len(prices.assets) + 1))
    weights[0, place + 1] = 1.0
    return Own("weights", prices.dates[[prices.first_rows[place]]], weights)


def place(name: str, own: Own, prices: Prices, days: slice, task: Portfolio, cap: float) -> Placed:
    """Put a strategy on the days of a test.

    A date without a row of prices counts at the next row, so that nothing is known too early.
    Before its first order a strategy holds cash. If it has an order before the test, the test
    begins with an order for the weights that this has drifted to.

    Args:
        name: Name of the strategy, for messages.
        own: The strategy.
        prices: The table of the backtest.
        days: Rows of the test's decisions.
        task: The task of any agent: all have the same lag, and all or none are long-only.
        cap: Largest weight of one asset that agents may order; a note says where it is exceeded.

    Raises:
        QfolioError: There is no order in the test or before it, an asset is ordered before its
            first price or sold short though agents are long-only, a day of the test has no return
            or no level, or a return is on another day.
    """
    none = np.full((days.stop - days.start, len(prices.assets) + 1), np.nan)
    if own.kind == "weights":
        if task.feasible.long_only:
            _require_long_only(name, own)
        return _placed_weights(name, own, prices, days, task, cap, none)
    lag = int(task.lag)
    earned = slice(days.start + lag + 1, days.stop + lag + 1)
    notes: tuple[str, ...] = ()
    if own.kind == "returns":
        returns = _returns(name, own, prices, earned)
    else:
        returns, notes = _growth(name, own, prices, earned)
    if not (np.isfinite(returns) & (returns >= -1)).all():
        worst = int(np.argmin(np.where(np.isfinite(returns), returns, -np.inf)))
        raise QfolioError(
            f"{name} returns {returns[worst]:g} on {_day(prices, earned.start + worst)}; returns "
            "are fractions, at least −1 (0.012 for 1.2%)."
        )
    return Placed(none, returns, notes)


def _placed_weights(
    name: str,
    own: Own,
    prices: Prices,
    days: slice,
    task: Portfolio,
    cap: float,
    decisions: Floats,
) -> Placed:
    rows, moved = rows_at(name, own.dates, prices)
    notes = []
    if moved.size:
        notes.append(
            f"{name}: {amount(moved.size, 'date')} of its orders, from {moved[0]} to {moved[-1]}, "
            f"{'is' if moved.size == 1 else 'are'} not among those of the prices; each order is "
            "decided at the next row."
        )
    unpriced = np.isnan(prices.known)
    for row, weights in zip(rows, own.values, strict=True):
        if row >= days.stop:  # after the test, and perhaps after the last price
            break
        wrong = (weights[1:] != 0) & unpriced[row]
        if wrong.any():
            asset = int(wrong.argmax())
            early = prices.first_rows[asset] > row
            when, until = (
                ("before its first", "until then") if early else ("after its last", "from then on")
            )
            raise QfolioError(
                f"{name} orders {prices.assets[asset]} on {_day(prices, row)}, {when} price; give "
                f"it weight 0 {until}."
            )
        if row >= days.start:
            decisions[row - days.start] = weights
    before = np.flatnonzero(rows < days.start)
    if before.size and np.isnan(decisions[0, 0]):
        last = before[-1]
        known = Conditions.of(prices, task.costs)
        growth = Growth(filled_in(prices.values)[0], task.costs, known)
        decisions[0] = growth.held(own.values[last], int(rows[last]), days.start)
    ordered = ~np.isnan(decisions[:, 0])
    if not ordered.any():
        raise QfolioError(
            f"{name} orders nothing up to {_day(prices, days.stop - 1)}, the last decision of the "
            "test; give it weights at earlier dates."
        )
    first = int(ordered.argmax())
    if first:
        notes.append(
            f"{name} holds cash until its first order, of {_day(prices, days.start + first)}."
        )
    if (largest := float(np.nanmax(decisions[:, 1:]))) > cap + TOLERANCE:
        notes.append(
            f"{name} orders up to {largest:.4g} of one asset, more than the cap of {cap:g}, which "
            "holds for agents and baselines."
        )
    return Placed(decisions, None, tuple(notes))


def compliance(
    name: str,
    decisions: Floats,
    held: Floats,
    mandates: Sequence[tuple[slice, Mandated]],
    spare: Floats,
) -> str:
    """Says where a strategy's orders break the mandate; they are carried out all the same.

    Limits of risk are checked by ``notes.too_risky``.

    Args:
        name: Name of the strategy.
        decisions: The orders of the strategy, of shape (D, N + 1), cash first, NaN for no order.
        held: The weights before each order, likewise.
        mandates: What is allowed on some of the D days.
        spare: What is left of each year's turnover after each order, of shape (D,).
    """
    broken: dict[str, list[float]] = {}
    orders = days = 0
    for some, allowed in mandates:
        given = ~np.isnan(decisions[some, 0])
        found = allowed.violations(decisions[some], held[some])
        found[TURNOVER_OF_YEAR] = -spare[some]
        excess = np.array(list(found.values()))[:, given]
        orders, days = orders + int(given.sum()), days + int((excess > TOLERANCE).any(0).sum())
        for said, by in zip(found, excess, strict=True):
            broken.setdefault(said.removesuffix(" by"), []).extend(by[by > TOLERANCE].tolist())
    apart = ", apart from limits of risk," if mandates[0][1].limits_risk else ""
    if not days:
        return f"{name} keeps the mandate{apart} in all of its {amount(orders, 'order')}."
    how = ", ".join(
        f"{said} ({len(by)}, by up to {max(by):.2g})" for said, by in broken.items() if by
    )
    return (
        f"{name} breaks the mandate{apart} in {days} of its {amount(orders, 'order')}, which are "
        f"carried out as they are: {how}."
    )


def _require_long_only(name: str, own: Own) -> None:
    least = own.values.min(axis=1)
    if (short := least < -TOLERANCE).any():
        row = int(short.argmax())
        cash, assets = own.values[row, 0], own.values[row, 1:]
        if assets.min() >= 0 and abs(assets.sum() - PERCENT) < 1:
            raise QfolioError(
                f"The weights of {name} on {day(own.dates[row])} sum to {assets.sum():.4g} without "
                "cash, so they look like percentages; give fractions that sum to 1 or less (0.6 "
                "for 60%)."
            )
        why = f"a weight of {least[row]:.3g} on {day(own.dates[row])}"
        if assets.min() >= -TOLERANCE:
            why = (
                f"a weight of {cash:.3g} of cash on {day(own.dates[row])}, because its orders cost "
                "more than the cash that is there, or its weights sum to more than 1"
            )
        raise QfolioError(
            f"{name} has {why}; the backtest is long-only, so give weights of at least 0 that sum "
            "to 1 or less, or orders with enough cash."
        )


def rows_at(name: str, dates: Dates, prices: Prices) -> tuple[Rows, Dates]:
    """The row at which each date counts, and the dates that have no row of their own.

    A date after the last row has the number of rows. Raises QfolioError if a date without a row is
    given for a table with several rows a day.
    """
    ours, days = prices.dates, dates.astype("datetime64[D]")
    if one_a_day(ours):
        by_day = ours.astype("datetime64[D]")
        rows = np.searchsorted(by_day, days)
        known = rows < len(ours)
        return rows, days[known][by_day[rows[known]] != days[known]]
    rows = np.searchsorted(ours, dates)
    known = rows < len(ours)
    if (other := dates[known][ours[rows[known]] != dates[known]]).size:
        raise QfolioError(
            f"{name}: {str(other[0]).replace('T', ' ')} is not a row of the prices; where a day "
            "has several rows, give the time of one of them."
        )
    return rows, dates[:0]


def _returns(name: str, own: Own, prices: Prices, earned: slice) -> Floats:
    """Returns on the days of the test, as they are given."""
    rows, moved = rows_at(name, own.dates, prices)
    first, last = prices.dates[earned][[0, -1]].astype("datetime64[D]")
    if (inside := moved[(moved > first) & (moved < last)]).size:
        raise QfolioError(
            f"{name} has a return on {inside[0]}, which is not a row of the prices; give a return "
            "for each row, from one row to the next."
        )
    days = own.dates.astype("datetime64[D]")
    several = (rows[1:] == rows[:-1]) & (days[1:] == days[:-1])
    if several.any():
        raise QfolioError(
            f"{name} has several returns on {days[:-1][several][0]}, of which the prices have one "
            "row; give one return for each row, compounded."
        )
    at = np.full(len(prices) + 1, np.nan)
    at[rows] = own.values
    found = at[earned]
    if (missing := np.isnan(found)).any():
        raise QfolioError(
            f"{name} has no return on {_day(prices, earned.start + int(missing.argmax()))} and on "
            f"{int(missing.sum()):,} of {len(found):,} days of the test in all; give one for each, "
            f"from {first} to {last}."
        )
    return found


def _growth(name: str, own: Own, prices: Prices, earned: slice) -> tuple[Floats, tuple[str, ...]]:
    """Returns on the days of the test, from the last levels known at each row, and notes."""
    first = earned.start - 1
    latest, old = _levels(own, prices.dates[first : earned.stop])
    if old.any():
        raise QfolioError(
            f"{name} has no level on {_day(prices, first + int(old.argmax()))} or in the week "
            f"before; it needs levels from {_day(prices, first)} to "
            f"{_day(prices, earned.stop - 1)}."
        )
    levels, rows = own.values[latest], len(latest) - 1
    growth, fresh = np.asarray(levels[1:] / levels[:-1] - 1), int((np.diff(latest) > 0).sum())
    if fresh >= OFTEN * rows:
        return growth, ()
    return growth, (
        f"{name} has a new level on only {fresh:,} of {rows:,} rows of the test, and stands still "
        "on the others, so figures that compare row by row, such as beta and tracking error, say "
        "little: give its levels at every row.",
    )


def require_levels(name: str, own: Own, prices: Prices) -> None:
    """Raises QfolioError if an index lacks the last rows of a table that has grown.

    Its last level may count for as many rows as its levels usually do, such as one of a week for
    five days; for more, it would stand still.
    """
    if own.kind != "levels":
        return
    latest, _ = _levels(own, prices.dates)
    *before, last = np.bincount(latest[latest >= 0], minlength=len(own.dates))
    if last > np.median([count for count in before if count] or [1]):
        raise QfolioError(
            f"{name} has no level after {day(own.dates[-1])}; start a new backtest with its levels "
            f"up to {_day(prices, -1)}."
        )


def _levels(own: Own, rows: Dates) -> tuple[Rows, Bools]:
    """The number of the last level that is known at each row, and whether it is none or too old.

    Where the rows or the levels are one a day, those of the same day belong together: a row of a
    day is its close.
    """
    dates, days = own.dates, own.dates.astype("datetime64[D]")
    if one_a_day(rows) or (dates == days).all():
        dates, rows = days, rows.astype("datetime64[D]")
    latest = np.searchsorted(dates, rows, side="right") - 1
    return latest, (latest < 0) | (rows - dates[np.maximum(latest, 0)] > OLDEST)


def _day(prices: Prices, row: int | np.integer) -> str:
    return spell(prices.dates[row], prices.dates)
