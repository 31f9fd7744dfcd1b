"""The optimum of a task whose best policy is known, by that policy's returns in an evaluation."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Key, PyTree

from qfolio.core.evaluation import step_key
from qfolio.core.mdp import ExogenousTask


class FollowedOptimum:
    """Returns of an exact policy, with an evaluation's start states and random numbers.

    policy: from a state of ``task`` to an action.
    """

    def __init__(self, task: ExogenousTask, policy: Callable[[PyTree], Array]) -> None:
        self.task, self.policy = task, policy

    def returns(self, keys: Key[Array, " start"]) -> np.ndarray:
        """Undiscounted returns over the task's horizon, one for each key."""
        return np.asarray(_follow(self.task, self.policy, keys))


@eqx.filter_jit(donate="none")
def _follow(task: ExogenousTask, policy: Any, keys: Key[Array, " start"]) -> Array:
    def step(states: PyTree, time: Array) -> tuple[PyTree, Array]:
        step_keys = jax.vmap(step_key, (0, None))(keys, time)  # common random numbers
        after = jax.vmap(task.step)(states, jax.vmap(policy)(states), step_keys)
        return after.state, after.reward

    return lax.scan(step, jax.vmap(task.reset)(keys), jnp.arange(task.horizon))[1].sum(0)
