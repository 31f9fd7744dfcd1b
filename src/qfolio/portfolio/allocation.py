"""From target weights to the trades that lead there."""

import dataclasses
import datetime
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.portfolio.costs import remainder_factor
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.prices.reading import quote
from qfolio.portfolio.prices.table import Prices

MAX_AGE = np.timedelta64(7, "D")
"""Prices older than this are not those of today."""

NOISE = 1e-6
"""Targets that differ from what is held by this weight at most are no orders: policies decide in
float32."""


@dataclasses.dataclass(frozen=True)
class Allocation:
    """What to hold after the close of ``date``, and what to trade for it; arrays by asset."""

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
        """The policy's target after the table's last row, for who holds ``shares`` and ``cash``.

        The targets are scaled to what is left after costs (the transaction remainder factor), so
        that the trades never need more money than there is. Whole shares are rounded toward zero;
        where less is sold by this than is spent, fewer of the cheapest assets are bought.

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
            cash_after=float(max(cash_after, 0.0)),  # of rounding
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
    """The targets without noise; exactly what is held where nothing is ordered. Cash first."""
    orders = np.abs(targets - held) > NOISE
    if not orders[1:].any():
        return held
    weights = np.where(orders, targets, held)
    weights[0] = max(0.0, 1 - weights[1:].sum())
    return np.asarray(weights / weights.sum())


def _whole(trades: np.ndarray, prices: np.ndarray, cash: float, rate: float) -> np.ndarray:
    """Trades rounded toward zero, and fewer of the cheapest bought where money would not do."""
    trades = np.trunc(trades + np.copysign(1e-9, trades)) + 0.0  # no -0
    spent, received = np.maximum(trades, 0) @ prices, np.maximum(-trades, 0) @ prices
    budget = (cash + received * (1 - rate)) * (1 - rate)
    short = spent - budget * (1 + 1e-12)  # of rounding
    for i in np.argsort(prices):
        if short > 0 and trades[i] > 0:
            fewer = min(trades[i], np.ceil(short / prices[i]))
            trades[i] -= fewer
            short -= fewer * prices[i]
    return np.asarray(trades)


def read_holdings(
    path: Path | None, assets: Sequence[str], capital: float | None
) -> tuple[np.ndarray, float]:
    """Shares of each asset, and cash, from a CSV with the columns asset and shares.

    Raises:
        QfolioError: The file cannot be read or names an unknown asset, a number is missing or
            negative, or cash is given twice.
    """
    import csv

    if capital is not None and not 0 <= capital < math.inf:
        raise QfolioError(f"--capital is {capital}; it must be a sum of money, at least 0.")
    shares, cash = np.zeros(len(assets)), capital
    if path is None:
        return shares, cash or 0.0
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (UnicodeDecodeError, csv.Error):
        raise QfolioError(f"{path} is no text file with commas; save it as CSV.") from None
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    if "asset" not in header or "shares" not in header:
        raise QfolioError(f"{path} needs a first line with the columns asset and shares.")
    name_at, shares_at = header.index("asset"), header.index("shares")
    seen = set()
    for number, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}, line {number}"
        try:
            name, amount = row[name_at].strip(), float(row[shares_at])
        except (IndexError, ValueError):
            raise QfolioError(f"{where}: shares must be a number.") from None
        if not 0 <= amount < math.inf:
            raise QfolioError(f"{where}: {quote(name)} has {amount} shares; it must be 0 or more.")
        if name in seen:
            raise QfolioError(f"{where}: {quote(name)} comes twice; add the two up.")
        seen.add(name)
        if name.lower() == "cash":
            if capital is not None:
                raise QfolioError(f"{where}: cash is also given by --capital; leave out one.")
            cash = amount
        elif name in assets:
            shares[list(assets).index(name)] = amount
        else:
            raise QfolioError(f"{where}: the backtest does not know {quote(name)}.")
    return shares, cash or 0.0


def require_fresh(prices: Prices, as_of: str | None) -> None:
    """Raises QfolioError where the last prices are not of the week before ``as_of`` (today)."""
    try:
        day = np.datetime64(as_of or datetime.date.today().isoformat(), "D")
    except ValueError:
        raise QfolioError(f"--as-of is {as_of!r}; it must be a date such as 2025-12-31.") from None
    last = prices.dates[-1].astype("datetime64[D]")
    if last > day:
        raise QfolioError(
            f"The prices end on {last}, after {day}; leave out the later rows, or set --as-of."
        )
    if day - last > MAX_AGE:
        raise QfolioError(
            f"The prices are stale: they end on {last}, {(day - last).astype(int)} days before "
            f"{day}; bring the latest ones with --prices, or say --as-of {last}."
        )
