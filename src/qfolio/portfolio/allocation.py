"""Turns target weights into trades."""

import dataclasses
import datetime
import math
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.costs import remainder_factor
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.prices.table import Prices

MAX_AGE = datetime.timedelta(days=7)
"""Older prices are stale."""

NOISE = 1e-6
"""Smaller changes of a weight are not ordered, since policies decide in float32."""


@dataclasses.dataclass(frozen=True)
class Allocation:
    """Target weights after the close of ``date``, and the trades to reach them; arrays by asset."""

    date: str  # of the last prices
    assets: tuple[str, ...]
    prices: np.ndarray
    shares: np.ndarray  # held now
    cash: float
    weights: np.ndarray  # targets, cash first
    trades: np.ndarray  # shares to buy, negative to sell
    cost: float  # expected, in money
    cash_after: float

    @staticmethod
    def of(
        policy: Policy,
        prices: Prices,
        shares: np.ndarray,
        cash: float,
        *,
        whole_shares: bool = False,
    ) -> "Allocation":
        """The policy's target after the table's last row, and the trades from the current holding.

        The targets are scaled to the wealth after costs (the transaction remainder factor), so that
        the trades never need more money than there is. Whole shares are rounded toward zero; if the
        sales then do not cover the purchases, fewer of the cheapest assets are bought.

        Args:
            policy: The policy to follow.
            prices: Prices up to the row after which to trade.
            shares: Shares held now, of shape (assets,).
            cash: Cash held now, in money.
            whole_shares: Whether to trade whole shares only.

        Raises:
            QfolioError: There is nothing to allocate.
        """
        last, rate = prices.values[-1], policy.task.cost
        values = shares * last
        wealth = values.sum() + cash
        if not 0 < wealth < math.inf:
            raise QfolioError(
                "There is nothing to allocate: give --capital, or --holdings with shares or cash."
            )
        held = np.append(cash, values) / wealth
        names = ("cash", *prices.assets)
        targets = policy.weights(prices, dict(zip(names, held.tolist(), strict=True)))
        weights = _ordered(np.array([targets[name] for name in names]), held)
        if np.array_equal(weights, held):
            trades = np.zeros(len(shares))
        else:
            remainder = float(remainder_factor(held, weights, rate))
            trades = remainder * weights[1:] * wealth / last - shares
        if whole_shares:
            trades = _whole(trades, last, cash, rate)
        money = trades * last
        spent, received = money[money > 0].sum(), -money[money < 0].sum()
        # Buying an amount takes amount / (1 − c) of cash; selling it yields (1 − c) of it.
        cash_after = cash + received * (1 - rate) - spent / (1 - rate)
        cost = received * rate + spent * rate / (1 - rate)
        return Allocation(
            date=str(prices.dates[-1])[:10],
            assets=prices.assets,
            prices=last,
            shares=shares,
            cash=cash,
            weights=weights,
            trades=trades,
            cost=float(cost),
            cash_after=float(max(cash_after, 0.0)),  # rounding may leave it below 0
        )

    @property
    def wealth(self) -> float:
        return float(self.shares @ self.prices + self.cash)

    @property
    def held(self) -> np.ndarray:
        """Weights now, cash first."""
        return np.append(self.cash, self.shares * self.prices) / self.wealth

    def to_json(self) -> dict[str, Any]:
        rows = zip(
            self.assets,
            self.prices.tolist(),
            self.held[1:].tolist(),
            self.weights[1:].tolist(),
            self.trades.tolist(),
            (self.trades * self.prices).tolist(),
            strict=True,
        )
        keys = ("asset", "price", "weight_now", "weight", "trade_shares", "trade_money")
        return {
            "date": self.date,
            "wealth": self.wealth,
            "cash": self.cash,
            "cash_weight": float(self.weights[0]),
            "cash_after": self.cash_after,
            "expected_cost": self.cost,
            "assets": [dict(zip(keys, row, strict=True)) for row in rows],
        }


def _ordered(targets: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The targets without rounding noise, cash first; exactly ``held`` if nothing is ordered."""
    orders = np.abs(targets - held) > NOISE
    if not orders[1:].any():
        return held
    weights = np.where(orders, targets, held)
    weights[0] = max(0.0, 1 - weights[1:].sum())
    return np.asarray(weights / weights.sum())


def _whole(trades: np.ndarray, prices: np.ndarray, cash: float, rate: float) -> np.ndarray:
    """Trades rounded toward zero, with fewer of the cheapest bought if money runs short."""
    trades = np.trunc(trades + np.copysign(1e-9, trades)) + 0.0  # no -0
    spent, received = np.maximum(trades, 0) @ prices, np.maximum(-trades, 0) @ prices
    budget = (cash + received * (1 - rate)) * (1 - rate)
    short = spent - budget * (1 + 1e-12)  # tolerates rounding
    for i in np.argsort(prices):
        if short > 0 and trades[i] > 0:
            fewer = min(trades[i], np.ceil(short / prices[i]))
            trades[i] -= fewer
            short -= fewer * prices[i]
    return np.asarray(trades)


def require_fresh(prices: Prices, as_of: str | None) -> None:
    """Raise QfolioError unless the last prices are of the week up to ``as_of`` (default: today)."""
    try:
        today = datetime.date.today() if as_of is None else datetime.date.fromisoformat(as_of)
    except ValueError:
        raise QfolioError(
            f"--as-of is {quote(as_of)}; it must be a date such as 2025-12-31."
        ) from None
    last = prices.dates[-1].astype("datetime64[D]").item()
    if last > today:
        raise QfolioError(
            f"The prices end on {last}, after {today}; leave out the later rows, or set --as-of."
        )
    if today - last > MAX_AGE:
        raise QfolioError(
            f"The prices are stale: they end on {last}, {(today - last).days} days before {today}; "
            f"give the latest with --prices, or set --as-of {last}."
        )
