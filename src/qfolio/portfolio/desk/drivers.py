"""Why these trades: how far each signal moves the target weights of one decision.

The integrated gradients of ``gradients.py`` at the latest row say it. An asset's change of weight
is the sum of what each channel contributes, relative to a typical observation (the mean in
training), and of a rest: the change from the weight held to the target of a typical observation.
Where the weights held break the limits of the mandate, the rest begins with what these require: the
change to the nearest weights that are allowed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from qfolio.core.mdp import Discrete
from qfolio.core.text import figure, listed
from qfolio.portfolio.backtest.attribution.gradients import integrated
from qfolio.portfolio.backtest.attribution.replays import channel_names
from qfolio.portfolio.desk.allocation import NOISE, Allocation
from qfolio.portfolio.following import on_table
from qfolio.portfolio.mandate.feasible import GROSS, TURNOVER, Feasible, Mandated
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

TRADES = 3
"""Number of largest trades that are explained."""

SHOWN = 3
"""Number of largest contributions that are shown for each trade."""


VISIBLE = 5e-5
"""Smaller changes of a weight are not named."""


class Driver(msgspec.Struct, frozen=True):
    """A channel's contribution to an asset's target weight."""

    name: str
    weight: float


class Reason(msgspec.Struct, frozen=True):
    """A trade and what drives it: the change is the sum of all drivers and the rest."""

    asset: str
    change: float  # target weight minus the weight held
    drivers: list[Driver]  # every channel, the largest first
    rest: float  # with a typical observation, the weight would change by this
    required: float = 0.0  # part of the rest that the limits on weights require
    bounds: tuple[str, ...] = ()  # the limits that the target reaches
    beyond: bool = False  # whether the order exceeds the limit of turnover, as others require


def reasons(
    policy: Policy, prices: Prices, allocation: Allocation, spent: float = 0.0
) -> list[Reason]:
    """The largest changes of weight, and what drives them; empty for a policy with a menu.

    They are those of the whole order, if it is filled over several rows.

    Args:
        policy: The policy that was followed.
        prices: The table that it decided on.
        allocation: Its targets.
        spent: Turnover since the calendar year began, as for ``Allocation.of``.
    """
    if isinstance(policy.task.actions, Discrete):
        return []
    change = (allocation.weights - allocation.held)[1:]
    held = jnp.asarray(allocation.held[None], jnp.float32)
    row = jnp.array([len(prices) - 1], jnp.int32)
    task, used = on_table(policy.task, prices).filled_at_once(), jnp.asarray(spent, jnp.float32)
    allowed, nearest = _allowed(task, row[0], held[0], used)
    required = (np.asarray(nearest, float) - allocation.held)[1:]
    bounds = _bounds(allowed, allocation.weights, allocation.held)
    over = _over(allowed, allocation.weights, allocation.held)
    beyond = bool(over.get(TURNOVER, 0.0) > VISIBLE)
    moved = np.asarray(integrated(task, policy.agent, policy.members, row, held, used)[0])[0]
    names = channel_names(policy.task, policy.features)
    found = []
    for i in np.argsort(-abs(change), kind="stable")[:TRADES]:
        if abs(change[i]) > NOISE:
            drivers = [Driver(names[c], float(moved[c, i])) for c in np.argsort(-abs(moved[:, i]))]
            rest = float(change[i] - moved[:, i].sum())
            asset, by, needs = allocation.assets[i], float(change[i]), float(required[i])
            found.append(Reason(asset, by, drivers, rest, needs, bounds[i], beyond))
    return found


@eqx.filter_jit
def _allowed(
    task: Portfolio, row: jax.Array, held: jax.Array, spent: jax.Array
) -> tuple[Feasible, jax.Array]:
    """The weights that may be ordered at a row, and the nearest of them to those held."""
    left = task.terms.unspent(task.terms.begin(held, spent))
    allowed = task.feasible_at(row).spending(left)
    return allowed, allowed.project(held, held)


def _over(allowed: Feasible, weights: np.ndarray, held: np.ndarray) -> dict[str, float]:
    """By how much each limit of a mandate is exceeded; negative below it."""
    return allowed.violations(weights, held) if isinstance(allowed, Mandated) else {}


def _bounds(allowed: Feasible, weights: np.ndarray, held: np.ndarray) -> list[tuple[str, ...]]:
    """The limits that each asset's target reaches; all weights of shape (entry,), cash first."""
    limits = jax.tree.map(np.asarray, allowed.limits)  # type: ignore[attr-defined]
    assets = weights[1:]
    low, high = (limits.low, limits.high) if isinstance(allowed, Mandated) else (0.0, limits)
    ends = (np.broadcast_to(bound, assets.shape).tolist() for bound in (low, high))
    found: list[list[str]] = [[] for _ in assets]
    for each, weight, low, high in zip(found, assets.tolist(), *ends, strict=True):
        if low == high == 0:
            each.append("zero because it may not be held")
        elif weight >= high - VISIBLE and high < 1:
            each.append(f"its cap of {figure(high, '.2%')}")
        elif weight <= low + VISIBLE and low != 0:
            each.append(f"its floor of {figure(low, '.2%')}")
    if isinstance(allowed, Mandated):
        over = _over(allowed, weights, held)
        for bound, members in zip(allowed.bounds, limits.rows != 0, strict=True):
            if over[bound.violation] >= -VISIBLE and bound.what != "cash":
                for member in np.flatnonzero(members):
                    found[member].append(f"the {bound.side} of {bound.what}")
        for said, violation in (("gross exposure", GROSS), ("turnover", TURNOVER)):
            if abs(over[violation]) <= VISIBLE:
                for each in found:
                    each.append(f"the limit of {said}")
    return [tuple(each) for each in found]


def sentence(reason: Reason) -> str:
    """A reason in words: what the limits require, the largest drivers, and the limits reached."""
    moving = [each for each in reason.drivers if abs(each.weight) >= VISIBLE]
    change = f"{reason.asset} {figure(reason.change, '+.2%')}:"
    if abs(reason.required) >= VISIBLE:
        change += f" the limits on weights require {figure(reason.required, '+.2%')};"
    reached = f" The target is at {listed(reason.bounds)}." if reason.bounds else ""
    if reason.beyond:
        reached += " The order is beyond the limit of turnover, which yields to the other limits."
    if not moving:
        return f"{change} no signal moves it, so that it is the same on a typical day.{reached}"
    shown = [f"{each.name} {figure(each.weight, '+.2%')}" for each in moving[:SHOWN]]
    if len(moving) > SHOWN:
        others = sum(each.weight for each in moving[SHOWN:])
        shown.append(f"other signals {figure(others, '+.2%')}")
    return (
        f"{change} {', '.join(shown)}; on a typical day it would be "
        f"{figure(reason.rest, '+.2%')}.{reached}"
    )
