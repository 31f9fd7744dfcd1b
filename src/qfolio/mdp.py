"""The vocabulary: what a task is, what an agent is, and what passes between them.

Everything here is a pytree, and every method a pure function of pytrees, so that ``jit``, ``vmap``
and ``scan`` apply without ceremony. Agents never import tasks and tasks never import agents: both
know only this file.
"""

import abc
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree


class Discrete(eqx.Module):
    """A choice among ``n`` actions, numbered from 0."""

    n: int = eqx.field(static=True)


class Step(NamedTuple):
    """What one action leads to: ``terminated`` is true where the task itself ended."""

    state: PyTree
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]


class Transition(NamedTuple):
    """One step as an agent remembers it; a rollout has leading axes (time, environment).

    ``next_observation`` is the true one, from before any reset. ``terminated`` (nothing follows)
    and ``truncated`` (the clock ran out) stay apart, because the value of what follows a truncation
    is not zero (Pardo et al. 2018, "Time limits in reinforcement learning").
    """

    observation: PyTree
    action: Array
    reward: Array
    next_observation: PyTree
    terminated: Array
    truncated: Array


@runtime_checkable
class Optimum(Protocol):
    """The exact answer of a task, computed without learning."""

    def returns(self, keys: Key[Array, " start"]) -> np.ndarray:
        """Undiscounted returns of the optimal policy, one for each start that a key draws."""
        ...


class Task(eqx.Module):
    """A Markov decision process with a time limit; no method resets the task by itself."""

    horizon: eqx.AbstractVar[int]
    actions: eqx.AbstractVar[Discrete]

    @abc.abstractmethod
    def reset(self, key: PRNGKeyArray) -> PyTree:
        """A start state."""

    @abc.abstractmethod
    def observe(self, state: PyTree) -> Array:
        """What the agent may see of a state; nothing later than now."""

    @property
    def observation_scale(self) -> tuple[float, ...] | float:
        """The range ± of each component of an observation."""
        return 1.0

    @abc.abstractmethod
    def step(self, state: PyTree, action: Array, key: PRNGKeyArray) -> Step:
        """The consequence of one action."""

    def optimum(self) -> Optimum | None:
        """The exact solution, where one is known."""
        return None


Metrics = dict[str, Array]
"""Named scalars that an agent reports at every step."""


class Agent(eqx.Module):
    """An algorithm: hyperparameters are its fields, everything it learns lives in its state."""

    environments: eqx.AbstractVar[int]  # stepped side by side
    episode_steps: eqx.AbstractVar[int]  # training episodes are cut here; 0: the task's horizon
    discount: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def init(self, task: Task, key: PRNGKeyArray) -> Any:
        """The state before any experience."""

    @abc.abstractmethod
    def warm_up(self) -> int:
        """Steps of each environment that are only observed before learning starts."""

    @abc.abstractmethod
    def act(self, state: Any, observation: Array, key: PRNGKeyArray) -> Array:
        """Actions for a batch of observations, with exploration."""

    @abc.abstractmethod
    def observe(self, state: Any, rollout: Transition) -> Any:
        """Stores experience and learns nothing."""

    @abc.abstractmethod
    def learn(self, state: Any, rollout: Transition, key: PRNGKeyArray) -> tuple[Any, Metrics]:
        """Stores experience and learns from it."""

    def monitor(self, state: Any) -> Metrics:
        """Named scalars that describe the state at any time, before learning too."""
        return {}

    @abc.abstractmethod
    def weights(self, state: Any) -> PyTree:
        """The part of the state that the learned policy needs."""

    @abc.abstractmethod
    def policy(self, weights: PyTree, observation: Array) -> Array:
        """Actions for a batch of observations, without exploration."""

    def action_values(self, weights: PyTree, observation: Array) -> Array | None:
        """Q(s, ·) for a batch of observations, where the agent estimates it."""
        return None

    def contrast(self) -> "tuple[str, Agent] | None":
        """A variant with one thing changed that a report sets beside this agent, and its name."""
        return None
