"""The inverted pendulum: Gymnasium's ``Pendulum-v1`` as a pure function, with discrete torques.

A rod of length l and mass m hangs on a motor too weak to lift it in one go; it has to be swung up
and then held. The dynamics, the limits and the cost are those of Gymnasium's ``PendulumEnv.step``,
to which the tests hold this file step for step.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.errors import QfolioError
from qfolio.mdp import Discrete, Step, Task
from qfolio.optimum.grid import GridOptimum


class PendulumState(NamedTuple):
    """Angle from upright in radians (not wrapped) and angular velocity in rad/s."""

    theta: Float[Array, "*batch"]
    theta_dot: Float[Array, "*batch"]


class Pendulum(Task):
    """Swing the pendulum up and hold it, by one of ``torques`` equally spaced torques.

    Observation: (cos θ, sin θ, θ̇). Reward: −(θ² + 0.1 θ̇² + 0.001 u²) with θ wrapped to [−π, π).
    Start: θ uniform in [−π, π], θ̇ uniform in [−1, 1]. It never terminates; after ``horizon`` steps
    (Gymnasium: 200) an episode is truncated.
    """

    torques: int = eqx.field(static=True, default=11)
    horizon: int = eqx.field(static=True, default=200)

    max_torque = 2.0  # N m
    max_speed = 8.0  # rad/s
    dt = 0.05  # s
    gravity = 10.0  # m/s²
    mass = 1.0  # kg
    length = 1.0  # m

    def __check_init__(self) -> None:
        if not 2 <= self.torques <= 1001:
            raise QfolioError(f"torques is {self.torques}; it must be from 2 to 1001.")
        if not 1 <= self.horizon <= 5000:  # the exact optimum keeps a table for each step
            raise QfolioError(f"horizon is {self.horizon}; it must be from 1 to 5000.")

    @property
    def actions(self) -> Discrete:
        return Discrete(self.torques)

    @property
    def observation_scale(self) -> tuple[float, ...]:
        return (1.0, 1.0, self.max_speed)

    def torque(self, action: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The torque in N m that an action stands for."""
        return self.max_torque * (2.0 * action / (self.torques - 1) - 1.0)

    def reset(self, key: PRNGKeyArray) -> PendulumState:
        theta, theta_dot = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return PendulumState(jnp.pi * theta, theta_dot)

    def observe(self, state: PendulumState) -> Float[Array, "*batch 3"]:
        theta, theta_dot = state
        return jnp.stack([jnp.cos(theta), jnp.sin(theta), theta_dot], axis=-1)

    def step(self, state: PendulumState, action: Int[Array, ""], key: PRNGKeyArray) -> Step:
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

    def optimum(self) -> GridOptimum:
        """Dynamic programming on a grid over one turn of θ and all speeds."""
        return GridOptimum(
            task=self,
            state=PendulumState,
            axes=(
                jnp.linspace(-jnp.pi, jnp.pi, 400, endpoint=False),
                jnp.linspace(-self.max_speed, self.max_speed, 401),
            ),
            periodic=(True, False),
        )
