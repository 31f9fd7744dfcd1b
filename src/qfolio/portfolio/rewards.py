"""Rewards of a market's step: a utility of net growth, or of the path that led to it.

A reward is a function of its own state, which may summarize earlier steps, and of the step's
outcome. ``reward=NAME`` of a market names one of them, or a user's own as module:Name. Every field
has a default, and a field with the name of a market's setting (``risk_aversion``, ``sharpe_rate``)
takes its value.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from qfolio.core.fields import require

LEAST_VARIANCE, LEAST_SHARE = 1e-10, 1e-3
"""Lower bounds of the variance in a Sharpe ratio: that of a volatility of 0.1 bp per step, and a
share of the mean square return (a Sharpe ratio of 32 per step); below, float32 rounding matters."""

Number = Float[Array, ""] | float


class Outcome(NamedTuple):
    """The outcome of a step."""

    growth: Float[Array, ""]  # wealth after the step over wealth before, net of costs
    cost: Float[Array, ""]  # of its trade, as a share of wealth
    weights: Float[Array, " entry"]  # right after the trade, cash first


class Reward(eqx.Module):
    """The reward of a step."""

    def init(self) -> PyTree:
        """The state before the first step; None if no reward depends on earlier steps."""
        return None

    @abc.abstractmethod
    def __call__(self, state: PyTree, outcome: Outcome) -> tuple[Float[Array, ""], PyTree]:
        """Reward of a step, and the state after it."""

    @property
    def path_dependent(self) -> bool:
        """Whether a reward depends on earlier steps."""
        return bool(jax.tree.leaves(jax.eval_shape(self.init)))


class Log(Reward):
    """Log growth."""

    def __call__(self, state: None, outcome: Outcome) -> tuple[Float[Array, ""], None]:
        return jnp.log(outcome.growth), None


class CRRA(Reward):
    """Utility of constant relative risk aversion, (g^(1−γ) − 1)/(1−γ); log growth for γ = 1."""

    risk_aversion: Number = 3.0  # γ

    def __check_init__(self) -> None:
        require(self, "risk_aversion", lambda x: 0 <= x <= 100, "from 0 to 100")

    def __call__(self, state: None, outcome: Outcome) -> tuple[Float[Array, ""], None]:
        power = 1 - jnp.asarray(self.risk_aversion)
        is_log = abs(power) < 1e-6  # the limit
        safe = jnp.where(is_log, 1.0, power)
        log = jnp.log(outcome.growth)
        return jnp.where(is_log, log, jnp.expm1(safe * log) / safe), None


class MeanVariance(Reward):
    """Return minus γ/2 times its square, which is the variance for returns of mean zero."""

    risk_aversion: Number = 3.0  # γ

    def __check_init__(self) -> None:
        require(self, "risk_aversion", lambda x: 0 <= x <= 100, "from 0 to 100")

    def __call__(self, state: None, outcome: Outcome) -> tuple[Float[Array, ""], None]:
        gain = outcome.growth - 1
        return gain - self.risk_aversion / 2 * gain**2, None


class DifferentialSharpe(Reward):
    """The step's change of an exponentially weighted Sharpe ratio (Moody & Saffell 1998).

    With moving averages A of the returns R and B of their squares, and η the weight of the newest,

        D = (B ΔA − ½ A ΔB) / (B − A²)^{3/2},   ΔA = R − A,  ΔB = R² − B,

    where the variance B − A² is bounded below (``LEAST_VARIANCE``, ``LEAST_SHARE``): it vanishes
    for a portfolio that stays in cash or grows at a constant rate. State: (A, B); the first B of
    1e-4 stands for a volatility of 1% per step.
    """

    sharpe_rate: Number = 0.01  # η, the reciprocal of the memory in steps

    def __check_init__(self) -> None:
        require(self, "sharpe_rate", lambda x: 0 <= x <= 0.5, "from 0 to 0.5")

    def init(self) -> Float[Array, "2"]:
        return jnp.array([0.0, 1e-4])

    def __call__(
        self, state: Float[Array, "2"], outcome: Outcome
    ) -> tuple[Float[Array, ""], Float[Array, "2"]]:
        mean, square = state
        gain = outcome.growth - 1
        change = jnp.stack([gain - mean, gain**2 - square])
        least = LEAST_VARIANCE + LEAST_SHARE * square
        variance = jnp.maximum(square - mean**2, least)
        ratio = (square * change[0] - mean * change[1] / 2) / variance**1.5
        return ratio, state + self.sharpe_rate * change
