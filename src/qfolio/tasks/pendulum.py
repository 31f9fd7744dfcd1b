"""The inverted pendulum: Gymnasium's ``Pendulum-v1`` as a pure function, with discrete torques.

A rod of length l and mass m hangs on a motor too weak to lift it in one go; it must be swung up and
then held. The dynamics, the limits and the cost are those of Gymnasium's ``PendulumEnv.step``; the
tests compare both step by step.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.fields import number, require, static
from qfolio.core.mdp import Box, Discrete, Step, Task
from qfolio.solvers.grid import GridOptimum

MOST_TORQUES = 101
"""Most torques that stand for continuous ones; the optimum then takes half a minute."""


class PendulumState(NamedTuple):
    """Angle from upright in radians (not wrapped) and angular velocity in rad/s."""

    theta: Float[Array, "*batch"]
    theta_dot: Float[Array, "*batch"]


class Pendulum(Task):
    """Swing the pendulum up and hold it, by one of ``torques`` equally spaced torques.

    With ``torques=0`` an action is the torque itself, a row of one number from −2 to 2 N m.
    Observation: (cos θ, sin θ, θ̇). Reward: −(θ² + 0.1 θ̇² + 0.001 u²) with θ wrapped to [−π, π).
    Start: θ uniform in [−π, π], θ̇ uniform in [−1, 1]. It never terminates; after ``horizon`` steps
    (Gymnasium: 200) an episode is truncated.
    """

    torques: int = static(11)  # choices of torque; 0: any torque
    horizon: int = static(200)  # steps of an episode
    gravity: float = number(10.0)  # acceleration, m/s²
    mass: float = number(1.0)  # of the rod, kg
    length: float = number(1.0)  # of the rod, m

    max_torque = 2.0  # N m
    max_speed = 8.0  # rad/s
    dt = 0.05  # s

    def __check_init__(self) -> None:
        require(self, "torques", lambda x: x == 0 or 2 <= x <= 1001, "0, or from 2 to 1001")
        # The exact optimum keeps a table for each step.
        require(self, "horizon", lambda x: 1 <= x <= 5000, "from 1 to 5000")
        require(self, "gravity", lambda x: 0 <= x <= 100, "from 0 to 100")
        require(self, "mass length", lambda x: 0.1 <= x <= 10, "from 0.1 to 10")

    @property
    def actions(self) -> Discrete | Box:
        return Discrete(self.torques) if self.torques else Box(1, self.max_torque)

    @property
    def observation_scale(self) -> tuple[float, ...]:
        return (1.0, 1.0, self.max_speed)

    def torque(
        self, action: Int[Array, "*batch"] | Float[Array, "*batch 1"]
    ) -> Float[Array, "*batch"]:
        """The torque of an action in N m."""
        if not self.torques:
            return jnp.clip(action[..., 0], -self.max_torque, self.max_torque)
        return self.max_torque * (2.0 * action / (self.torques - 1) - 1.0)

    @property
    def _dense(self) -> int:
        """The number of torques, odd, whose neighbors change the speed by at most 0.06 a step."""
        pushed = 3 * self.max_torque * self.dt / (self.mass * self.length**2)
        return 2 * max(5, math.ceil(pushed / 0.06 - 1e-9)) + 1

    def reset(self, key: PRNGKeyArray) -> PendulumState:
        theta, theta_dot = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return PendulumState(jnp.pi * theta, theta_dot)

    def observe(self, state: PendulumState) -> Float[Array, "*batch 3"]:
        theta, theta_dot = state
        return jnp.stack([jnp.cos(theta), jnp.sin(theta), theta_dot], axis=-1)

    def step(self, state: PendulumState, action: Array, key: PRNGKeyArray) -> Step:
        """One step of 0.05 s; deterministic, so that ``key`` is not used."""
        theta, theta_dot = state
        u = self.torque(action)
        wrapped = (theta + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(wrapped**2 + 0.1 * theta_dot**2 + 0.001 * u**2)
        acceleration = (
            3 * self.gravity / (2 * self.length) * jnp.sin(theta)
            + 3 / (self.mass * self.length**2) * u
        )
        speed = jnp.clip(theta_dot + acceleration * self.dt, -self.max_speed, self.max_speed)
        state = PendulumState(theta + speed * self.dt, speed)
        return Step(state, reward, jnp.zeros_like(reward, dtype=bool))

    def optimum(self) -> GridOptimum | None:
        """Dynamic programming on a grid over one turn of θ and all speeds, with equal torques.

        Of continuous torques, so many are tried that torques between them would gain less than the
        grid's error: 11, or more for a light or short pendulum. None if these would be too many.
        """
        if not self.torques and self._dense > MOST_TORQUES:
            return None
        return GridOptimum(
            task=self if self.torques else dataclasses.replace(self, torques=self._dense),
            state=PendulumState,
            axes=(
                jnp.linspace(-jnp.pi, jnp.pi, 400, endpoint=False),
                jnp.linspace(-self.max_speed, self.max_speed, 401),
            ),
            periodic=(True, False),
        )
