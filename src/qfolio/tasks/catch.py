"""Catch: a ball falls through an image, and a paddle at the bottom must be under it.

After Catch of bsuite (Osband et al. 2020), with decoys, so that an agent must tell shapes apart
anywhere in the image.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from qfolio.core.errors import QfolioError
from qfolio.core.fields import require, static
from qfolio.core.mdp import Discrete, Step, Task
from qfolio.core.text import amount


class CatchState(NamedTuple):
    """The columns of the ball and the decoys, in this order, their row, and the paddle's column."""

    columns: Int[Array, "*batch thing"]
    row: Int[Array, "*batch"]  # from the top, of the ball and of the decoys' lower pixels
    paddle: Int[Array, "*batch"]


class Catch(Task):
    """Catch the ball; the actions are left, stay and right.

    Ball and decoys fall one row per step. The ball is one pixel; each decoy is two, one above the
    other, in a column of its own. The episode ends when the ball reaches the bottom row, where the
    paddle is: reward 1 if it is under the ball, else −1, and 0 before. Observation: the image,
    (rows, columns, 1), pixels 0 or 1. Start: the paddle in the middle, all columns random.
    """

    rows: int = static(10)  # rows of the image, in pixels
    columns: int = static(5)  # columns of the image, in pixels
    decoys: int = static(0)  # number of decoys, which fall beside the ball

    def __check_init__(self) -> None:
        require(self, "rows columns", lambda x: 3 <= x <= 256, "from 3 to 256")
        if not 0 <= self.decoys < self.columns:
            raise QfolioError(
                f"decoys is {self.decoys}; with {self.columns} columns it must be at least 0 and "
                f"less than {self.columns}, so that each thing has a column of its own."
            )
        if self.horizon < self.columns // 2:
            raise QfolioError(
                f"rows is {self.rows}; the ball would be down in {amount(self.horizon, 'step')}, "
                f"before the paddle can reach all {self.columns} columns; use more rows."
            )

    @property
    def horizon(self) -> int:
        """Steps until the ball is down; no episode is truncated before."""
        return self.rows - 1 - self._first_row

    @property
    def _first_row(self) -> int:
        """Leaves room for the decoys' upper pixels."""
        return 1 if self.decoys else 0

    @property
    def actions(self) -> Discrete:
        return Discrete(3)

    def reset(self, key: PRNGKeyArray) -> CatchState:
        columns = jax.random.permutation(key, self.columns)[: 1 + self.decoys]
        return CatchState(columns, jnp.array(self._first_row), jnp.array(self.columns // 2))

    def observe(self, state: CatchState) -> Float[Array, "rows columns 1"]:
        picture = jnp.zeros((self.rows, self.columns))
        picture = picture.at[state.row, state.columns].set(1.0)
        picture = picture.at[state.row - 1, state.columns[1:]].set(1.0)
        return picture.at[-1, state.paddle].set(1.0)[..., None]

    def step(self, state: CatchState, action: Array, key: PRNGKeyArray) -> Step:
        """One step; deterministic, so that ``key`` is not used."""
        paddle = jnp.clip(state.paddle + action - 1, 0, self.columns - 1)
        row = state.row + 1
        down = row == self.rows - 1
        caught = jnp.where(paddle == state.columns[0], 1.0, -1.0)
        return Step(CatchState(state.columns, row, paddle), jnp.where(down, caught, 0.0), down)

    def optimum(self) -> "Caught":
        return Caught()


class Caught:
    """The paddle can be under every ball in time: the best return is 1 from every start."""

    def returns(self, keys: Key[Array, " start"]) -> np.ndarray:
        return np.ones(len(keys))
