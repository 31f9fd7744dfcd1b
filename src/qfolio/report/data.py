"""What a report is made of: plain arrays and dictionaries, independent of how they came about."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Numbers = NDArray[np.floating[Any] | np.integer[Any]]


@dataclass(frozen=True)
class Curve:
    """One training run of S seeds, evaluated P times on the way.

    Attributes:
        label: Name of the variant, for example 'double DQN'.
        episodes: Training episodes finished at each evaluation, shape (P,).
        returns: Mean greedy return on fixed starts, shape (P, S).
        overestimation: Mean of the largest action value at the visited states less the
            discounted return that followed, shape (P, S).
    """

    label: str
    episodes: Numbers
    returns: Floats
    overestimation: Floats


@dataclass(frozen=True)
class Maps:
    """Learned and exact solution on an evenly spaced grid of n angles and m angular speeds.

    Attributes:
        theta: Angles in radians, 0 = upright, shape (n,).
        theta_dot: Angular speeds in rad/s, shape (m,).
        value: Learned value, the largest action value, shape (n, m).
        policy: Torque of the learned greedy policy in N m, shape (n, m).
        exact_value: Value of the exact optimum, shape (n, m).
        exact_policy: Torque of the exact optimum in N m, shape (n, m).
        discount: Discount factor per step of both values.
    """

    theta: Floats
    theta_dot: Floats
    value: Floats
    policy: Floats
    exact_value: Floats
    exact_policy: Floats
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

    states: Floats
    torques: Floats
    rewards: Floats


@dataclass(frozen=True)
class ReportData:
    """Everything a report shows.

    Attributes:
        title: Heading of the page.
        command: Command line that repeats or continues the training; may have several lines.
        summary: The results: task, agent, preset, seeds, episodes, env_steps, seconds_compile,
            seconds_train, steps_per_second, return_mean, return_ci95 (low, high;
            None for one seed),
            return_per_seed, optimum, regret_per_seed (fractions of the optimum) and
            overestimation_per_seed.
        config: All settings, a nested dictionary.
        curve: The run that is reported.
        comparison: The same run with one thing changed, or None.
        training_episodes: Number of each finished training episode of every seed, shape (R,).
        training_returns: Return of those episodes, shape (R,).
        optimum: Mean return of the exact optimum on the evaluation starts of the curve.
        maps: Solutions over the state space, or None for tasks without a 2-D state.
        episode: A greedy episode to be shown, or None.
    """

    title: str
    command: str
    summary: dict[str, Any]
    config: dict[str, Any]
    curve: Curve
    comparison: Curve | None
    training_episodes: Numbers
    training_returns: Floats
    optimum: float
    maps: Maps | None
    episode: Episode | None
