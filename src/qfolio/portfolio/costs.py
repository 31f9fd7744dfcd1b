"""Exact costs of trading and holding: the same code for training and backtest.

A ``CostModel`` gives the wealth that remains after a trade and the growth of a holding; a market's
``cost_model=NAME`` names one. ``Proportional``, a share of the value traded, is here; ``Itemized``,
with commissions, spreads, impact, interest and fees, is in ``itemized.py``.

Weights have a last axis of N + 1 entries, cash first, and sum to 1; a negative weight is owed: a
loan, or assets sold short. Every function works on numpy and jax arrays (also under jit, vmap and
grad) and broadcasts over leading axes.

With a one-way cost c, a sale of value s yields (1−c)s of cash; spending m buys (1−c)m of an asset.
Paying for a rebalancing from weights w to weights b leaves the share mu of the wealth, the
"transaction remainder factor" (Z. Jiang, D. Xu, J. Liang, "A deep reinforcement learning framework
for the financial portfolio management problem", 2017, eq. 14), which solves

    mu·b₀ = w₀ + (1−c)·Σᵢ (wᵢ − mu·bᵢ)⁺ − Σᵢ (mu·bᵢ − wᵢ)⁺ / (1−c),

where the sums run over the assets, without cash. It holds for negative weights, too.
"""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from qfolio.core.errors import QfolioError


class Context(NamedTuple):
    """The circumstances of a trade, or of a holding period, besides price relatives.

    rows: number of rows from the decision to its trade, or of the holding period. years: length of
    the holding period. columns: the columns that the cost model reads, by name, of shape (..., 1)
    or (..., N): their values at the row of the trade, or their integrals over the holding period,
    in years. wealth: wealth before the trade, as a multiple of initial wealth, of shape (...).
    listed: 1 for each asset with a price at the end of the holding period, otherwise 0, of shape
    (..., N); None if all have one.
    """

    rows: Any = 1
    years: Any = 0.0
    columns: Mapping[str, Any] = {}
    wealth: Any = 1.0
    listed: Any = None


class Limits(NamedTuple):
    """The least and the largest value of a quantity, also in words."""

    least: float
    most: float
    words: str


class CostModel(abc.ABC):
    """Costs of trading and holding; every method takes numpy arrays and jax arrays, traced or not.

    A model is a dataclass with a default for each field; a field with the name of a market's
    setting (such as ``cost``) takes its value.
    """

    depends_on_wealth: ClassVar[bool] = False
    """Whether costs, as a share of wealth, depend on the wealth."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the price table that ``trade``, ``carry`` and ``owe`` read (default: none).

        "price" is the price itself; "volatility" is that of the 21 log returns up to a row, unless
        the table has a column of this name. "years" asks only for the lengths of holding periods.
        """
        return ()

    @property
    def limits(self) -> Mapping[str, Limits]:
        """What the values of columns must be, by the columns' names (default: anything)."""
        return {}

    @abc.abstractmethod
    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        """The share of wealth that remains after a rebalancing, and its cost.

        Args:
            before: Weights before the trade, of shape (..., N + 1), of sum 1.
            after: Weights after it, likewise.
            context: The circumstances of the trade.

        Returns:
            Remainder factors of shape (...), exactly 1 where nothing is traded; and the shares of
            wealth paid, of the same shape, by kind of cost, which sum to 1 minus the factor.
        """

    @abc.abstractmethod
    def carry(self, relatives: Any, context: Context) -> Any:
        """Growth factors of cash and of each asset while they are held.

        Args:
            relatives: New price over old price of each asset, of shape (..., N).
            context: The holding period; ``rows`` is a number or of shape (...).

        Returns:
            Growth factors of shape (..., N + 1), cash first, all positive.
        """

    def owe(self, relatives: Any, context: Context) -> Any | None:
        """Growth factors of a loan and of assets sold short (default: None, those of ``carry``)."""
        return None

    def factors(self, relatives: Any, context: Context) -> list[Any]:
        """Growth factors of what is owned and of what is owed, each of shape (..., N + 1).

        There is only the first if they are the same. Assets delisted by then have earned what cash
        does.
        """
        owned, owed = self.carry(relatives, context), self.owe(relatives, context)
        cash = owned[..., :1]
        found = [owned] if owed is None else [owned, owed]
        return [delisted(each, relatives, context.listed, cash) for each in found]

    def growth(self, weights: Any, relatives: Any, context: Context) -> Any:
        """Growth factors of each entry of a holding, of shape (..., N + 1), by its sign."""
        return by_sign(weights, self.factors(relatives, context))

    def worth(self, weights: Any, relatives: Any, context: Context) -> Any:
        """What a holding is worth after a period, as a multiple of its worth before, (...)."""
        return (weights * self.growth(weights, relatives, context)).sum(-1)

    def held(self, weights: Any, relatives: Any, context: Context) -> Any:
        """Weights after a holding period without a trade; assets delisted by then are cash."""
        after = grown(weights, self.growth(weights, relatives, context))
        return after if context.listed is None else cashed(after, context.listed)


def by_sign(weights: Any, factors: Sequence[Any]) -> Any:
    """The factors of a holding's entries, by the signs of their weights: owned, then owed."""
    if len(factors) == 1:
        return factors[0]
    return weights.__array_namespace__().where(weights < 0, factors[1], factors[0])


def require_sound(model: CostModel, trade: Context, relatives: Any, holding: Context) -> None:
    """Tries a model of a user's own; raises QfolioError unless it answers as ``CostModel`` says.

    Args:
        trade: The circumstances of some trade.
        relatives: Price relatives of a holding period, of shape (N,).
        holding: Its circumstances.
    """

    def require(method: str, right: Any, wanted: str) -> None:
        if not right:
            raise QfolioError(f"{type(model).__name__}.{method} must return {wanted}.")

    assets = relatives.shape[-1]
    cash, last = np.eye(1 + assets)[[0, -1]]
    half = (cash + last) / 2
    pairs = [(one, other) for one in (cash, half, last) for other in (cash, half, last)]
    before, after = np.swapaxes(pairs, 0, 1)
    same = [one is other for one, other in pairs]
    answer = model.trade(before, after, trade)
    pair = isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], Mapping)
    require("trade", pair, "the share of wealth that remains, and its costs by kind in a dict")
    left, paid = np.asarray(answer[0]), [np.asarray(each) for each in answer[1].values()]
    shapes = {each.shape for each in (left, *paid)}
    require("trade", shapes == {(9,)}, "numbers of shape (...) for weights of shape (..., N + 1)")
    require("trade", ((left > 0) & (left <= 1)).all(), "shares of wealth above 0 and at most 1")
    require("trade", (left[same] == 1).all(), "exactly 1 where nothing is traded")
    gap = abs(sum(paid) - (1 - left)).max()
    require("trade", gap < 1e-6, "costs that sum to 1 minus the share of wealth that remains")
    for method in ("carry", "owe"):
        found = getattr(model, method)(relatives, holding)
        if method == "carry" or found is not None:
            grown = np.asarray(found)
            entries = (
                f"growth factors of cash and of each of {assets} assets, of shape (..., N + 1)"
            )
            require(method, grown.shape == (1 + assets,), entries)
            require(method, ((grown > 0) & (grown < np.inf)).all(), "positive growth factors")
            several = holding._replace(rows=np.array([holding.rows] * 2))
            both = np.asarray(getattr(model, method)(np.stack([relatives] * 2), several))
            require(method, both.shape == (2, 1 + assets), entries)


@dataclass(frozen=True)
class Proportional(CostModel):
    """A share of the value traded, one way; holding costs nothing and cash earns nothing."""

    cost: float = 0.001  # one way, as a share of the value traded
    gross: float = 1.0  # the largest sum of absolute weights of the assets

    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        remainder = remainder_factor(before, after, self.cost, gross=self.gross)
        return remainder, {"proportional": 1 - remainder}

    def carry(self, relatives: Any, context: Context) -> Any:
        return with_cash(relatives)


def remainder_factor(
    before: Any, after: Any, cost: Any, *, highest: float = 0.2, gross: float = 1.0
) -> Any:
    """The share of wealth that remains after paying for a rebalancing.

    The right side minus the left side of the equation above is decreasing, concave and piecewise
    linear in mu, so that Newton's method from mu = 1 descends to the root without overshooting. A
    step, with gᵢ = −c for the assets sold at mu, c/(1−c) for those bought and 0 for the rest, is

        mu ← 1 + Σᵢ gᵢ(wᵢ − bᵢ) / (1 + Σᵢ gᵢbᵢ),

    because both weights sum to 1. ``newton_steps`` gives the number of steps for an exact result.

    Without a trade or a cost it is exactly 1. Derivatives are exact, too: the last step is the
    closed form on the right piece, and the choice of the piece has no derivative. They hold along
    the simplex, as cash does not appear in the formula. At the kink, where wᵢ = mu·bᵢ, an asset's
    trade is free to first order, which lies between the two one-sided derivatives.

    Args:
        before: Weights w before the trade, of shape (..., N + 1), of sum 1.
        after: Weights b after it, likewise, an array of the same kind.
        cost: One-way trading cost c, as a fraction, 0 ≤ c < 1; a number or of shape (...).
        highest: Upper bound on the cost if that is an array, since its values may be traced.
        gross: Upper bound on the sum of the assets' absolute weights in b.

    Returns:
        Remainder factors mu of shape (...), between (1−c)² and 1 for weights that are not negative.
    """
    xp = before.__array_namespace__()
    held, wanted = before[..., 1:], after[..., 1:]
    excess = held - wanted
    highest = cost if isinstance(cost, float | int) else highest
    steps = newton_steps(excess.shape[-1], highest, excess.dtype, gross)
    cost = xp.asarray(cost, dtype=excess.dtype)[..., None]
    selling, buying = -cost, cost / (1 - cost)

    def step(surplus: Any) -> Any:
        rate = (surplus > 0) * selling + (surplus < 0) * buying  # far faster than numpy's where
        return 1 + (rate * excess).sum(-1) / (1 + (rate * wanted).sum(-1))

    remainder = step(excess)
    for _ in range(steps - 1):
        last, remainder = remainder, step(held - remainder[..., None] * wanted)
        if xp is np and (remainder == last).all():  # traced values cannot be compared
            break
    return remainder


def newton_steps(assets: int, cost: float, dtype: Any, gross: float = 1.0) -> int:
    """Steps after which the remainder factor is exact to the last digit, for any weights.

    Let step j switch assets of total weight mⱼ (in b) from bought to sold. It multiplies the error
    by q·mⱼ or less, with q = 1/(1−c)² − 1. No asset switches twice, so the mⱼ sum to at most 1, and
    K steps leave at most (1 − (1−c)²)·(q/K)ᴷ. Nor can all N assets switch, because selling
    everything gains cash; so N steps leave nothing. At 10 bp that is 2 steps for 4-byte floats and
    5 for 8-byte ones, at 20% it is 7 and 12. Both bounds grow with the gross weight of the assets.
    """
    kept = (1 - cost) ** 2
    first, later = gross * (1 - kept), gross * (1 / kept - 1)
    digit = np.finfo(dtype).eps / 4
    steps = 1
    while steps < assets and first * (later / steps) ** steps > digit:
        steps += 1
    return steps


def traded(before: Any, after: Any, remainder: Any) -> Any:
    """Turnover: value bought plus value sold, as a share of the wealth before the trade.

    Args:
        before: Weights before the trade, of shape (..., N + 1).
        after: Weights after it.
        remainder: The remainder factor of the trade, of shape (...).

    Returns:
        Turnovers of shape (...), between 0 and 2.
    """
    return abs(remainder[..., None] * after[..., 1:] - before[..., 1:]).sum(-1)


def drift(weights: Any, relatives: Any) -> Any:
    """Weights after prices have moved, without a trade; cash earns nothing.

    Args:
        weights: Weights of shape (..., N + 1).
        relatives: New price over old price of each asset, of shape (..., N).

    Returns:
        Weights of shape (..., N + 1).
    """
    return grown(weights, with_cash(relatives))


def grown(weights: Any, growth: Any) -> Any:
    """Weights after each entry has grown by its factor, both of shape (..., N + 1)."""
    worth = weights * growth
    return worth / worth.sum(-1, keepdims=True)


def delisted(growth: Any, relatives: Any, listed: Any, cash: Any) -> Any:
    """Growth factors in which a delisted asset is paid out, and its payout earns what cash earns.

    The payout of a short position is taken from cash, so it costs what that would have earned.

    Args:
        growth: Growth factors of cash and of each asset, of shape (..., N + 1).
        relatives: New price over old price of each asset, of shape (..., N).
        listed: Whether each asset has a price at the end, of the same shape; None if all have one.
        cash: Growth factor of cash that is owned, of shape (..., 1).
    """
    if listed is None:
        return growth
    xp = growth.__array_namespace__()
    paid_out = relatives * cash
    return xp.concat([growth[..., :1], xp.where(listed > 0, growth[..., 1:], paid_out)], axis=-1)


def cashed(weights: Any, listed: Any) -> Any:
    """Weights of shape (..., N + 1), with those of unlisted assets in cash; listed: (..., N)."""
    kept = weights[..., 1:] * listed
    cash = weights[..., :1] + (weights[..., 1:] - kept).sum(-1, keepdims=True)
    return weights.__array_namespace__().concat([cash, kept], axis=-1)


def with_cash(relatives: Any) -> Any:
    """Price relatives of cash, which are 1, and of the assets: shape (..., N) becomes N + 1."""
    xp = relatives.__array_namespace__()
    return xp.concat([xp.ones_like(relatives[..., :1]), relatives], axis=-1)
