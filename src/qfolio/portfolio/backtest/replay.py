"""The decisions of trained agents over the folds of a backtest."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import PyTree

from qfolio.core.mdp import Agent
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.simulation import Simulation
from qfolio.portfolio.following import follow
from qfolio.portfolio.task import Portfolio


@dataclass(frozen=True)
class Entry:
    """A strategy in the backtest."""

    kind: str  # one of assessment.KINDS
    decisions: np.ndarray  # (seed, day, entry), cash first
    simulation: Simulation  # of shape (seed, day)

    @cached_property
    def mean_weights(self) -> np.ndarray:
        """Weights after each trade, cash first, the mean over the seeds, shape (day, entry)."""
        weights = self.simulation.weights
        return weights[0] if len(weights) == 1 else np.asarray(weights.mean(0))


class Stretch(NamedTuple):
    """A fold with the agents trained on it."""

    task: Portfolio  # the part of the table that the fold trained on
    members: PyTree  # the agents' weights, with a leading seed axis
    fold: Fold


def decide(agent: Agent, stretches: Sequence[Stretch], seeds: int, *, together: bool) -> np.ndarray:
    """Decisions over all folds, (seed, day, entry); each fold starts with the last one's holding.

    With ``together`` one portfolio follows the mean of all seeds, and ``seeds`` is 1. The agents
    see their portfolio in float32; the replay is in float64.
    """
    held = np.zeros((seeds, 1 + len(stretches[0].task.limits)))
    held[:, 0] = 1.0
    days = [fold.decisions.stop - fold.decisions.start for *_, fold in stretches]
    parts = []
    for (task, members, fold), count in zip(stretches, days, strict=True):
        # One length for all folds, so that one program serves all; the surplus is cut off.
        start = fold.decisions.start
        targets, after = follow(task, agent, members, start, held, max(days), together=together)
        parts.append(targets[:, :count])
        held = after[:, count - 1]
    return np.concatenate(parts, axis=1)
