"""Costs by kind: commission, taxes, spread and impact of trading; interest, fees and carry."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.fields import require
from qfolio.portfolio.costs import Context, CostModel, Limits

COLUMN = "column:"
"""Prefix of a quantity that is a column of the price table."""

SMALLEST = 1e-6
"""Smaller changes of a weight do not count as orders: they pay no fixed or minimum commission."""

SHARE, RATE = Limits(0, 0.2, "from 0 to 0.2"), Limits(-1, 1, "from -1 to 1 per year")

QUANTITIES = {
    "buy": SHARE,
    "sell": SHARE,
    "spread": SHARE,
    "cash_rate": RATE,
    "borrow_fee": RATE,
    "carry_rate": RATE,
    "volume": Limits(1e-9, math.inf, "above 0"),  # nothing can be traded where there is none
}
"""What a quantity must be, whether it is a number or a column."""

STEPS = 6
"""Newton's steps under jax; in numpy they go on until nothing changes, up to ``MOST``."""

MOST = 60

TINY = 1e-20
"""Keeps roots and ratios of nothing finite."""


@dataclass(frozen=True)
class Itemized(CostModel):
    """Costs of trading and holding by kind; each is 0 by default, except the commission.

    A quantity is a number, or "column:NAME" for a column of the price table. Rates are fractions
    per year, accrued continuously on the days between rows (actual/365); sums of money are in the
    currency of the prices.

    cost: commission, as a share of the value traded. buy, sell: quantities, further shares of the
    value bought and sold, such as a stamp duty. spread: quantity, the quoted spread as a share of
    the price, of which a trade pays half. fixed: fee of each order, in money. per_share:
    commission of each share traded, in money, besides ``cost``. minimum, maximum: least commission
    of an order, in money, and the largest, as a share of the value traded (1: no limit). impact,
    impact_power: a trade of the share p of a row's volume moves its price by impact · σ ·
    p^impact_power (a square root by default; 1 is linear), where σ is the volatility of a row's
    returns. volume: quantity, in shares. capital: wealth at the start, in money. cash_rate:
    quantity, the rate that cash earns. borrow_spread: rate of a loan above ``cash_rate``.
    borrow_fee: quantity, the rate paid on assets sold short. carry_rate: quantity, the rate that
    holding an asset earns besides its price (a dividend paid out), or costs if negative (a
    management fee); a short position pays it.

    Source of the impact: R. Almgren, C. Thum, E. Hauptmann and H. Li, "Direct Estimation of Equity
    Market Impact" (2005); B. Tóth et al., "Anomalous Price Impact and the Critical Nature of
    Liquidity in Financial Markets" (2011).
    """

    cost: float = 0.001
    buy: str = "0"
    sell: str = "0"
    spread: str = "0"
    fixed: float = 0.0
    per_share: float = 0.0
    minimum: float = 0.0
    maximum: float = 1.0
    impact: float = 0.0
    impact_power: float = 0.5
    volume: str = "column:volume"
    capital: float = 1e6
    cash_rate: str = "0"
    borrow_spread: float = 0.0
    borrow_fee: str = "0"
    carry_rate: str = "0"

    def __post_init__(self) -> None:
        require(self, "cost", lambda x: 0 <= x <= 0.2, "from 0 to 0.2")
        amounts = "fixed per_share minimum impact"
        require(self, amounts, lambda x: 0 <= x < math.inf, "at least 0")
        require(self, "maximum", lambda x: 0 <= x <= 0.2 or x == 1, "from 0 to 0.2, or 1")
        require(self, "impact_power", lambda x: 0 < x <= 2, "above 0 and at most 2")
        require(self, "capital", lambda x: 0 < x < math.inf, "above 0")
        require(self, "borrow_spread", lambda x: 0 <= x <= 1, "from 0 to 1 per year")
        for name, limits in QUANTITIES.items():
            require(self, name, partial(_fits, limits=limits), f"{limits.words}, or column:NAME")

    @property
    def depends_on_wealth(self) -> bool:  # type: ignore[override]
        return self.fixed > 0 or self.minimum > 0 or self.impact > 0

    @property
    def columns(self) -> tuple[str, ...]:
        named = [*self._read.values(), *["volatility"] * (self.impact > 0)]
        named += ["price"] * (self.impact > 0 or self.per_share > 0)
        financed = any(getattr(self, name) != "0" for name in ("cash_rate", "borrow_fee"))
        timed = financed or self.borrow_spread > 0 or self.carry_rate != "0"
        return tuple(dict.fromkeys([*named, *["years"] * timed]))

    @property
    def limits(self) -> dict[str, Limits]:
        return {column: QUANTITIES[name] for name, column in self._read.items()}

    @property
    def _read(self) -> dict[str, str]:
        """The columns of the quantities that are charged, by the quantities' names."""
        charged = [name for name in QUANTITIES if name != "volume" or self.impact > 0]
        columns = {name: _column(getattr(self, name)) for name in charged}
        return {name: column for name, column in columns.items() if column is not None}

    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        """The remainder factor mu solves mu = 1 − Σᵢ kᵢ(mu·bᵢ − wᵢ), with the costs kᵢ of a trade.

        The sum is convex in mu, so that Newton's method descends to the root from mu = 1, and its
        last step has the derivatives of the root. A ``maximum`` adds a kink that is not convex, and
        too small to keep the method from the root.
        """
        xp = before.__array_namespace__()
        held, wanted = before[..., 1:], after[..., 1:]
        rates = _Rates(self, context, abs(held - wanted) > SMALLEST, held.dtype)
        remainder = xp.ones_like(before[..., 0])
        for _ in range(MOST if xp is np else STEPS):
            change = remainder[..., None] * wanted - held
            paid, slope = rates.paid(change)
            total = sum(kind.sum(-1) for kind in paid.values())
            last = remainder
            remainder = last - (last - 1 + total) / (1 + (slope * wanted).sum(-1))
            remainder = xp.maximum(remainder, xp.zeros_like(remainder))
            if xp is np and (abs(remainder - last) <= np.finfo(last.dtype).eps).all():
                break
        paid, _ = rates.paid(remainder[..., None] * wanted - held)
        return remainder, {name: kind.sum(-1) for name, kind in paid.items()}

    def carry(self, relatives: Any, context: Context) -> Any:
        return self._grown(relatives, context, 0.0, "0")

    def owe(self, relatives: Any, context: Context) -> Any | None:
        if self.borrow_spread == 0 and self.borrow_fee == "0":
            return None
        return self._grown(relatives, context, self.borrow_spread, self.borrow_fee)

    def _grown(self, relatives: Any, context: Context, spread: float, fee: str) -> Any:
        """Growth of cash at its rate plus a spread, and of assets with their carry plus a fee."""
        xp = relatives.__array_namespace__()
        years = xp.asarray(context.years, dtype=relatives.dtype)[..., None]

        def accrued(quantity: str) -> Any:  # of shape (..., 1) or (..., N)
            column = _column(quantity)
            return float(quantity) * years if column is None else context.columns[column]

        interest = accrued(self.cash_rate)
        if interest.shape[-1] != 1:
            raise QfolioError(
                f"cash_rate is {self.cash_rate}, which has a number for each asset; name a column "
                "with one rate for each date."
            )
        growth = relatives
        if {self.carry_rate, fee} != {"0"}:
            growth = relatives * xp.exp(accrued(self.carry_rate) + accrued(fee))
        cash = xp.exp(interest + spread * years)
        return xp.concat([xp.broadcast_to(cash, (*growth.shape[:-1], 1)), growth], axis=-1)


class _Rates:
    """The costs of a trade, asset by asset, as functions of the changes in weights."""

    def __init__(self, model: Itemized, context: Context, ordered: Any, dtype: Any) -> None:
        xp = self.xp = ordered.__array_namespace__()
        self.model, self.ordered = model, ordered

        def known(quantity: str) -> Any:
            column = _column(quantity)
            return float(quantity) if column is None else context.columns[column]

        spread = {} if model.spread == "0" else {"spread": known(model.spread) / 2}
        sides = [
            {"commission": model.cost, **({} if tax == "0" else {"tax": known(tax)}), **spread}
            for tax in (model.buy, model.sell)
        ]
        buying, selling = sides
        # Spending m buys (1 − c)m, so that buying v costs v·c/(1 − c).
        kept = 1 - sum(buying.values())
        buying = {kind: rate / kept for kind, rate in buying.items()}
        if model.per_share > 0:
            price = context.columns["price"]
            there = price > 0  # not before an asset's first price
            rate = xp.where(there, model.per_share / xp.where(there, price, 1.0), 0.0)
            buying["commission"] = buying["commission"] + rate
            selling["commission"] = selling["commission"] + rate
        self.rates = {
            kind: (buying.get(kind, 0), selling.get(kind, 0))
            for kind in dict.fromkeys([*buying, *selling])
        }
        self.totals = sum(buying.values()), sum(selling.values())
        # An account that fees have wiped out may still give orders.
        self.money = xp.maximum(model.capital * xp.asarray(context.wealth, dtype=dtype), TINY)
        self.money = self.money[..., None]
        if model.impact > 0:
            volume = known(model.volume) * context.columns["price"]
            there = volume > 0  # not before an asset's first price
            share = self.money / xp.where(there, xp.asarray(volume, dtype=dtype), 1.0)
            volatility = context.columns["volatility"]
            impact = model.impact * volatility * share**model.impact_power
            self.impact = xp.where(there, impact, 0.0)

    def paid(self, change: Any) -> tuple[dict[str, Any], Any]:
        """Shares of wealth paid, by kind of cost, and the derivative of their sum by the change."""
        xp, model, size = self.xp, self.model, abs(change)
        bought, sold = (change > 0) * size, (change < 0) * size
        paid = {kind: bought * buy + sold * sell for kind, (buy, sell) in self.rates.items()}
        slope = (change > 0) * self.totals[0] - (change < 0) * self.totals[1]
        buy, sell = self.rates["commission"]
        rate = (change > 0) * buy - (change < 0) * sell
        if model.minimum > 0:
            least = self.ordered * model.minimum / self.money
            under = paid["commission"] < least
            paid["commission"] = xp.where(under, least, paid["commission"])
            slope, rate = slope - under * rate, ~under * rate
        if model.maximum < 1:
            most = model.maximum * size
            over = paid["commission"] > most
            paid["commission"] = xp.where(over, most, paid["commission"])
            slope = slope + over * (model.maximum * xp.sign(change) - rate)
        if model.fixed > 0:
            paid["fixed"] = self.ordered * model.fixed / self.money
        if model.impact > 0:
            # A power of 0 has no derivative; below TINY the impact is 0 to the last digit.
            power = xp.maximum(size, TINY) ** model.impact_power
            paid["impact"] = self.impact * power * size
            slope = slope + xp.sign(change) * self.impact * (1 + model.impact_power) * power
        return paid, slope


def _column(quantity: str) -> str | None:
    """The column that a quantity names; None for a number."""
    return quantity.removeprefix(COLUMN) if quantity.startswith(COLUMN) else None


def _fits(text: str, limits: Limits) -> bool:
    if text.startswith(COLUMN):
        return len(text) > len(COLUMN)
    try:
        return limits.least <= float(text) <= limits.most
    except ValueError:
        return False
