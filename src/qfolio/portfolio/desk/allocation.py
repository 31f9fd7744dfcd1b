"""Turns target weights into trades."""

import dataclasses
import datetime
import itertools
import math
from fractions import Fraction
from functools import cached_property, partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import amount, quote
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import Context, CostModel
from qfolio.portfolio.desk.whole_shares import whole_shares as rounded
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.mandate.limits import lots, parse
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.frequency import spacing
from qfolio.portfolio.prices.table import Prices

MAX_AGE = datetime.timedelta(days=7)
"""Older daily prices are stale. Slower ones may be older by the days between their rows; prices of
several times a day are stale a day after the longest pause between their rows of a year."""

NOISE = 1e-6
"""Smaller changes of a weight are not ordered, since policies decide in float32."""

OVERDRAFT = 0.05
"""Largest negative cash of a long-only account, as a share of wealth; an order repays it."""


@runtime_checkable
class Followed(Protocol):
    """What can be followed: a learned policy, or a strategy that learns nothing."""

    @property
    def costs(self) -> CostModel: ...

    @property
    def mandate(self) -> str: ...

    def weights(
        self, prices: Any, holdings: Any = None, *, spent: float = 0.0
    ) -> dict[str, float]: ...


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
    costs: dict[str, float]  # expected, in money, by kind
    cash_after: float
    order_costs: np.ndarray  # the same of each asset's order, all kinds together

    @staticmethod
    def of(
        policy: Followed,
        prices: Prices,
        shares: np.ndarray,
        cash: float,
        *,
        whole_shares: bool = False,
        spent: float = 0.0,
        debts: bool = True,
        lag: int = 1,
    ) -> "Allocation":
        """The policy's target after the table's last row, and the trades from the current holding.

        The targets are scaled to the wealth after costs (the transaction remainder factor), so that
        the trades never need more money than there is. Where the mandate fills orders over several
        rows, costs are those of all parts, at the last row's prices.

        Args:
            policy: The policy or other strategy to follow.
            prices: Prices up to the row after which to trade.
            shares: Shares held now, of shape (assets,).
            cash: Cash held now, in money.
            whole_shares: Whether to trade whole shares only, as near to the target as possible.
                Where the mandate has lots, whole lots are traded in any case.
            spent: Turnover since the calendar year began, for a mandate that limits it.
            debts: Whether the policy may be in debt. If not, it decides as if an overdraft, which
                is left where prices rise before trades are filled, were repaid.
            lag: Rows from the decision to its trades, for a cost model that depends on them.

        Raises:
            QfolioError: There is nothing to allocate, or the overdraft is large.
        """
        last = prices.values[-1]
        known = np.where(np.isnan(last), 0.0, last)  # without a price there are no shares
        wealth = float(shares @ known + cash)
        if wealth < 0:
            raise QfolioError(
                f"The account is worth {wealth:,.2f}, since its debts exceed what it owns, and has "
                "nothing to allocate; pay in money, or close it with the broker."
            )
        if not 0 < wealth < math.inf:
            raise QfolioError(
                "There is nothing to allocate: give --capital, or --holdings with shares or cash."
            )
        held = np.append(cash, shares * known) / wealth
        seen = held
        if not debts and cash < 0:
            if held[0] < -OVERDRAFT:
                raise QfolioError(
                    f"Cash is {cash:,.2f}, an overdraft of {-held[0]:.1%} of the wealth, and the "
                    f"backtest is long-only; bring it below {OVERDRAFT:.0%}."
                )
            seen = np.append(0.0, held[1:] / held[1:].sum())
        names = ("cash", *prices.assets)
        holdings = dict(zip(names, seen.tolist(), strict=True))
        targets = policy.weights(prices, holdings, spent=spent)
        weights = _ordered(np.array([targets[name] for name in names]), held)
        trades = np.zeros(len(shares))
        conditions = Conditions.of(prices, policy.costs)
        context = context_of(policy.costs, conditions, len(prices) - 1, wealth, lag)
        parts = parse(policy.mandate)[1].trading.fill if policy.mandate else 1
        after = partial(filled, policy.costs, context, shares, cash, known, parts)
        if not np.array_equal(weights, held):
            kept = abs(weights - held)[1:] <= NOISE
            reached = _paid(policy.costs, context, held, weights, kept, parts)
            money = wealth * reached[1:]
            trades = np.divide(money, known, out=np.zeros_like(money), where=known > 0) - shares
            lot = lots(policy.mandate)
            whole = whole_shares or lot is not None
            trades[(kept & whole) | (reached == held)[1:]] = 0.0
            if whole_shares and lot is not None:  # the least lot of whole shares: 3 for 1.5
                lot = np.array([Fraction(str(each)).numerator for each in lot.tolist()], float)
            if whole:
                ideal = wealth * reached[0]
                trades = rounded(trades, shares, known, ideal, lambda trades: after(trades)[0], lot)
        cash_after, costs = after(trades) if trades.any() else (cash, {})
        own = np.zeros(len(trades))
        for j in np.flatnonzero(trades).tolist():
            own[j] = sum(after(np.where(np.arange(len(trades)) == j, trades, 0.0))[1].values())
        if own.any():  # the wealth that one order's costs leave changes the others' a little
            own *= sum(costs.values()) / own.sum()
        # Equal parts of an order in shares are only nearly such of the way to its weights.
        rounding = weights[0] >= 0 and cash_after > -NOISE * wealth
        return Allocation(
            date=day(prices.dates[-1]),
            assets=prices.assets,
            prices=last,
            shares=shares,
            cash=cash,
            weights=weights,
            trades=trades,
            costs=costs,
            cash_after=max(cash_after, 0.0) if rounding else cash_after,
            order_costs=own,
        )

    @property
    def cost(self) -> float:
        """The expected cost of all kinds, in money."""
        return float(sum(self.costs.values()))

    @property
    def wealth(self) -> float:
        """Value of the shares and cash before the trades."""
        return float(np.nansum(self.shares * self.prices) + self.cash)

    @property
    def held(self) -> np.ndarray:
        """Weights now, cash first."""
        return np.append(self.cash, np.nan_to_num(self.shares * self.prices)) / self.wealth

    @property
    def turnover(self) -> float:
        """Sum of the absolute changes in the weights of the assets bought and sold."""
        return turnover(self.held, self.reached, self.trades)

    @cached_property
    def reached(self) -> np.ndarray:
        """Weights after the trades and their costs, cash first."""
        values = np.nan_to_num((self.shares + self.trades) * self.prices)
        held = np.append(self.cash_after, values)
        return np.asarray(held / held.sum())

    def to_json(self) -> dict[str, Any]:
        """The trades as values of JSON."""
        rows = zip(
            self.assets,
            [None if math.isnan(price) else price for price in self.prices.tolist()],
            self.held[1:].tolist(),
            self.weights[1:].tolist(),
            self.reached[1:].tolist(),
            self.trades.tolist(),
            np.nan_to_num(self.trades * self.prices).tolist(),
            strict=True,
        )
        keys = (
            "asset", "price", "weight_now", "weight", "weight_after", "trade_shares", "trade_money",
        )  # fmt: skip
        return {
            "date": self.date,
            "wealth": self.wealth,
            "cash": self.cash,
            "cash_weight": float(self.weights[0]),
            "cash_weight_after": float(self.reached[0]),
            "cash_after": self.cash_after,
            "expected_cost": self.cost,
            "expected_cost_by_kind": self.costs,
            "assets": [dict(zip(keys, row, strict=True)) for row in rows],
        }


def _ordered(targets: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The targets without rounding noise, cash first; exactly ``held`` if nothing is ordered."""
    orders = np.abs(targets - held) > NOISE
    if not orders[1:].any():
        return held
    weights = np.where(orders, targets, held)
    weights[0] = 1 - weights[1:].sum()
    if targets[0] >= -NOISE:
        weights[0] = max(0.0, weights[0])
    return np.asarray(weights / weights.sum())


def _paid(
    model: CostModel,
    context: Context,
    held: np.ndarray,
    weights: np.ndarray,
    kept: np.ndarray,
    parts: int,
) -> np.ndarray:
    """Cash and each asset after the costs of an order, as shares of the wealth before it.

    What is kept pays nothing: a sale of the share of wealth that costs take away, so that its
    weight stays the same, would be an order of its own, with a fee. If the rest is worth less than
    the costs, nothing is traded. Where there are debts, the rest may be worth little, or nothing,
    and cash pays for what is kept.

    kept: whether an asset's weight is to stay, of shape (N,). parts: in which the order is filled.
    """

    def remains(before: np.ndarray, after: np.ndarray, share: float) -> float:
        left = 1.0
        path = np.linspace(before / before.sum(), after / after.sum(), parts + 1)
        for start, end in itertools.pairwise(path):
            if left > 0:
                of_it = context._replace(wealth=left * share * context.wealth)
                left *= float(model.trade(start, end, of_it)[0])
        return left

    apart = np.append(False, kept)
    before, after = (np.where(apart, 0.0, each) for each in (held, weights))
    rest = float(before.sum())
    if min(held[1:].min(), weights.min()) < 0:
        left = remains(held, weights, 1.0)
        return np.where(apart, held, left * weights) if left > 0 else held
    if min(rest, after.sum()) <= NOISE or (remainder := remains(before, after, rest)) <= 0:
        return held
    return np.where(apart, held, remainder * rest * after / after.sum())


def turnover(held: Any, reached: Any, trades: Any) -> float:
    """Sum of the absolute changes of weights, cash first, of the assets that are traded."""
    changes = abs(np.subtract(reached, held))[1:]
    return float(changes[np.asarray(trades) != 0].sum())


def context_of(model: CostModel, known: Conditions, row: int, wealth: float, lag: int) -> Context:
    """The circumstances of a trade at a row, ``lag`` rows after its decision."""
    capital = model.capital if isinstance(model, Itemized) else wealth
    return known.trade(row, lag, wealth / capital)


def filled(
    model: CostModel,
    context: Context,
    shares: np.ndarray,
    cash: float,
    prices: np.ndarray,
    parts: int,
    trades: np.ndarray,
) -> tuple[float, dict[str, float]]:
    """The cash that is left after trades in equal parts, and their costs in money, by kind.

    shares, cash: held before. parts: how many there are, all at the same prices.
    """
    part, paid = trades / parts, dict[str, float]()
    first = wealth = float(shares @ prices + cash)
    for _ in range(parts):
        if wealth <= 0:  # costs have taken everything
            break
        now = context._replace(wealth=context.wealth * wealth / first)
        held = np.append(cash, shares * prices) / wealth
        cash, costs = settled(model, now, held, wealth, shares, prices, part)
        paid = {kind: paid.get(kind, 0.0) + money for kind, money in costs.items()}
        shares = shares + part
        wealth = float(shares @ prices + cash)
    return cash, paid


def settled(
    model: CostModel,
    context: Context,
    held: np.ndarray,
    wealth: float,
    shares: np.ndarray,
    prices: np.ndarray,
    trades: np.ndarray,
) -> tuple[float, dict[str, float]]:
    """The cash that is left after trades, and their costs in money, by kind.

    The cost model asks for the weights after the trade, which depend on the cash that it leaves;
    that cash is a fixed point, found in a few steps because costs are small. What is not traded
    counts as cash: its weight changes because costs change the wealth, which is no order.
    """
    values, kept = (shares + trades) * prices, trades == 0
    invested, apart = float(values.sum()), float(values[kept].sum())
    held = np.append(held[0] + held[1:][kept].sum(), np.where(kept, 0.0, held[1:]))
    values = np.where(kept, 0.0, values)
    cash = wealth - invested
    costs: dict[str, Any] = {}
    for _ in range(100):
        after = np.append(cash + apart, values) / (cash + invested)
        remainder, costs = model.trade(held, after, context)
        found = wealth * float(remainder) - invested
        if abs(found - cash) <= 1e-14 * wealth:
            break
        cash = found
    return cash, {kind: wealth * float(share) for kind, share in costs.items()}


def require_fresh(prices: Prices, as_of: str | datetime.date | None) -> datetime.timedelta:
    """Raises QfolioError unless prices end shortly before ``as_of``; returns how old they are.

    as_of: A day or, for prices of several times a day, a moment in UTC (default: now).
    """
    last = prices.dates[-1].astype("datetime64[s]").item()
    steps, usual = spacing(prices.dates) if len(prices) > 1 else (np.ones(1), 1.0)
    several = usual < 1
    now = datetime.datetime.now(datetime.UTC).replace(tzinfo=None, microsecond=0)
    given = (now if several else datetime.date.today()) if as_of is None else _when(as_of)
    if isinstance(given, datetime.datetime) and not several:
        given = given.date()
    exact = isinstance(given, datetime.datetime)
    end = last if exact else last.date()
    age = given - end
    early = age < datetime.timedelta()
    if exact and as_of is None:  # times may be local: it is later in Tokyo than in UTC
        early = last.date() > max(datetime.date.today(), now.date())
        age = max(age, datetime.timedelta())
    if early:
        raise QfolioError(
            f"The prices end on {end}, after {given}; leave out the later rows, or set a later "
            "--as-of."
        )
    limit = MAX_AGE + datetime.timedelta(days=max(0, round(usual) - 1))
    if several and steps.sum() > MAX_AGE.days:  # no market that the table knows rests for longer
        longest = float(steps[-round(prices.periods_per_year) :].max())
        limit = min(MAX_AGE, datetime.timedelta(days=longest + 1))
    if age > limit:
        raise QfolioError(
            f"The prices are stale: they end on {end}, {duration(age)} before {given}; "
            f"give the latest with --prices, or set --as-of {end.isoformat()}."
        )
    return age


def duration(age: datetime.timedelta) -> str:
    """A length of time in whole hours, or in days from two days on."""
    hours = age // datetime.timedelta(hours=1)
    return amount(hours, "hour") if hours < 48 else amount(hours // 24, "day")


def _when(as_of: str | datetime.date) -> datetime.date:
    """A day, or a moment in UTC."""
    try:
        return datetime.date.fromisoformat(str(as_of))
    except ValueError:
        pass
    try:
        moment = datetime.datetime.fromisoformat(str(as_of))
    except ValueError:
        raise QfolioError(
            f"--as-of is {quote(as_of)}; it must be a date such as 2025-12-31 or, for prices of "
            "several times a day, a time such as 2025-12-31T15:00."
        ) from None
    if moment.tzinfo is not None:
        moment = moment.astimezone(datetime.UTC).replace(tzinfo=None)
    return moment
