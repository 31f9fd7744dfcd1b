"""What trading and holding cost, charged exactly: the same lines for training and backtest.

A ``CostModel`` says what is left of the wealth after a trade and what is held grows to; a market's
``cost_model=NAME`` names one. ``Proportional`` is the one that there is: a share of what is traded.

Weights have a last axis of N + 1 entries, cash first, and sum to 1. Every function works on numpy
and on jax arrays (under jit, vmap and grad, too) and broadcasts over leading axes.

Whoever sells for a value s receives (1−c)s, whoever spends m gets (1−c)m worth of the asset.
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
    """What a market knows at a trade, or of a stretch of holding, besides relatives."""

    rows: Any = 1  # how many pass: from the decision to its trade, or while holding


class CostModel(abc.ABC):
    """Costs of trading and of holding; every method takes numpy and jax arrays, traced ones too.

    A model is a dataclass with a default for each field; one that is called like a setting of the
    market (such as ``cost``) takes its value.
    """

    @abc.abstractmethod
    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        """What is left of each unit of wealth after a rebalancing, and what it cost.

        Args:
            before: Weights before the trade, of shape (..., N + 1), not negative, of sum 1.
            after: Weights after it, likewise.
            context: Of the trade.

        Returns:
            Remainder factors of shape (...), exactly 1 where nothing is traded; and the shares of
            wealth paid, of the same shape, by kind of cost, whose sum is 1 less the factor.
        """

    @abc.abstractmethod
    def carry(self, relatives: Any, context: Context) -> Any:
        """What a unit of cash and of each asset grows to while it is held.

        Args:
            relatives: New price over old price of each asset, of shape (..., N).
            context: Of the stretch; ``rows`` is a number or of shape (...).

        Returns:
            Growth factors of shape (..., N + 1), cash first.
        """


@dataclass(frozen=True)
class Proportional(CostModel):
    """A share of what is traded, one way; holding costs nothing and cash earns nothing."""

    cost: float = 0.001

    def trade(self, before: Any, after: Any, context: Context) -> tuple[Any, dict[str, Any]]:
        remainder = remainder_factor(before, after, self.cost)
        return remainder, {"proportional": 1 - remainder}

    def carry(self, relatives: Any, context: Context) -> Any:
        return with_cash(relatives)


def remainder_factor(before: Any, after: Any, cost: Any, *, highest: float = 0.2) -> Any:
    """What is left of each unit of wealth after a rebalancing is paid for.

    Right side minus left side of the equation above is decreasing, concave and piecewise linear in
    mu, so that Newton's method from mu = 1 falls to the root and never passes it. A step, with
    gᵢ = −c for the assets that mu says are sold, c/(1−c) for those bought and 0 for the rest, is

        mu ← 1 + Σᵢ gᵢ(wᵢ − bᵢ) / (1 + Σᵢ gᵢbᵢ),

    because both weights sum to 1. `newton_steps` says how many are exact.

    Nothing traded or no cost gives exactly 1. Derivatives are exact, too: the last step is the
    closed form on the right piece, and who belongs to which sum has no derivative. They hold along
    the simplex, as cash does not appear in the formula. At the kink, where wᵢ = mu·bᵢ, an asset's
    trade counts as free to first order, which lies between the two one-sided derivatives.

    Args:
        before: Weights w before the trade, of shape (..., N + 1), not negative, of sum 1.
        after: Weights b after it, likewise, an array of the same kind.
        cost: Cost c of trading one way, as a fraction, 0 ≤ c < 1; a number or of shape (...).
        highest: What the cost never exceeds where it is an array, whose values are not looked at.

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
        rate = (surplus > 0) * selling + (surplus < 0) * buying  # numpy's where is far slower
        return 1 + (rate * excess).sum(-1) / (1 + (rate * wanted).sum(-1))

    remainder = step(excess)
    for _ in range(steps - 1):
        last, remainder = remainder, step(held - remainder[..., None] * wanted)
        if xp is np and (remainder == last).all():  # what is traced cannot be looked at
            break
    return remainder


def newton_steps(assets: int, cost: float, dtype: Any) -> int:
    """Steps after which the remainder factor is exact to the last digit, whatever the weights.

    Say that step j turns assets of total weight mⱼ (in b) from bought to sold. Then it shrinks the
    error by the factor q·mⱼ or more, with q = 1/(1−c)² − 1. No asset turns twice, so the mⱼ sum to
    at most 1, and K steps leave at most (1 − (1−c)²)·(q/K)ᴷ. Nor can all N assets turn, for who
    sells everything gains cash; so N steps leave nothing. At 10 bp that is 2 steps for 4-byte
    floats and 5 for 8-byte ones, at 20 % it is 7 and 12.
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
    """Weights after prices have moved and nobody has traded, where cash earns nothing.

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
    """Relatives of the assets, of shape (..., N), with cash, which always has 1, before them."""
    xp = relatives.__array_namespace__()
    return xp.concat([xp.ones_like(relatives[..., :1]), relatives], axis=-1)
