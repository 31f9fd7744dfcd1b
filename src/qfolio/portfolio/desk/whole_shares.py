"""Trades in whole shares, or lots, that leave a portfolio as near as possible to its target."""

from collections.abc import Callable

import numpy as np

EXACT = 1e-9
"""How far from a whole number a trade may be and still count as one."""


def whole_shares(
    ideal: np.ndarray,
    shares: np.ndarray,
    prices: np.ndarray,
    cash: float,
    cash_after: Callable[[np.ndarray], float],
    lots: np.ndarray | None = None,
) -> np.ndarray:
    """The trades in whole shares that track the ideal ones best.

    Each trade is rounded down or up. The distance to the target is the sum of squared deviations of
    each asset and of the cash, in money. Starting once with all trades rounded down and once with
    the nearest whole numbers, the best change of one or two trades is made until none reduces the
    distance; the nearer result counts. This local search does not prove the optimum; the tests
    compare it with every rounding. Fractions of a share, or of a lot, that are held are never sold.

    Args:
        ideal: Shares to buy, negative to sell, of shape (assets,).
        shares: Shares held now, likewise.
        prices: Prices of the assets, same shape.
        cash: Cash that the ideal trades leave.
        cash_after: The cash that trades leave, after costs. The result leaves no negative cash, or
            no larger loan than the ideal trades.
        lots: Number of shares in a lot of each asset (default: single shares).
    """
    if lots is not None:  # a lot is traded like one share at the price of them all
        number = whole_shares(
            ideal / lots, shares / lots, prices * lots, cash, lambda n: cash_after(n * lots)
        )
        return number * lots
    low, high = np.floor(ideal + EXACT), np.ceil(ideal - EXACT)
    goal = shares + ideal
    turned = (shares < 0) & (goal < EXACT) & (shares + high > EXACT)
    high = np.where(turned, np.maximum(low, high - 1), high)  # what is short is not bought long, …
    sold = (goal > -EXACT) & (shares + low < -EXACT)  # … and a holding not sold short, by rounding
    low = np.where(sold, np.minimum(high, low + 1), low)
    least_cash = min(cash, 0.0)

    def searched(start: np.ndarray) -> np.ndarray:
        trades = _affordable(start, prices, lambda trades: cash_after(trades) - least_cash)
        limits = np.minimum(low, trades), high
        while (better := _improved(trades, *limits, ideal, prices, cash, cash_after)) is not None:
            trades = better
        return trades

    def distance(trades: np.ndarray) -> tuple[bool, float]:
        left = cash_after(trades)
        off = np.append((trades - ideal) * prices, left - cash)
        overdrawn = left < least_cash - EXACT * float(abs(shares) @ prices)
        return overdrawn, float(off @ off)  # no trade leaves an overdraft as it is

    found = map(searched, (low, np.clip(np.round(ideal), low, high)))
    return min(found, key=distance) + 0.0  # no -0


def _affordable(
    trades: np.ndarray, prices: np.ndarray, cash_after: Callable[[np.ndarray], float]
) -> np.ndarray:
    """The trades, with fewer of the cheapest bought if money runs short."""
    trades = trades.copy()
    for i in np.argsort(prices, kind="stable"):
        while trades[i] > 0 and (left := cash_after(trades)) < 0:
            trades[i] -= min(trades[i], np.ceil(-left / prices[i]))
    return trades if cash_after(trades) >= 0 else np.zeros_like(trades)


def _improved(
    trades: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    ideal: np.ndarray,
    prices: np.ndarray,
    cash: float,
    cash_after: Callable[[np.ndarray], float],
) -> np.ndarray | None:
    """The trades after the best change of one or two by a share each; None if none is better."""
    step = np.where(trades < high, 1.0, np.where(trades > low, -1.0, 0.0))
    (some,) = np.nonzero(step)
    money, off = (step * prices)[some], ((trades - ideal) * prices)[some]
    left = cash_after(trades)
    error = left - cash

    def distance(change: np.ndarray, after: float) -> float:
        moved = off + change
        return float(moved @ moved + (after - cash) ** 2 - off @ off - error**2)

    # The costs of one share more or less are ignored here, and counted when a change is made. That
    # must not rule out a sale less because what it saves in costs is missing: without any costs,
    # there is at least as much cash.
    free = cash_after(np.zeros_like(trades)) - trades @ prices
    own = 2 * off * money + money**2
    gains = own + own[:, None] + (error - money - money[:, None]) ** 2 - error**2
    np.fill_diagonal(gains, own + (error - money) ** 2 - error**2)
    gains[free - money - np.where(np.eye(len(some)), 0, money[:, None]) < min(cash, 0.0)] = np.inf
    while len(some):
        i, j = divmod(int(gains.argmin()), len(some))
        if not gains[i, j] < 0:
            break
        chosen = np.zeros(len(some))
        chosen[[i, j]] = 1.0
        changed = trades.copy()
        changed[some] += chosen * step[some]
        after = cash_after(changed)
        if (
            after >= min(cash, 0.0)
            and distance(chosen * money, after) < -1e-12 * max(abs(cash), abs(left), 1.0) ** 2
        ):
            return changed
        gains[i, j] = gains[j, i] = np.inf
    return None
