"""Why these trades: how far each signal moves the target weights of one decision.

The integrated gradients of ``gradients.py`` at the latest row say it. An asset's change of weight
is the sum of what each channel contributes, relative to a typical observation (the mean in
training), and of a rest: the change from the weight held to the target of a typical observation.
"""

import jax.numpy as jnp
import msgspec
import numpy as np

from qfolio.core.mdp import Discrete
from qfolio.core.text import figure
from qfolio.portfolio.backtest.attribution.gradients import integrated
from qfolio.portfolio.backtest.attribution.replays import channel_names
from qfolio.portfolio.desk.allocation import NOISE, Allocation
from qfolio.portfolio.following import on_table
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.prices.table import Prices

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


def reasons(policy: Policy, prices: Prices, allocation: Allocation) -> list[Reason]:
    """The largest changes of weight, and what drives them; empty for a policy with a menu.

    Args:
        policy: The policy that was followed.
        prices: The table that it decided on.
        allocation: Its targets.
    """
    if isinstance(policy.task.actions, Discrete):
        return []
    change = (allocation.weights - allocation.held)[1:]
    held = jnp.asarray(allocation.held[None], jnp.float32)
    row = jnp.array([len(prices) - 1], jnp.int32)
    task = on_table(policy.task, prices)
    moved = np.asarray(integrated(task, policy.agent, policy.members, row, held)[0])[0]
    names = channel_names(policy.task, policy.features)
    found = []
    for i in np.argsort(-abs(change), kind="stable")[:TRADES]:
        if abs(change[i]) > NOISE:
            drivers = [Driver(names[c], float(moved[c, i])) for c in np.argsort(-abs(moved[:, i]))]
            rest = float(change[i] - moved[:, i].sum())
            found.append(Reason(allocation.assets[i], float(change[i]), drivers, rest))
    return found


def sentence(reason: Reason) -> str:
    """A reason in words, with its largest drivers."""
    moving = [each for each in reason.drivers if abs(each.weight) >= VISIBLE]
    if not moving:
        change = f"{reason.asset} {figure(reason.change, '+.2%')}"
        return f"{change}: no signal moves it, so that it is the same on a typical day."
    shown = [f"{each.name} {figure(each.weight, '+.2%')}" for each in moving[:SHOWN]]
    if len(moving) > SHOWN:
        others = sum(each.weight for each in moving[SHOWN:])
        shown.append(f"other signals {figure(others, '+.2%')}")
    return (
        f"{reason.asset} {figure(reason.change, '+.2%')}: {', '.join(shown)}; on a typical day it "
        f"would be {figure(reason.rest, '+.2%')}."
    )
