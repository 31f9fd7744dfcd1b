"""Exact solutions of finite Markov decision processes (Bellman 1957; Howard 1960), in float64.

Policy iteration, which solves the linear equations of one policy after another, returns action
values Q, one row for each state. With ``epsilon`` it finds the best of the policies that take a
random action with that probability, which SARSA learns.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key
from scipy.sparse import csr_matrix, eye_array
from scipy.sparse.linalg import spsolve

from qfolio.core.evaluation import step_key
from qfolio.core.mdp import Task
from qfolio.solvers.shared import require

Values = Float[np.ndarray, "state action"]


class Model(NamedTuple):
    """A process as tables: each action in each state has a number of outcomes.

    ``successors`` are the next states, ``transitions`` their probabilities and ``rewards`` their
    rewards. Terminal states lead to themselves with reward 0.
    """

    transitions: Float[np.ndarray, "state action outcome"]
    rewards: Float[np.ndarray, "state action outcome"]
    successors: Int[np.ndarray, "state action outcome"]
    terminal: Bool[np.ndarray, " state"]


class FiniteOptimum:
    """The optimum of a task over the states of a model; the task's states are their numbers."""

    def __init__(self, task: Task, model: Model) -> None:
        self.task, self.model = task, model

    def returns(self, keys: Key[Array, " start"]) -> np.ndarray:
        """Undiscounted returns over the task's horizon of the best policy, one for each key.

        They use the random numbers of an evaluation, so that an optimal agent earns the same;
        ``expected`` gives their expectations.
        """
        _, policy = finite_horizon(self.model, self.task.horizon)
        return np.asarray(_follow(self.task, jnp.asarray(policy), keys))

    def expected(self) -> Float[np.ndarray, " state"]:
        """The best expected undiscounted return over the task's horizon, from each state."""
        return finite_horizon(self.model, self.task.horizon)[0]

    def action_values(self, discount: float, epsilon: float = 0.0) -> Values:
        """Q of the best (or the best ε-soft) policy of the discounted infinite-horizon problem."""
        return policy_iteration(self.model, discount, epsilon)


@eqx.filter_jit
def _follow(
    task: Task, policy: Int[Array, "time state"], keys: Key[Array, " start"]
) -> Float[Array, " start"]:
    def step(states: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        time, actions = now
        step_keys = jax.vmap(step_key, (0, None))(keys, time)  # common random numbers
        after = jax.vmap(task.step)(states, actions[states], step_keys)
        return after.state, after.reward

    times = jnp.arange(task.horizon)
    return lax.scan(step, jax.vmap(task.reset)(keys), (times, policy))[1].sum(0)


def look_ahead(model: Model, values: Float[np.ndarray, " state"], discount: float) -> Values:
    """E[r + γ V(s')] of every action in every state."""
    following = model.rewards + discount * values[model.successors]
    return (model.transitions * following).sum(-1)


def policy_iteration(model: Model, discount: float, epsilon: float = 0.0) -> Values:
    """Q to rounding error, by the exact values of ever better policies.

    Raises QfolioError unless 0 ≤ discount < 1 and 0 ≤ epsilon ≤ 1.
    """
    require(0 <= epsilon <= 1, f"epsilon is {epsilon}; it must be between 0 and 1")
    states, actions, _ = model.transitions.shape
    best = np.zeros(states, int)
    while True:
        policy = np.full((states, actions), epsilon / actions)
        policy[np.arange(states), best] += 1 - epsilon
        values = policy_evaluation(model, policy, discount)
        # Gains within rounding error are ignored, or two equal actions would alternate forever.
        held = np.take_along_axis(values, best[:, None], axis=1)[:, 0]
        better = values.max(-1) > held + 1e-12 * max(1.0, float(np.abs(values).max()))
        if not better.any():
            return values
        best = np.where(better, values.argmax(-1), best)


def policy_evaluation(model: Model, policy: Values, discount: float) -> Values:
    """Q of the policy that takes each action with the given probability; rows sum to 1.

    Raises QfolioError unless 0 ≤ discount < 1.
    """
    require(
        0 <= discount < 1,
        f"The discount is {discount}; with an infinite horizon it must be at least 0 and below 1",
    )
    states = len(policy)
    weights = policy[:, :, None] * model.transitions
    here = np.broadcast_to(np.arange(states)[:, None, None], weights.shape)
    entries = (weights.ravel(), (here.ravel(), model.successors.ravel()))
    moves = csr_matrix(entries, shape=(states, states))
    rewards = (weights * model.rewards).sum((1, 2))
    values = np.atleast_1d(spsolve((eye_array(states) - discount * moves).tocsc(), rewards))
    return look_ahead(model, np.where(model.terminal, 0.0, values), discount)


def finite_horizon(
    model: Model, steps: int
) -> tuple[Float[np.ndarray, " state"], Int[np.ndarray, "time state"]]:
    """The best expected sum of ``steps`` rewards from each state, and the actions that earn it."""
    values = np.zeros(len(model.terminal))
    policy = np.zeros((steps, len(values)), np.int32)
    for time in reversed(range(steps)):
        q = look_ahead(model, values, 1.0)
        values, policy[time] = q.max(-1), q.argmax(-1)
    return values, policy
