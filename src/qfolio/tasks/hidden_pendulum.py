"""The inverted pendulum without its velocity: a partially observed task."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.core.fields import require, static
from qfolio.core.mdp import Box, Discrete, Step, Task
from qfolio.solvers.grid import GridOptimum
from qfolio.tasks.pendulum import Pendulum, PendulumState


class Seen(NamedTuple):
    """A pendulum, and its last observations: rows (cos θ, sin θ), the latest last."""

    pendulum: PendulumState
    window: Float[Array, "*batch window 2"]


class HiddenPendulum(Task):
    """``Pendulum`` with the last ``window`` rows (cos θ, sin θ) as observation.

    Rows from before the start are zeros. Actions, rewards and starts are those of ``Pendulum``, and
    so is the optimum. It knows the velocity, without which the agent must take its first action, so
    it is an upper bound that cannot quite be reached.
    """

    window: int = static(4)  # rows that are observed
    torques: int = static(11)  # choices of torque; 0: any torque
    horizon: int = static(200)  # steps of an episode

    def __check_init__(self) -> None:
        require(self, "window", lambda x: 1 <= x <= 256, "from 1 to 256")
        _ = self._pendulum  # which checks its settings

    @property
    def _pendulum(self) -> Pendulum:
        return Pendulum(torques=self.torques, horizon=self.horizon)

    @property
    def actions(self) -> Discrete | Box:
        return self._pendulum.actions

    def reset(self, key: PRNGKeyArray) -> Seen:
        pendulum = self._pendulum.reset(key)
        return Seen(pendulum, self._see(jnp.zeros((self.window, 2)), pendulum))

    def observe(self, state: Seen) -> Float[Array, "*batch window 2"]:
        return state.window

    def step(self, state: Seen, action: Array, key: PRNGKeyArray) -> Step:
        after = self._pendulum.step(state.pendulum, action, key)
        seen = Seen(after.state, self._see(state.window, after.state))
        return Step(seen, after.reward, after.terminated)

    def _see(self, window: Array, pendulum: PendulumState) -> Float[Array, "window 2"]:
        row = self._pendulum.observe(pendulum)[:2]
        return jnp.concatenate([window[1:], row[None]])

    def optimum(self) -> GridOptimum | None:
        """The optimum of the pendulum with observed velocity, from the same starts."""
        return self._pendulum.optimum()
