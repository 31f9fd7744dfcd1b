"""The pendulum for tabular agents: observed on a grid, and as a finite process.

``GridPendulum`` moves as the pendulum does and shows only its cell of a grid, so that a table can
learn it. The exact optimum is that of the pendulum itself, so a learned policy's regret includes
the information that cells hide.

``interpolated`` turns the pendulum into a finite process whose exact values can be computed.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from qfolio.core.fields import require, static
from qfolio.core.mdp import Discrete
from qfolio.solvers.grid import GridOptimum, cell
from qfolio.tasks.finite import FiniteMDP
from qfolio.tasks.pendulum import Pendulum, PendulumState


class GridPendulum(Pendulum):
    """The pendulum, observed as the number of its cell among ``angles`` × ``speeds``.

    Cells are equally large; with odd numbers, the upright pendulum at rest is at the center of a
    cell. Speeds at the limit have half a cell.
    """

    torques: int = static(3)  # choices of torque
    angles: int = static(101)  # cells of the angle
    speeds: int = static(61)  # cells of the speed

    def __check_init__(self) -> None:
        require(self, "torques", lambda x: 2 <= x <= 1001, "from 2 to 1001, for a table")
        require(self, "angles speeds", lambda x: 2 <= x <= 1000, "from 2 to 1000")

    @property
    def states(self) -> int:
        return self.angles * self.speeds

    @property
    def observation_scale(self) -> tuple[float, ...]:
        return (1.0,)

    def observe(self, state: PendulumState) -> Int[Array, "*batch"]:
        theta, theta_dot = state
        angle = jnp.round(theta / (2 * jnp.pi) * self.angles) % self.angles
        speed = jnp.round((theta_dot / self.max_speed + 1) / 2 * (self.speeds - 1))
        return (angle * self.speeds + speed.clip(0, self.speeds - 1)).astype(jnp.int32)


def interpolated(grid: GridOptimum) -> FiniteMDP:
    """A finite process on the points of a grid, whose values are those of the grid's optimum.

    An action moves a point to between four others, and the process goes to each with its
    interpolation weight as probability (Kushner & Dupuis 2001, chapter 5). Point (i, j) of the axes
    has the number i · m + j; starts are uniform.
    """
    n, m = len(grid.axes[0]), len(grid.axes[1])
    actions = grid.task.actions
    assert isinstance(actions, Discrete)
    points = grid.state(*(x.ravel() for x in jnp.meshgrid(*grid.axes, indexing="ij")))

    def outcomes(
        action: Int[Array, ""],
    ) -> tuple[Int[Array, "state 4"], Float[Array, "state 4"], Float[Array, " state"]]:
        step = jax.vmap(grid.task.step, (0, None, None))
        after = step(points, action, jax.random.key(0))  # deterministic: the key is not used
        (i, i_next, u), (j, j_next, v) = (
            cell(axis, periodic, at)
            for axis, periodic, at in zip(grid.axes, grid.periodic, after.state, strict=True)
        )
        corners = [i * m + j, i_next * m + j, i * m + j_next, i_next * m + j_next]
        weights = [(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]
        return jnp.stack(corners, -1), jnp.stack(weights, -1), after.reward

    tables = jax.jit(jax.vmap(outcomes, out_axes=1))(jnp.arange(actions.n))
    successors, weights, rewards = (np.asarray(table) for table in tables)
    weights = weights.astype(float) / weights.sum(-1, keepdims=True, dtype=float)
    assert successors.shape[0] == n * m
    return FiniteMDP(weights, rewards, horizon=grid.task.horizon, successors=successors)
