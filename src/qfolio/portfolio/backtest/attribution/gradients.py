"""Integrated gradients of target weights: how far each signal moves them (Sundararajan, Taly & Yan
2017, "Axiomatic attribution for deep networks").

For target weights f(x) of an observation x, relative to a typical observation x₀ (0, the mean in
training), channel c moves the weights by ∫₀¹ ∂f/∂x_c (x₀ + α(x − x₀)) · (x − x₀)_c dα. Over all
channels this adds up to f(x) − f(x₀), with the holding and the anchor unchanged. The integral is a
mean over midpoints, and each directional derivative takes one forward pass.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from qfolio.core.mdp import Agent, task_jit
from qfolio.portfolio.backtest.attribution.replays import open_to
from qfolio.portfolio.backtest.attribution.slices import answer
from qfolio.portfolio.backtest.replay import Stretch
from qfolio.portfolio.task import Portfolio

DAYS = 24
"""Number of days of the test that are examined, evenly spread; at least one in each fold."""

STEPS = 16


class Pull(msgspec.Struct, frozen=True):
    """How far a channel moves target weights."""

    name: str
    size: float  # mean absolute change of an asset's weight
    direction: float  # correlation of that change with the asset's latest value, from −1 to 1


class Gradients(msgspec.Struct, frozen=True):
    """Integrated gradients, averaged over days and assets."""

    pulls: list[Pull]
    days: int
    whole: float  # mean absolute change by all channels together
    gap: float  # mean absolute error of their sum, due to the midpoint rule


def integrated_gradients(
    agent: Agent, stretches: Sequence[Stretch], names: Sequence[str], held: np.ndarray
) -> Gradients | None:
    """Attribute an agent's target weights, the mean of all seeds.

    None if it has a menu, or if no asset could be bought on any of the days.

    Args:
        stretches: The folds with its policies.
        names: Names of the channels that the agent observes.
        held: Weights held when deciding, shape (D, entry).
    """
    if stretches[0].task.menu:
        return None
    each = -(-DAYS // len(stretches))
    begin = stretches[0].fold.decisions.start
    days, parts, seen, whole, gaps = 0, [], [], [], []
    there = open_to(stretches)
    for task, members, fold in stretches:
        rows = np.linspace(fold.decisions.start, fold.decisions.stop - 1, each + 2)[1:-1].astype(
            int
        )
        holding = jnp.asarray(held[rows - begin], jnp.float32)
        given = jnp.asarray(rows, jnp.int32), holding
        moved, latest, change = (np.asarray(x) for x in integrated(task, agent, members, *given))
        bought = there[rows - begin]
        if not bought.any():
            continue
        days += int(bought.any(1).sum())
        parts.append(moved.swapaxes(1, 2)[bought])
        seen.append(latest[bought])
        whole.append(abs(change[bought]).mean())
        gaps.append(abs(moved.sum(1) - change)[bought].mean())
    if not parts:
        return None
    pulled, shown = np.concatenate(parts), np.concatenate(seen)
    return Gradients(
        pulls=[
            Pull(name, float(abs(pulled[:, c]).mean()), _correlation(pulled[:, c], shown[:, c]))
            for c, name in enumerate(names)
        ],
        days=days,
        whole=float(np.mean(whole)),
        gap=float(np.mean(gaps)),
    )


@task_jit
def integrated(
    task: Portfolio,
    agent: Agent,
    members: PyTree,
    rows: Array,
    held: Array,
    spent: Array | float = 0.0,
) -> tuple[
    Float[Array, "day channel asset"], Float[Array, "day asset channel"], Float[Array, "day asset"]
]:
    """How far each channel moves weights at some rows, its latest values, and the whole change.

    members: the agents' weights, with a leading seed axis. held: weights held at the rows. spent:
    turnover since the calendar year began.
    """
    places = (jnp.arange(STEPS) + 0.5) / STEPS

    def day(given: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        row, held = given
        features = task.features(row)

        def targets(features: Array) -> Array:
            return answer(task, agent, members, row, features, held, spent)[1:]

        def pull(channel: Array) -> Array:
            along = features * (jnp.arange(features.shape[-1]) == channel)
            slope = lambda share: jax.jvp(targets, (share * features,), (along,))[1]  # noqa: E731
            return jax.vmap(slope)(places).mean(0)

        def pulls_back(share: Array) -> Array:
            _, back = jax.vjp(targets, share * features)
            each = jnp.eye(features.shape[0])
            return lax.map(lambda asset: (back(asset)[0] * features).sum((0, 1)), each).T

        # A mandate's orders have derivatives in reverse only; forward, there are fewer to compute.
        if task.mandate:
            pulls = lax.map(pulls_back, places).mean(0)
        else:
            pulls = lax.map(pull, jnp.arange(features.shape[-1]))
        end, start = jax.vmap(targets)(jnp.stack([features, 0 * features]))
        return pulls, features[:, -1], end - start

    found: tuple[Array, Array, Array] = lax.map(day, (rows, held))
    return found


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    if x.std() < 1e-9 or y.std() < 1e-9:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])
