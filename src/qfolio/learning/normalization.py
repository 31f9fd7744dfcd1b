"""Running normalization of observations and rewards.

Observations are centered and divided by their standard deviation; rewards are divided by the
standard deviation of the discounted return so far, as ``VecNormalize`` of stable-baselines3 does
(Raffin et al. 2021; the scale of rewards: Engstrom et al. 2020, "Implementation matters in deep
policy gradients", section 3). The statistics are part of an agent's state. Those of the
observations are part of its weights, too: they are saved with a policy and stay as they are when it
is evaluated.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Task, Transition
from qfolio.learning.targets import Scalar, Weights

LIMIT = 10.0
"""Largest absolute value of a normalized number."""

EPSILON = 1e-8
"""Added to variances, so that constants do not divide by zero."""


class Moments(eqx.Module):
    """Count, mean and variance of the rows so far; mean 0 and variance 1 before the first."""

    count: Float[Array, ""]
    mean: Float[Array, "*row"]
    variance: Float[Array, "*row"]

    @staticmethod
    def begin(shape: tuple[int, ...]) -> "Moments":
        """The moments before the first row; ``shape`` is that of a row."""
        return Moments(jnp.array(0.0), jnp.zeros(shape), jnp.ones(shape))

    def update(self, rows: Float[Array, "rows *row"]) -> "Moments":
        """The moments of all rows, by the sums of two parts (Chan et al. 1983)."""
        total = self.count + len(rows)
        share = len(rows) / total
        apart = rows.mean(0) - self.mean
        within = (1 - share) * self.variance + share * rows.var(0)
        return Moments(total, self.mean + share * apart, within + share * (1 - share) * apart**2)

    @property
    def std(self) -> Float[Array, "*row"]:
        """The standard deviation, always above 0."""
        return jnp.sqrt(self.variance + EPSILON)


class RewardScale(eqx.Module):
    """The spread of an episode's discounted past rewards, Σₖ γᵏ r_{t−k}."""

    returns: Float[Array, " environment"]  # these sums in the current episodes
    moments: Moments

    def update(
        self,
        reward: Float[Array, "time environment"],
        finished: Bool[Array, "time environment"],
        discount: Scalar,
    ) -> "RewardScale":
        """The statistics after further rewards; sums start again where an episode has finished."""

        def step(returns: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            returns = discount * returns + now[0]
            return jnp.where(now[1], 0.0, returns), returns

        returns, each = lax.scan(step, self.returns, (reward, finished))
        return RewardScale(returns, self.moments.update(each.reshape(-1)))


class Normalizer(eqx.Module):
    """An agent's statistics; None for what it does not normalize, which stays unchanged."""

    observations: Moments | None
    rewards: RewardScale | None

    def update(self, rollout: Transition, discount: Scalar) -> "Normalizer":
        """The statistics after a rollout, whose leading axes are (time, environment)."""
        observations, rewards = self.observations, self.rewards
        if observations is not None:
            seen = rollout.observation
            observations = observations.update(seen.reshape(-1, *seen.shape[2:]))
        if rewards is not None:
            finished = rollout.terminated | rollout.truncated
            rewards = rewards.update(rollout.reward, finished, discount)
        return Normalizer(observations, rewards)

    def cut(self) -> "Normalizer":
        """The statistics with sums of rewards that start again, as at the end of all episodes."""
        if self.rewards is None:
            return self
        zeros: Any = jnp.zeros_like(self.rewards.returns)
        return eqx.tree_at(lambda s: s.rewards.returns, self, zeros)

    def observation(self, observation: PyTree) -> PyTree:
        """Observations, normalized if the agent does so."""
        return normalized(self.observations, observation)

    def reward(self, reward: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Rewards, normalized if the agent does so."""
        if self.rewards is None:
            return reward
        return jnp.clip(reward / self.unit, -LIMIT, LIMIT)

    def attached(self, weights: Weights) -> Weights:
        """The weights, with the statistics of observations in their field ``observations``."""
        if self.observations is None:
            return weights
        where: Any = lambda weights: weights.observations  # noqa: E731
        return eqx.tree_at(where, weights, self.observations, is_leaf=lambda x: x is None)

    @property
    def unit(self) -> Float[Array, ""] | float:
        """The reward that is normalized to 1."""
        return 1.0 if self.rewards is None else self.rewards.moments.std


def normalized(moments: Moments | None, observation: PyTree) -> PyTree:
    """Observations with mean 0 and standard deviation 1; unchanged without moments."""
    if moments is None:
        return observation
    return jnp.clip((observation - moments.mean) / moments.std, -LIMIT, LIMIT)


class NormalizationConfig(NamedTuple):
    """An agent's settings for normalization, by the names that they have there."""

    normalize_observations: bool
    normalize_rewards: bool

    def check(self, input_gain: Scalar) -> None:
        """Raises QfolioError if inputs are scaled in two ways."""
        if self.normalize_observations and isinstance(input_gain, float) and input_gain:
            raise QfolioError(
                f"input_gain is {input_gain}, for observations scaled by their bounds; set it to 0 "
                "or normalize_observations to false."
            )

    def begin(self, task: Task, observation: PyTree, num_envs: int) -> Normalizer:
        """Statistics before the first step.

        observation: an example. Raises QfolioError if observations are to be normalized and are not
        one array of numbers.
        """
        observations, rewards = None, None
        if self.normalize_observations and task.states is None:  # numbered states stay numbered
            if not isinstance(observation, jax.Array):
                raise QfolioError(
                    f"normalize_observations needs one array of numbers, which observations of "
                    f"{task.name} are not; set it to false."
                )
            observations = Moments.begin(observation.shape)
        if self.normalize_rewards:
            rewards = RewardScale(jnp.zeros(num_envs), Moments.begin(()))
        return Normalizer(observations, rewards)
