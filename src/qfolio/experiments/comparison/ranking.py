"""The ranking of several agents on one task: measures of each, and tests of all pairs.

A result is graded by its regret, the share of the exact optimum's return that it misses, or by its
return if no optimum is known. Intervals are bootstraps over seeds (``qfolio.core.statistics``).
Agents are told apart if an exact rank test of their seeds rejects equality, with Holm's correction
for the number of pairs: intervals from few seeds are too narrow, and among many pairs one easily
differs by chance. Seeds of two agents count as independent; if they share random numbers (such as
initial weights), the test is conservative.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.statistics import (
    FEWEST_SEEDS,
    bootstrap_interval,
    holm,
    interquartile_mean,
    probability_of_improvement,
    rank_test,
    regret,
)

THRESHOLDS = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Regret thresholds at which learning curves are compared."""

HEADLINE = 0.1
"""The threshold that tables and sentences use."""

LEVEL = 0.05
"""Family-wise error rate: probability that the tests tell any two equal agents apart."""


@dataclass(frozen=True)
class Result:
    """The results of one agent's seeds, and their cost; JSON values only.

    Attributes:
        returns: Mean return of each seed's final policy on the fixed starts.
        optimum: The exact optimum on the same starts; None if it is unknown.
        starts, curve_starts: Number of start states in the final grades and on the learning curve.
        curve_steps: Environment steps of a seed at each point of the learning curve.
        curve_returns: Greedy returns there, a row for each point.
        curve_optimum: The exact optimum on the starts of the curve.
        episodes, env_steps: Training episodes and steps of each seed.
        seconds_train, seconds_compile: Time for all seeds, side by side.
        seconds_per_seed: Training time, on one core or as a share of its device.
        steps_per_second: Environment steps of all seeds.
        operations_per_step: Multiplications and additions in matrix products for each
            environment step, learning included; None if nothing is compiled.
        state_bytes: A seed's training state: weights, optimizer, replay, environments.
        policy_bytes, parameters: The size of the policy, in bytes and in numbers.
    """

    returns: list[float]
    optimum: float | None
    starts: int
    curve_starts: int
    curve_steps: list[int]
    curve_returns: list[list[float]]
    curve_optimum: float | None
    episodes: int
    env_steps: int
    seconds_train: float
    seconds_compile: float
    seconds_per_seed: float
    steps_per_second: float
    operations_per_step: float | None
    state_bytes: int
    policy_bytes: int
    parameters: int


def rank(results: dict[str, Result]) -> dict[str, Any]:
    """The ranking of two or more agents, as JSON values.

    "measure" is "regret" (a share of the optimum, lower is better) or "return"; "order" names the
    agents, best first; "agents" holds the measures of each, "pairs" the tests of all pairs.
    "common_steps" is the shortest training, up to which "area" averages the learning curves.
    """
    # There is no share of zero.
    graded = all(result.optimum and result.curve_optimum for result in results.values())
    sign = -1.0 if graded else 1.0  # a large score is good
    scores = {name: sign * _final(result, graded) for name, result in results.items()}
    goal = max(float(interquartile_mean(result.curve_returns[-1])) for result in results.values())
    common = min(result.env_steps for result in results.values())
    agents = {
        name: _measures(result, sign * scores[name], graded, goal, common)
        for name, result in results.items()
    }
    order = sorted(results, key=lambda name: sign * agents[name]["final"]["iqm"], reverse=True)
    return {
        "measure": "regret" if graded else "return",
        "seeds": min(len(result.returns) for result in results.values()),
        "seeds_needed": fewest_seeds(math.comb(len(results), 2)),
        "order": order,
        "goal": None if graded else goal,
        "common_steps": common,
        "agents": agents,
        "pairs": _pairs(scores, order, sign),
    }


def curve(result: Result, measure: str) -> Floats:
    """The learning curve of each seed in the ranking's measure, of shape (point, seed)."""
    if measure == "return":
        return np.asarray(result.curve_returns, dtype=float)
    missed = regret(result.curve_returns, result.curve_optimum)
    assert missed is not None
    return missed


def steps_within(steps: Sequence[int], regrets: Floats, threshold: float) -> list[int | None]:
    """For each seed, the steps after which its regret stays within the threshold; None if never.

    steps: environment steps at the points. regrets: of shape (point, seed).
    """
    outside = ~(regrets <= threshold)
    # The first point after the last one outside.
    first = len(outside) - np.argmax(outside[::-1], axis=0)
    first = np.where(outside.any(0), first, 0)
    return [int(steps[i]) if i < len(steps) else None for i in first.tolist()]


def middle_steps(steps: Sequence[int | None]) -> float | None:
    """The interquartile mean of steps; seeds that never arrive count as slower than all others.

    None if one of these lies in the middle half.
    """
    arrived = [float(count) for count in steps if count is not None]
    if len(arrived) < 0.75 * len(steps):
        return None
    late = [max(arrived)] * (len(steps) - len(arrived))  # outside the middle half
    return float(interquartile_mean(arrived + late))


def area(steps: Sequence[int], values: Floats, until: int) -> Floats:
    """Mean of each curve up to step ``until``, for values of shape (point, seed)."""
    ends = np.append([x for x in steps if x < until], until)
    heights = np.stack([np.interp(ends, steps, column) for column in values.T])
    if len(ends) == 1:  # a curve whose earlier points were lost
        return heights[:, 0]
    return np.asarray(np.trapezoid(heights, ends, axis=-1) / (ends[-1] - ends[0]))


def fewest_seeds(pairs: int) -> int:
    """The fewest seeds with which the rank test can tell agents apart among this many pairs."""
    return next(n for n in range(1, 100) if 2 * pairs / math.comb(2 * n, n) <= LEVEL)


def _final(result: Result, graded: bool) -> Floats:
    if not graded:
        return np.asarray(result.returns, dtype=float)
    missed = regret(result.returns, result.optimum)
    assert missed is not None
    return missed


def _measures(
    result: Result, final: Floats, graded: bool, goal: float, common: int
) -> dict[str, Any]:
    """The measures of one agent, as JSON values.

    final: regrets or returns of the seeds. goal: the best return, if no optimum is known.
    """
    returns = np.asarray(result.curve_returns, dtype=float)
    missed = regret(returns, result.curve_optimum if graded else goal)
    heights = curve(result, "regret" if graded else "return")
    areas = area(result.curve_steps, heights, common)
    return {
        "final": {
            **_spread(final),
            "mean": float(final.mean()),
            "worst": float(final.max() if graded else final.min()),
            "per_seed": final.tolist(),
        },
        "area": _spread(areas),
        "within": [_within(result, missed, threshold) for threshold in THRESHOLDS],
    }


def _spread(values: Floats) -> dict[str, Any]:
    """Interquartile mean over seeds, and its interval; None for too few seeds."""
    interval = list(bootstrap_interval([values])) if len(values) >= FEWEST_SEEDS else None
    return {"iqm": float(interquartile_mean(values)), "interval": interval}


def _within(result: Result, regrets: Floats | None, threshold: float) -> dict[str, Any]:
    """When the seeds come and stay within a threshold; never, if there are no regrets."""
    steps: list[int | None] = [None] * len(result.returns)
    if regrets is not None:
        steps = steps_within(result.curve_steps, regrets, threshold)
    middle = middle_steps(steps)
    pace = result.seconds_per_seed / max(result.env_steps, 1)
    return {
        "threshold": threshold,
        "steps": middle,
        "seconds": None if middle is None else middle * pace,
        "reached": sum(count is not None for count in steps),
        "per_seed": steps,
    }


def _pairs(scores: dict[str, Floats], order: Sequence[str], sign: float) -> list[dict[str, Any]]:
    """The tests of each agent against each of those ranked below it."""
    pairs = list(combinations(order, 2))
    p_values = holm([rank_test(scores[a], scores[b]) for a, b in pairs])

    def difference(x: Floats, y: Floats) -> Floats:
        return sign * (interquartile_mean(x) - interquartile_mean(y))

    rows = []
    for (a, b), p in zip(pairs, p_values.tolist(), strict=True):
        both = [scores[a], scores[b]]
        several = min(map(len, both)) >= FEWEST_SEEDS
        row: dict[str, Any] = {"first": a, "second": b, "p": p, "told_apart": p <= LEVEL}
        statistics = {"probability": probability_of_improvement, "difference": difference}
        for key, statistic in statistics.items():
            interval = list(bootstrap_interval(both, statistic)) if several else None
            row |= {key: float(statistic(*both)), f"{key}_interval": interval}
        rows.append(row)
    return rows
