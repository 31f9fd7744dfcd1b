"""What a signal is worth: the annual growth that is lost without it.

The policy is replayed on the same days, at the same costs, while it sees one signal shuffled
(permutation importance, Breiman 2001; measured in net growth after Jensen, Kelly, Malamud &
Pedersen). Signals that differ between assets are shuffled among the assets, those that all assets
share in blocks of time.
"""

from collections.abc import Sequence

import jax
import msgspec
import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.mdp import Agent
from qfolio.portfolio.backtest.attribution.hac import mean_t
from qfolio.portfolio.backtest.attribution.replays import (
    Shuffle,
    Shuffles,
    replay,
)
from qfolio.portfolio.backtest.replay import Stretch
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.market import RUIN

DRAWS = 3
"""Number of shuffles of each signal."""

WORK = 4e9
"""Most observed numbers that the replays of an agent may read, which takes seconds on two cores. If
there are more, each signal is shuffled once only; if still more, only the first seed is followed;
and beyond that, only everything at once is shuffled."""

SEED = 0

UNMOVED = 1e-5
"""Targets that move by less do not depend on what was shuffled; they are computed in float32."""

EVERYTHING = "all together"


class Worth(msgspec.Struct, frozen=True):
    """The annual growth that is lost without a signal; negative if the policy does better then."""

    name: str
    lost: float  # mean over the draws
    low: float  # smallest over the draws
    high: float  # largest over the draws
    t: float  # HAC t-statistic of the mean over the days
    shared: bool  # whether it was shuffled in time; otherwise among the assets


class Importance(msgspec.Struct, frozen=True):
    """The worth of each signal, and of all at once."""

    signals: list[Worth]  # none if the replays would take too long
    everything: Worth
    ignored: bool  # whether no shuffle of everything moves any target
    draws: int
    seeds: int  # number of seeds that the policy is the mean of
    replays: int


def importance(
    agent: Agent,
    stretches: Sequence[Stretch],
    names: Sequence[str],
    values: Floats,
    periods_per_year: float,
) -> tuple[Importance, np.ndarray]:
    """Replay an agent's policy, the mean of its seeds, without each of its signals.

    Args:
        stretches: The folds with its policies.
        names: Names of the channels that the agent observes.
        values: Prices, shape (rows, N).
        periods_per_year: Sets the length of blocks, a quarter of a year.

    Returns:
        The worth of each channel, and the weights held when deciding, shape (D, entry).
    """
    signals, draws, seeds = _affordable(stretches, len(names))
    stretches = of_seeds(stretches, seeds)
    count = len(names) if signals else 0
    block = max(1, round(periods_per_year / 4))
    shuffles = Shuffles.drawn(stretches, draws, block, SEED)
    shared = shuffles.shared[:count].astype(int).tolist()
    each_draw = range(1, draws + 1)
    wanted = [Shuffle(np.zeros(len(names), int), 0, 0)]
    for mask, in_time in zip(np.eye(len(names), dtype=int)[:count], shared, strict=True):
        wanted += [Shuffle(mask, draw * in_time, draw * (1 - in_time)) for draw in each_draw]
    wanted += [Shuffle(np.ones(len(names), int), draw, draw) for draw in each_draw]

    task, first = stretches[0].task, stretches[0].fold.decisions.start
    # Those of the task are float32, which the exact replay would take over.
    conditions = jax.tree.map(lambda x: np.asarray(x, float), task.conditions)
    logs: list[Floats] = []
    moved: list[float] = []
    for group in replay(agent, stretches, shuffles, wanted):
        if not logs:
            targets, held = group.targets[0], group.held[0]
        for each in group.targets:
            moved.append(float(abs(each - targets).max()))
            weights = each.astype(float)
            weights /= weights.sum(-1, keepdims=True)
            replayed = simulate(
                values,
                weights,
                first=first,
                cost=task.costs,
                lag=task.lag,
                conditions=conditions,
                long_only=task.feasible.long_only,
            )
            # Growth after ruin is not finite; use the floor of training.
            logs.append(np.maximum(replayed.growth, np.log(RUIN)))
    lost = logs[0] - np.array(logs[1:])
    lost[np.array(moved[1:]) < UNMOVED] = 0
    lost = lost.reshape(count + 1, draws, -1)
    each = periods_per_year * lost.mean(2)
    worth = [
        Worth(
            name,
            float(each[i].mean()),
            float(each[i].min()),
            float(each[i].max()),
            mean_t(lost[i].mean(0)),
            bool(i < count and shared[i]),
        )
        for i, name in enumerate([*names[:count], EVERYTHING])
    ]
    ignored = bool(max(moved[-draws:]) < UNMOVED)
    return Importance(worth[:-1], worth[-1], ignored, draws, seeds, len(wanted)), held


def of_seeds(stretches: Sequence[Stretch], count: int) -> list[Stretch]:
    """The folds with the policies of the first seeds only."""
    few = lambda tree: jax.tree.map(lambda x: x[:count], tree)  # noqa: E731
    return [each._replace(members=few(each.members)) for each in stretches]


def _affordable(stretches: Sequence[Stretch], count: int) -> tuple[bool, int, int]:
    """Whether to shuffle signals one by one, the number of draws, and the number of seeds."""
    task = stretches[0].task
    seeds = int(jax.tree.leaves(stretches[0].members)[0].shape[0])
    days = sum(fold.days for *_, fold in stretches)
    read = days * task.limits.shape[0] * task.window * count
    for draws, followed in ((DRAWS, seeds), (1, seeds), (1, 1)):
        if read * followed * (1 + draws * (count + 1)) <= WORK:
            return True, draws, followed
    return False, 1, 1
