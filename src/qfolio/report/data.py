"""The data of a report: plain arrays and dictionaries, independent of their origin."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import AnyFloats

Numbers = AnyFloats | NDArray[np.integer[Any]]


def decimals(size: float, figures: int = 4, least: int = 1) -> int:
    """Return the decimals that give a number of this size ``figures`` significant digits."""
    if not math.isfinite(size) or size == 0:
        return least
    return min(max(least, figures - 1 - math.floor(math.log10(abs(size)))), 9)


@dataclass(frozen=True)
class Curve:
    """One training run of S seeds, evaluated P times during training.

    Attributes:
        label: Name of the variant, for example 'double DQN'.
        done: Training of a seed before each evaluation, in the budget's unit, shape (P,).
        returns: Mean greedy return on fixed starts, shape (P, S).
        overestimation: Mean of the largest action value at the visited states minus the
            discounted return that followed, shape (P, S); NaN if no values are estimated.
    """

    label: str
    done: Numbers
    returns: AnyFloats
    overestimation: AnyFloats


@dataclass(frozen=True)
class Maps:
    """Learned and exact solution on an evenly spaced grid of n angles and m angular speeds.

    Attributes:
        theta: Angles in radians, 0 = upright, shape (n,).
        theta_dot: Angular speeds in rad/s, shape (m,).
        value: Learned value, the largest action value, shape (n, m), or None if the agent
            estimates no action values.
        policy: Torque of the learned greedy policy in N m, shape (n, m).
        exact_value: Value of the exact optimum, shape (n, m).
        exact_policy: Torque of the exact optimum in N m, shape (n, m).
        discount: Discount factor per step of both values.
    """

    theta: AnyFloats
    theta_dot: AnyFloats
    value: AnyFloats | None
    policy: AnyFloats
    exact_value: AnyFloats
    exact_policy: AnyFloats
    discount: float


@dataclass(frozen=True)
class Episode:
    """One greedy episode of T steps.

    Attributes:
        states: Angle (radians, 0 = upright, counter-clockwise positive) and angular speed
            (rad/s), shape (T + 1, 2).
        torques: Torque during each step in N m, counter-clockwise positive, shape (T,).
        rewards: Reward of each step, shape (T,).
    """

    states: AnyFloats
    torques: AnyFloats
    rewards: AnyFloats


@dataclass(frozen=True)
class Responses:
    """The targets of each seed's policy by holding, in some scenes of a market.

    Attributes:
        scenes: Names of the c scenes.
        held: Weights or positions held, shape (h,).
        exact: Targets of the exact policy, shape (c, h).
        learned: Targets of each of S seeds, shape (S, c, h).
        weights: Whether these are weights, from 0 to 1, or positions without bounds.
        region: Ends of the exact no-trade region, or None if there is no single region.
    """

    scenes: tuple[str, ...]
    held: AnyFloats
    exact: AnyFloats
    learned: AnyFloats
    weights: bool
    region: tuple[float, float] | None


@dataclass(frozen=True)
class Weights:
    """The target weights of each seed's policy, if they are constant.

    Attributes:
        names: Names of the n weights.
        exact: Weights of the exact policy, shape (n,).
        learned: Weights of each of S seeds, shape (S, n).
    """

    names: tuple[str, ...]
    exact: AnyFloats
    learned: AnyFloats


@dataclass(frozen=True)
class MarketData:
    """The description of a market whose best policy is known.

    Attributes:
        about: Sentences on the market and its best policy.
        measure: The name of a return: 'log growth', or 'return' for another sum.
        meaning: A sentence that defines a return, if needed.
        rule: A sentence that explains the numbers of the summary's rule.
        horizon: Steps of an episode.
        period: Name of the period of growth, or '' if returns are not growth.
        periods: Number of such periods in an episode.
        policy: Learned and exact policy, or None if there is nothing to draw.
    """

    about: str
    measure: str
    meaning: str
    rule: str
    horizon: int
    period: str
    periods: float
    policy: Responses | Weights | None


@dataclass(frozen=True)
class ReportData:
    """Everything a report shows.

    Attributes:
        title: Heading of the page.
        command: Command line that repeats or continues the training; may have several lines.
        summary: The results: task, agent, preset, seeds, episodes, env_steps, seconds_compile,
            seconds_train, steps_per_second (of all seeds; episodes and env_steps are those of
            one), return_mean, return_ci95 (low, high; None for few seeds), return_per_seed,
            optimum, regret_per_seed (shares of the optimum; None if it is 0),
            overestimation_per_seed (None if no action values are estimated) and, in markets, rule:
            a few numbers that describe a policy, "exact" and "per_seed".
        config: All settings, a nested dictionary.
        curve: The reported run.
        comparison: The same run with one setting changed, or None.
        training_done: Training of its seed up to each finished episode of every seed, in the
            budget's unit, shape (R,).
        training_returns: Return of those episodes, shape (R,); empty if they are not comparable
            with the curve.
        optimum: Mean return of the exact optimum on the evaluation starts of the curve; NaN if
            unknown, when summary's optimum and regrets are None.
        maps: Solutions over the state space, or None for tasks without a 2-D state.
        episode: A greedy episode to show, or None.
        market: The description of a market, or None for other tasks.
        unit: The unit of the training budget, "episodes" or "steps".
        preset: The preset that the run is compared with, or None if there is none.
        changes: Settings that differ from the preset: the run's value and the preset's, by name.
    """

    title: str
    command: str
    summary: dict[str, Any]
    config: dict[str, Any]
    curve: Curve
    comparison: Curve | None
    training_done: Numbers
    training_returns: AnyFloats
    optimum: float
    maps: Maps | None
    episode: Episode | None
    market: MarketData | None = None
    unit: str = "episodes"
    preset: str | None = None
    changes: dict[str, tuple[Any, Any]] = field(default_factory=dict)
