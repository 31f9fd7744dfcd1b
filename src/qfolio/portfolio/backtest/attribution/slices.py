"""A policy in pictures: the weight of one asset, against one quantity that it depends on.

The asset is the one that is held most. Its partner, the one held second most (or cash if there is
no other), gives what the asset gains: as the asset's signal rises, the partner's falls. Many
policies buy an asset only by selling others, and would not react to the signal of one asset alone.

Against the weight held, the picture shows the target of one decision: on the diagonal, nothing is
traded. Against a signal, it shows the weight at which the policy comes to rest if it decides again
and again while prices stand still. It starts with all that the two hold in the partner, and then
with all of it in the asset. A policy with a no-trade band rests at the band's two edges, others at
one weight.

All else is typical: other channels are at their mean in training (returns at 0), and the holding is
the mean over the test. A signal or feature has its value in the whole window, a return only in its
latest row.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from qfolio.core.mdp import Agent, task_jit
from qfolio.portfolio.backtest.attribution.replays import Observed, open_to, seen_in_test
from qfolio.portfolio.backtest.replay import Stretch
from qfolio.portfolio.task import Portfolio

POINTS = 17

SHOWN = 8
"""Largest number of folds whose policies are drawn, evenly spread."""

DECISIONS = 24
"""Decisions in a row until a policy rests; at a tenth of the way each, 92% of it is covered."""

TAIL = 0.01
"""Share of the signal's values that lies beyond each end of a slice."""


class Slice(msgspec.Struct, frozen=True):
    """Weights against one quantity, a line for each fold's policy."""

    name: str
    x: list[float]
    lines: list[list[float]]  # (fold, point); against a signal, those reached from below
    above: list[list[float]]  # those reached from above; empty against the holding
    shared: bool  # whether the quantity is changed for all assets at once


class Slices(msgspec.Struct, frozen=True):
    """The slices of one asset's weight."""

    asset: str
    partner: str
    holding: Slice  # against the weight held
    signals: list[Slice]  # those that vary in the test


def slices(
    agent: Agent,
    stretches: Sequence[Stretch],
    names: Sequence[str],
    assets: Sequence[str],
    held: np.ndarray,
    shared: Sequence[bool],
) -> Slices:
    """The slices of an agent's policy, the mean of all seeds.

    Args:
        stretches: The folds with its policies.
        names: Names of the channels that the agent observes.
        assets: Names of the assets.
        held: Weights held when deciding, shape (D, entry).
        shared: Whether a channel is the same for all assets.
    """
    there, typical = open_to(stretches), held.mean(0)
    tradable = there.all(0) if there.all(0).any() else there.any(0)
    order = np.argsort(-np.where(tradable, typical[1:], -1.0), kind="stable") + 1
    asset = int(order[0])
    partner = int(order[1]) if tradable.sum() > 1 else 0
    seen = seen_in_test(stretches)
    grids = []
    for channel in range(len(names)):
        low, high = np.quantile(seen[there, channel], (TAIL, 1 - TAIL)).tolist()
        grids.append(np.linspace(low, high, POINTS))
    entries = np.arange(1, len(typical))
    opposite = 1.0 * (entries == asset) - (entries == partner)
    who = np.array([tradable if everywhere else opposite for everywhere in shared])
    total = max(typical[asset] + typical[partner], 1 / len(typical))
    kept = np.linspace(0, total, POINTS)
    holdings = np.tile(typical, (POINTS, 1))
    holdings[:, [asset, partner]] = 0
    rest = holdings.sum(1, keepdims=True)
    holdings *= (1 - total) / np.where(rest > 0, rest, 1)
    holdings[:, asset], holdings[:, partner] = kept, total - kept
    holdings[:, 0] += 1 - holdings.sum(1)  # if the two are all that was held
    given = [jnp.asarray(x, jnp.float32) for x in (grids, who, holdings[[0, -1]], holdings)]
    places = np.unique(np.linspace(0, len(stretches) - 1, SHOWN).round().astype(int))
    lines = []
    for task, members, fold in (stretches[place] for place in places):
        row = jnp.array(fold.decisions.start, jnp.int32)
        lines.append([np.asarray(x) for x in _answers(task, agent, members, row, asset, *given)])
    rests, ordered = (np.stack(each) for each in zip(*lines, strict=True))
    return Slices(
        asset=assets[asset - 1],
        partner=("cash", *assets)[partner],
        holding=Slice("weight held", _short(kept), [_short(y) for y in ordered], [], False),
        signals=[
            Slice(
                name,
                _short(grids[i]),
                [_short(y) for y in rests[:, i, 0]],
                [_short(y) for y in rests[:, i, 1]],
                bool(same),
            )
            for i, (name, same) in enumerate(zip(names, shared, strict=True))
            if grids[i][0] < grids[i][-1]
        ],
    )


def answer(
    task: Portfolio,
    agent: Agent,
    members: PyTree,
    row: Array,
    features: Array,
    held: Array,
    spent: Array | float = 0.0,
) -> Float[Array, " entry"]:
    """The target weights at a row with the given features, the mean of all members."""
    asked = task.having(decides=jnp.ones_like(task.decides))  # on any day
    observed = jnp.swapaxes(features * task.scale + task.center, 0, 1)
    seen = Observed.given(asked, observed, row - task.window + 1)
    holding = seen.hold(held, spent)
    view = jax.tree.map(lambda x: x[None], seen.view(row, holding))

    def one(weights: PyTree) -> Array:
        return seen.target(row, holding, agent.policy(weights, view)[0])

    mean: Array = jax.vmap(one)(members).mean(0)
    return mean


@task_jit
def _answers(
    task: Portfolio, agent: Agent, members: PyTree, row: Array, asset: int,
    grids: Array, who: Array, starts: Array, holdings: Array,
) -> tuple[Float[Array, "channel start point"], Float[Array, " point"]]:  # fmt: skip
    count = grids.shape[0]
    blank = jnp.zeros((task.limits.shape[0], task.window, count))
    latest = jnp.arange(task.window) == task.window - 1

    def order(features: Array, held: Array) -> Array:
        return answer(task, agent, members, row, features, held)

    def rest(features: Array, held: Array) -> Array:
        decide = lambda _, held: order(features, held)  # noqa: E731
        return lax.fori_loop(0, DECISIONS, decide, held)[asset]

    def along(channel: Array) -> Array:
        rows = jnp.where(channel == 0, latest, True)
        place = who[channel][:, None, None] * rows[:, None] * (jnp.arange(count) == channel)
        scaled = (grids[channel] - task.center[channel]) / task.scale[channel]
        each = jax.vmap(lambda value, start: rest(blank + value * place, start), (0, None))
        return jax.vmap(each, (None, 0))(scaled, starts)

    ordered = jax.vmap(lambda held: order(blank, held)[asset])(holdings)
    return lax.map(along, jnp.arange(count)), ordered


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in values]
