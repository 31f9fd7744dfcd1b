"""Exact costs of trading and holding: the same code for training and backtest.

A ``CostModel`` gives the wealth that remains after a trade and the growth of a holding; a market's
``cost_model=NAME`` names one. ``Proportional``, a share of the value traded, is built in.

Weights have a last axis of N + 1 entries, cash first, and sum to 1. Every function works on numpy
and jax arrays (also under jit, vmap and grad) and broadcasts over leading axes.

A sale of value s yields (1−c)s of cash, and spending m buys (1−c)m worth of the asset.
Paying for a rebalancing from weights w to weights b leaves the share mu of the wealth, the
"transaction remainder factor" (Z. Jiang, D. Xu, J. Liang, "A deep reinforcement learning framework
for the financial portfolio management problem", 2017, eq. 14), which solves

    mu·b₀ = w₀ + (1−c)·Σᵢ (wᵢ − mu·bᵢ)⁺ − Σᵢ (mu·bᵢ − wᵢ)⁺ / (1−c),

where the sums run over the assets, without cash.
"""

import abc
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np


class Context(NamedTuple):
    """The circumstances of a trade, or of a holding period, besides relatives."""

    rows: Any = 1  # number of rows: from the decision to its trade, or of the holding period


class CostModel(abc.ABC):
    """Costs of trading and holding; every method takes numpy and jax arrays, also traced ones.

    A model is a dataclass with a default for each field; a field with the name of a market's
    setting (such as ``cost``) takes its value.
    """

    @abc.abstractmethod
    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        """The share of wealth that remains after a rebalancing, and its cost.

        Args:
            before: Weights before the trade, of shape (..., N + 1), not negative, of sum 1.
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
            Growth factors of shape (..., N + 1), cash first.
        """


@dataclass(frozen=True)
class Proportional(CostModel):
    """A share of the value traded, one way; holding costs nothing and cash earns nothing."""

    cost: float = 0.001

    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        remainder = remainder_factor(before, after, self.cost)
        return remainder, {"proportional": 1 - remainder}

    def carry(self, relatives: Any, context: Context) -> Any:
        return with_cash(relatives)


def remainder_factor(before: Any, after: Any, cost: Any, *, highest: float = 0.2) -> Any:
    """The share of wealth that remains after paying for a rebalancing.

    Right side minus left side of the equation above is decreasing, concave and piecewise linear in
    mu, so that Newton's method from mu = 1 descends to the root without overshooting. A step, with
    gᵢ = −c for the assets sold at mu, c/(1−c) for those bought and 0 for the rest, is

        mu ← 1 + Σᵢ gᵢ(wᵢ − bᵢ) / (1 + Σᵢ gᵢbᵢ),

    because both weights sum to 1. ``newton_steps`` gives the number of steps for an exact result.

    Without a trade or a cost it is exactly 1. Derivatives are exact, too: the last step is the
    closed form on the right piece, and the choice of the piece has no derivative. They hold along
    the simplex, as cash does not appear in the formula. At the kink, where wᵢ = mu·bᵢ, an asset's
    trade is free to first order, which lies between the two one-sided derivatives.

    Args:
        before: Weights w before the trade, of shape (..., N + 1), not negative, of sum 1.
        after: Weights b after it, likewise, an array of the same kind.
        cost: One-way trading cost c, as a fraction, 0 ≤ c < 1; a number or of shape (...).
        highest: Upper bound of the cost if it is an array, whose values are not read.

    Returns:
        Remainder factors mu of shape (...), between (1−c)² and 1.
    """
    xp = before.__array_namespace__()
    held, wanted = before[..., 1:], after[..., 1:]
    excess = held - wanted
    steps = newton_steps(
        excess.shape[-1], cost if isinstance(cost, float | int) else highest, excess.dtype
    )
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


def newton_steps(assets: int, cost: float, dtype: Any) -> int:
    """Steps after which the remainder factor is exact to the last digit, for any weights.

    Let step j switch assets of total weight mⱼ (in b) from bought to sold. It multiplies the error
    by q·mⱼ or less, with q = 1/(1−c)² − 1. No asset switches twice, so the mⱼ sum to at most 1, and
    K steps leave at most (1 − (1−c)²)·(q/K)ᴷ. Nor can all N assets switch, because selling
    everything gains cash; so N steps leave nothing. At 10 bp that is 2 steps for 4-byte floats and
    5 for 8-byte ones, at 20 % it is 7 and 12.
    """
    kept = (1 - cost) ** 2
    digit = np.finfo(dtype).eps / 4
    steps = 1
    while steps < assets and (1 - kept) * ((1 / kept - 1) / steps) ** steps > digit:
        steps += 1
    return steps


def traded(before: Any, after: Any, remainder: Any) -> Any:
    """Turnover: value bought plus value sold, over the wealth before the trade.

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


def with_cash(relatives: Any) -> Any:
    """Relatives of the assets, of shape (..., N), with cash, whose relative is 1, before them."""
    xp = relatives.__array_namespace__()
    return xp.concat([xp.ones_like(relatives[..., :1]), relatives], axis=-1)
