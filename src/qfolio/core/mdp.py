"""The interfaces of tasks and agents, and the data that passes between them.

Everything here is a pytree, and every method a pure function of pytrees, so that ``jit``, ``vmap``
and ``scan`` apply directly. Agents and tasks never import each other: they meet in the
interfaces of this file.
"""

import abc
import math
from collections.abc import Callable, Hashable, Mapping
from functools import wraps
from numbers import Integral
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Concatenate,
    NamedTuple,
    ParamSpec,
    Protocol,
    TypeVar,
    runtime_checkable,
)

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray, PyTree

from qfolio.core import devices
from qfolio.core.errors import require_type, require_whole
from qfolio.core.fields import require, require_static

P = ParamSpec("P")
T = TypeVar("T")

# Every task and every agent begins with this module: here jax has not made an array yet, after
# which settings of its devices have no effect.
devices.configure()


class Discrete(eqx.Module):
    """A choice among ``n`` actions, numbered from 0."""

    n: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        require_whole("n of Discrete", self.n, 1, 2**31 - 1)


class Simplex(eqx.Module):
    """Weights of cash (first) and ``assets`` assets: non-negative, summing to 1.

    cap: the largest weight of one asset; cash has none.
    """

    assets: int = eqx.field(static=True)
    cap: float = eqx.field(static=True, default=1.0)

    def __check_init__(self) -> None:
        require_whole("assets of Simplex", self.assets, 1, 2**31 - 1)

    unit = 1.0  # the scale of actions for noise and critics

    @property
    def caps(self) -> np.ndarray:
        """The largest weight of each entry, cash first."""
        return np.append(1.0, np.full(self.assets, self.cap))


class Box(eqx.Module):
    """``n`` numbers from −``bound`` to ``bound``; tasks clip actions to this range."""

    n: int = eqx.field(static=True)
    bound: float = eqx.field(static=True, default=math.inf)

    def __check_init__(self) -> None:
        require_whole("n of Box", self.n, 1, 2**31 - 1)

    @property
    def unit(self) -> float:
        """The scale of actions for noise and critics: the bound, or 1 if there is none."""
        return self.bound if math.isfinite(self.bound) else 1.0


Actions = Discrete | Simplex | Box


class Step(NamedTuple):
    """The result of one action; ``terminated`` is true if the task itself ended."""

    state: PyTree
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]


class Transition(NamedTuple):
    """One step as agents store it; a rollout has leading axes (time, environment).

    ``next_observation`` is the true one, from before any reset. ``terminated`` (nothing follows)
    and ``truncated`` (the clock ran out) stay apart, because the value of what follows a truncation
    is not zero (Pardo et al. 2018, "Time limits in reinforcement learning"). The task's states are
    for agents that know the task; the others use observations only.
    """

    state: PyTree
    observation: PyTree
    action: Array
    reward: Array
    next_state: PyTree
    next_observation: PyTree
    terminated: Array
    truncated: Array


@runtime_checkable
class Optimum(Protocol):
    """The exact solution of a task, computed without learning."""

    def returns(self, keys: Key[Array, " start"]) -> np.ndarray:
        """Undiscounted returns of the optimal policy, one for each key's start state."""
        ...


Policy = Callable[[PyTree], Array]
"""A function from a task's state to the intended action."""


class Task(eqx.Module):
    """A Markov decision process with a time limit; no method resets the task by itself.

    A task has a ``horizon``, the steps after which an episode is truncated, and ``actions``, which
    are Discrete, Simplex or Box.
    """

    compiled: ClassVar[bool] = True
    """Whether its steps are part of compiled programs."""

    if TYPE_CHECKING:  # each task has them; for type checkers, Task takes no arguments

        @property
        def horizon(self) -> int: ...

        @property
        def actions(self) -> Actions: ...
    else:
        horizon: eqx.AbstractVar[int]
        actions: eqx.AbstractVar[Actions]

    def __check_init__(self) -> None:
        require_static(self)
        name = type(self).__name__
        require_type(f"horizon of {name}", self.horizon, Integral, "a whole number")
        require(self, "horizon", lambda x: x >= 1, "at least 1")
        require_type(f"actions of {name}", self.actions, Actions, "Discrete, Simplex or Box")

    @property
    def name(self) -> str:
        """The name of the task in messages."""
        return type(self).__name__

    @property
    def referents(self) -> Hashable:
        """What its settings refer to by name (default: nothing).

        Programs are compiled anew if it differs, as after a class has been defined again.
        """
        return ()

    @abc.abstractmethod
    def reset(self, key: PRNGKeyArray) -> PyTree:
        """A start state."""

    @abc.abstractmethod
    def observe(self, state: PyTree) -> PyTree:
        """The agent's observation of a state, without knowledge of the future."""

    @property
    def states(self) -> int | None:
        """The number of observations if they are integers from 0; else None (default)."""
        return None

    @property
    def observation_scale(self) -> tuple[float, ...] | float:
        """The largest absolute value of each component of an observation (default: 1)."""
        return 1.0

    @abc.abstractmethod
    def step(self, state: PyTree, action: Array, key: PRNGKeyArray) -> Step:
        """The consequence of one action."""

    def optimum(self) -> Optimum | None:
        """The exact solution if one is known; else None (default)."""
        return None

    def steps_left(self, state: PyTree) -> Int[Array, ""]:
        """How many steps can follow a state, regardless of the time limit (default: any number)."""
        return jnp.array(jnp.iinfo(jnp.int32).max)

    def intent(self, state: PyTree, action: Array) -> Array:
        """The meaning of a numbered menu action; other actions are returned unchanged."""
        return action

    def measure(self, step: "Transition") -> "Metrics":
        """Named scalars of one step, whose means over each episode are recorded (default: none)."""
        return {}

    def rule(self, policy: Policy) -> Mapping[str, float | None]:
        """A few numbers that describe a policy (default: none).

        Grades compare them with those of the exact policy, so that it is called only if the optimum
        is a ``FollowedOptimum`` of ``qfolio.solvers.followed``. A number is None if the policy does
        not have it, such as an edge that it never trades to.
        """
        return {}


def task_jit(function: Callable[Concatenate[Any, P], T]) -> Callable[Concatenate[Any, P], T]:
    """``eqx.filter_jit`` of a function whose first argument, by position, is a task.

    It compiles anew if what the task refers to differs, see ``Task.referents``.
    """

    @eqx.filter_jit
    def program(_referents: Hashable, *args: Any, **options: Any) -> Any:
        return function(*args, **options)

    @wraps(function)
    def call(task: Any, *args: P.args, **options: P.kwargs) -> T:
        found: T = program(task.referents, task, *args, **options)
        return found

    return call


class Position(NamedTuple):
    """The state of an exogenous task: actions affect the holding, but not the market."""

    market: PyTree
    holding: PyTree


class ExogenousTask(Task):
    """A task whose randomness does not depend on actions, such as prices for a price taker.

    From one observed move of the market, ``settle`` computes the outcome of every action from every
    holding (hindsight learning for exogenous inputs, Sinclair et al. 2023). Agents may call it for
    moves that they have seen; only the training loop calls ``reset_market`` and ``next_market``.
    """

    @property
    def path_dependent(self) -> bool:
        """Whether a reward depends on earlier ones, so that a holding includes a history."""
        return False

    @abc.abstractmethod
    def reset_market(self, key: PRNGKeyArray) -> PyTree:
        """A start state of the market."""

    @abc.abstractmethod
    def next_market(self, market: PyTree, key: PRNGKeyArray) -> PyTree:
        """The next state of the market."""

    @property
    def moves(self) -> Float[Array, ""] | float:
        """The number of moves in the market's data; infinite if they are drawn anew."""
        return math.inf

    def place(self, market: PyTree) -> Float[Array, ""]:
        """The position of a state's move in the data, counted from 0; 0 if moves are drawn anew."""
        return jnp.array(0.0)

    @abc.abstractmethod
    def draw_holding(self, key: PRNGKeyArray) -> PyTree:
        """A random holding, so that an agent learns to act from any."""

    def draw_reachable(self, market: PyTree, key: PRNGKeyArray) -> PyTree:
        """A random holding that actions may lead to in a market (default: any holding)."""
        return self.draw_holding(key)

    def reference(self, market: PyTree, next_market: PyTree) -> Float[Array, ""] | None:
        """The reward of a move to compare others with, such as the anchor's; None by default."""
        return None

    def mirror(self, market: PyTree) -> PyTree | None:
        """The corresponding state on the mirror image of a path; None by default.

        For markets in which each path is as likely as its mirror image. Applied to all states of a
        path, it gives the image.
        """
        return None

    @abc.abstractmethod
    def settle(
        self, market: PyTree, next_market: PyTree, holding: PyTree, action: Array
    ) -> tuple[Float[Array, ""], PyTree]:
        """Reward and next holding of an action, given how the market moved."""

    def shift(self, holding: PyTree, by: Float[Array, " asset"]) -> PyTree:
        """The holding with ``by`` more of each asset."""
        return holding + by

    def reset(self, key: PRNGKeyArray) -> Position:
        market_key, holding_key = jax.random.split(key)
        market = self.reset_market(market_key)
        return Position(market, self.draw_reachable(market, holding_key))

    def step(self, state: Position, action: Array, key: PRNGKeyArray) -> Step:
        market = self.next_market(state.market, key)
        reward, holding = self.settle(state.market, market, state.holding, action)
        return Step(Position(market, holding), reward, jnp.array(False))


Metrics = dict[str, Array]
"""Named scalars that an agent reports at every step."""


class Agent(eqx.Module):
    """An algorithm: hyperparameters are its fields, everything it learns lives in its state."""

    if TYPE_CHECKING:  # each agent has them; for type checkers, Agent takes no arguments

        @property
        def num_envs(self) -> int:
            """Environments that are stepped side by side."""

        @property
        def episode_steps(self) -> int:
            """Steps after which training episodes are cut; 0: the task's horizon."""

        @property
        def discount(self) -> float | None:
            """Discount of the action values; None if the agent estimates none."""
    else:
        num_envs: eqx.AbstractVar[int]
        episode_steps: eqx.AbstractVar[int]
        discount: eqx.AbstractVar[Any]

    def __check_init__(self) -> None:
        require_static(self)
        for name, least in (("num_envs", 1), ("episode_steps", 0), ("rollout_steps", 1)):
            of = f"{name} of {type(self).__name__}"
            require_whole(of, getattr(self, name), least, 2**31 - 1)

    @property
    def rollout_steps(self) -> int:
        """Steps of each environment that the agent learns from at once."""
        return 1

    def whole_rollouts(self, steps: int) -> int:
        """Steps of each environment, rounded up to whole rollouts."""
        return -(-steps // self.rollout_steps) * self.rollout_steps

    @abc.abstractmethod
    def init(self, task: Task, key: PRNGKeyArray) -> Any:
        """The state before any experience."""

    def fitted(self, task: Task) -> "Agent":
        """This agent with the settings that follow from a task (default: none do).

        Raises QfolioError if a number does not fit the task. ``init`` may not see it, because
        numbers are inputs of programs.
        """
        return self

    def warm_up(self) -> int:
        """Steps of each environment that are only observed before learning starts (default: 0)."""
        return 0

    @abc.abstractmethod
    def act(self, state: Any, observation: PyTree, key: PRNGKeyArray) -> Array:
        """Actions for a batch of observations, with exploration."""

    def measure(self, task: Task, step: Transition) -> Metrics:
        """What the log records of a training step (default: what the task measures of it)."""
        return task.measure(step)

    def observe(self, state: Any, rollout: Transition) -> Any:
        """Stores experience and learns nothing, as in the warm-up (default: nothing is stored)."""
        return state

    @abc.abstractmethod
    def learn(
        self, task: Task, state: Any, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[Any, Metrics]:
        """Stores experience and learns from it; may query ``task`` only if it is exogenous."""

    def monitor(self, state: Any) -> Metrics:
        """Named scalars that describe the state, also before any learning (default: none)."""
        return {}

    @abc.abstractmethod
    def weights(self, state: Any) -> PyTree:
        """The part of the state that the learned policy needs."""

    def cut(self, state: Any) -> Any:
        """The state after all current episodes were cut off from outside (default: ``state``).

        Called when a run goes on whose environments could not be restored. Nothing follows the
        latest steps, as if their episodes had been truncated.
        """
        return state

    def carry_over(self, state: Any, fresh: Any) -> Any:
        """The state with which learning continues on other data (default: ``state``).

        It keeps the learned weights, drops stored experience, and begins new episodes. fresh: a
        state before any experience, with the same settings. Both may have a leading member axis.
        """
        return state

    def relearned(self, state: Any) -> int:
        """From how many rollouts it learns anew on newer data; 0 if it goes on (default).

        Evidence must come from data that a member has not learned from. When the data move, so do
        the blocks that members leave out, and members have learned from what they now leave out.
        """
        return 0

    @abc.abstractmethod
    def policy(self, weights: PyTree, observation: PyTree) -> Array:
        """Actions for a batch of observations, without exploration."""

    def action_values(self, weights: PyTree, observation: PyTree) -> Array | None:
        """Q(s, ·) for a batch of observations; None if the agent does not estimate it (default)."""
        return None
