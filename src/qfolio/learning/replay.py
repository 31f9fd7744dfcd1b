"""The replay buffer: a ring of the latest transitions (Lin 1992; Mnih et al. 2015)."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.fields import require, require_counts
from qfolio.core.mdp import Task, Transition
from qfolio.learning.priorities import Priorities
from qfolio.learning.recall import recalled, stored
from qfolio.learning.targets import Scalar, n_step

Discount = Float[Array, "*#batch"] | float
"""Discount of the values that follow a batch of experience."""


class Experience(NamedTuple):
    """A transition as the buffer stores it; nothing is bootstrapped after ``terminal``.

    The observations are as ``stored`` keeps them.
    """

    observation: PyTree
    action: Array
    reward: Float[Array, "*batch"]
    next_observation: PyTree
    terminal: Bool[Array, "*batch"]
    last: Bool[Array, "*batch"] | None = None  # step of its episode; n-step returns stop there

    @staticmethod
    def like(
        state: PyTree, observation: PyTree, action: Array, *, with_last: bool = False
    ) -> "Experience":
        """An example row, for its shapes and types."""
        no, seen = jnp.array(False), stored(state, observation)
        last = no if with_last else None
        return Experience(seen, action, jnp.array(0.0), seen, no, last)

    @staticmethod
    def of(
        rollout: Transition, *, time_limit_terminal: bool = False, with_last: bool = False
    ) -> "Experience":
        """A rollout flattened into rows, ordered by time and then environment."""
        step = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)
        terminal, last = step.terminated, step.terminated | step.truncated
        if time_limit_terminal:
            terminal = last
        return Experience(
            stored(step.state, step.observation), step.action, step.reward,
            stored(step.next_state, step.next_observation), terminal, last if with_last else None,
        )  # fmt: skip

    def recalled(self, task: Task) -> "Experience":
        """The batch with observations as the agent saw them."""
        seen, then = recalled(task, self.observation), recalled(task, self.next_observation)
        return self._replace(observation=seen, next_observation=then)


class ReplayConfig(NamedTuple):
    """An agent's settings for its buffer, by the names that they have there."""

    num_envs: int  # rows written at a time
    batch_size: int
    n_steps: int  # steps of the return in a target
    replay_capacity: int  # rows
    learning_starts: int  # rows that are stored before learning
    prioritized: bool = False

    def check(self) -> None:
        """Raises QfolioError if the settings are invalid."""
        require_counts(self, "batch_size n_steps")
        require(self, "replay_capacity", lambda x: 1 <= x <= 2**23, "from 1 to 2²³")
        require_counts(self, "learning_starts", 0)
        joined = self.n_steps * self.num_envs
        if max(self.learning_starts, joined) > self.replay_capacity:
            raise QfolioError(
                f"replay_capacity is {self.replay_capacity}, less than learning_starts "
                f"({self.learning_starts}) or n_steps × environments ({joined}); raise the one, or "
                "lower the others."
            )

    @property
    def warm_up(self) -> int:
        """Steps of all environments before the buffer has enough to learn from."""
        return max(self.n_steps, math.ceil(self.learning_starts / self.num_envs)) - 1

    def empty(self, row: PyTree) -> "Replay":
        """A buffer for rows like ``row`` that holds nothing yet."""
        return Replay.empty(
            row, self.replay_capacity, self.num_envs, self.n_steps, self.prioritized
        )


class Replay(eqx.Module):
    """Rows of any pytree of numbers; the oldest are overwritten.

    A row is packed into float32, which holds integers exactly up to 2²⁴. One matrix takes one
    in-place write and one gather; of separate columns, XLA would copy each as a whole at each step.
    Rows are written ``width`` at a time and the capacity is rounded up to a multiple of it, so that
    a write never wraps.
    """

    rows: Float[Array, "capacity numbers"]
    position: Int[Array, ""]  # of the next write
    size: Int[Array, ""]  # rows that hold something
    priorities: Priorities | None  # of the rows; None: rows are drawn uniformly
    like: PyTree = eqx.field(static=True)  # shape and type of a row's leaves
    width: int = eqx.field(static=True)  # rows per write
    steps: int = eqx.field(static=True)  # as in ``empty``

    @staticmethod
    def empty(
        row: PyTree, capacity: int, width: int, steps: int = 1, prioritized: bool = False
    ) -> "Replay":
        """Room for ``capacity`` rows shaped like ``row``, written ``width`` at a time.

        steps: writes that a row needs before it can be drawn, its own included.
        """
        capacity = -(-capacity // width) * width
        like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), row)
        numbers = sum(leaf.size for leaf in jax.tree.leaves(like))
        zero = jnp.array(0, jnp.int32)
        priorities = Priorities.empty(capacity) if prioritized else None
        return Replay(jnp.zeros((capacity, numbers)), zero, zero, priorities, like, width, steps)

    def extend(self, rows: PyTree) -> "Replay":
        """Appends rows in the order of time, ``width`` of them for each step."""
        if len(jax.tree.leaves(rows)[0]) == self.width:
            return self.add(rows)
        by_step = jax.tree.map(lambda x: x.reshape(-1, self.width, *x.shape[1:]), rows)
        return lax.scan(lambda replay, rows: (replay.add(rows), None), self, by_step)[0]

    def add(self, rows: PyTree) -> "Replay":
        """Appends ``width`` rows."""
        packed = jnp.concatenate(
            [leaf.reshape(self.width, -1).astype(jnp.float32) for leaf in jax.tree.leaves(rows)],
            axis=1,
        )
        capacity = self.rows.shape[0]
        size = jnp.minimum(self.size + self.width, capacity)
        return dataclasses.replace(
            self,
            rows=lax.dynamic_update_slice_in_dim(self.rows, packed, self.position, axis=0),
            position=(self.position + self.width) % capacity,
            size=size,
            priorities=self._admit(size),
        )

    def _admit(self, size: Int[Array, ""]) -> Priorities | None:
        """Priorities after a write: the highest for rows that can now be drawn."""
        if self.priorities is None:
            return None
        row = jnp.arange(self.width)
        ready = (self.position - (self.steps - 1) * self.width) % self.rows.shape[0] + row
        value = jnp.where(size >= self.steps * self.width, self.priorities.highest, 0.0)
        values = jnp.broadcast_to(value, ready.shape)
        if self.steps > 1:  # the rows just written cannot be drawn yet
            ready = jnp.concatenate([ready, self.position + row])
            values = jnp.concatenate([values, jnp.zeros(self.width)])
        return self.priorities.set(ready, values)

    def sample(self, key: PRNGKeyArray, n: int) -> PyTree:
        """``n`` rows drawn with replacement, as by ``draw``."""
        return self.at(self.draw(key, n))

    def draw(self, key: PRNGKeyArray, n: int) -> Int[Array, " n"]:
        """Indices of ``n`` rows, drawn with replacement, by priority if there are priorities."""
        if self.priorities is not None:
            return self.priorities.draw(key, n)
        # One draw of uniforms instead of randint's two; float32 splits [0, 1) into 2²³ parts.
        uniform = jax.random.uniform(key, (n,))
        if self.steps == 1:
            return (uniform * self.size).astype(jnp.int32)
        ready = self.size - (self.steps - 1) * self.width  # how many, the oldest
        drawn = (uniform * ready).astype(jnp.int32)
        return (self.position - self.size + drawn) % self.rows.shape[0]

    def at(self, index: Int[Array, " n"]) -> PyTree:
        """Rows by their indices."""
        return self.unpack(self.rows[index])

    def latest(self) -> PyTree:
        """The ``width`` rows written last; zeros before the first write."""
        start = (self.position - self.width) % self.rows.shape[0]
        return self.unpack(lax.dynamic_slice_in_dim(self.rows, start, self.width))

    def ahead(self, index: Int[Array, " n"]) -> PyTree:
        """Rows and their successors in the next writes; leading axes (``steps``, n)."""
        offset = self.width * jnp.arange(self.steps)[:, None]
        rows = self.at(((index + offset) % self.rows.shape[0]).reshape(-1))
        return jax.tree.map(lambda x: x.reshape(self.steps, -1, *x.shape[1:]), rows)

    def unpack(self, packed: Float[Array, "n numbers"]) -> PyTree:
        """Rows as they were before they were added."""
        leaves, structure = jax.tree.flatten(self.like)
        ends = [sum(leaf.size for leaf in leaves[: i + 1]) for i in range(len(leaves))]
        parts = jnp.split(packed, ends[:-1], axis=1)
        return jax.tree.unflatten(
            structure,
            [
                part.reshape(-1, *leaf.shape).astype(leaf.dtype)
                for part, leaf in zip(parts, leaves, strict=True)
            ],
        )


def cut(replay: Replay) -> Replay:
    """The buffer with the experience written last marked as the end of its episodes."""
    if replay.steps == 1:
        return replay
    latest = (replay.position - replay.width) % replay.rows.shape[0] + jnp.arange(replay.width)
    marked = replay.rows.at[latest, -1].set(1.0)  # ``last``, the last number of a row
    return dataclasses.replace(replay, rows=marked)


def join(replay: Replay, index: Int[Array, " n"], discount: Scalar) -> tuple[Experience, Discount]:
    """Experience over the buffer's ``steps`` from each row, and the discount of the value after it.

    It ends earlier if the episode does, and leads to the true next observation of its last step.
    """
    if replay.steps == 1:
        return replay.at(index), discount
    steps: Experience = replay.ahead(index)
    assert steps.last is not None
    reward, stop = n_step(steps.reward, steps.last, discount)
    first = jax.tree.map(lambda x: x[0], steps)
    end = jax.tree.map(lambda x: x[stop, jnp.arange(len(stop))], steps)
    joined = first._replace(
        reward=reward, next_observation=end.next_observation, terminal=end.terminal
    )
    return joined, discount ** (stop + 1)
