"""Any environment of Gymnasium as a task.

``qfolio train gym:CartPole-v1`` makes one. The environment itself cannot be compiled: ``host.py``
steps it. This file provides the shapes that agents need and converts observations and actions.
"""

import copy
import json
import math
from typing import Any, NamedTuple, NoReturn

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from qfolio.core.errors import QfolioError, needs, one_line, require_type
from qfolio.core.fields import require, static
from qfolio.core.host import HostTask
from qfolio.core.mdp import Box, Discrete, Step
from qfolio.core.registry import import_own
from qfolio.core.text import near

UNLIMITED = 1000
"""Steps after which an episode is truncated if the environment itself has no time limit."""

_ELSEWHERE = {
    "id": "the task names the environment, as in gym:CartPole-v1",
    "max_episode_steps": "set horizon instead, as in --set horizon=500",
}
"""Arguments of ``gymnasium.make`` that are set elsewhere."""


class GymnasiumTask(HostTask):
    """An environment by its ID in Gymnasium's registry, such as ``CartPole-v1``.

    Observations are numbers (a Box, of any shape) or one of ``states`` numbers (Discrete). Actions
    are numbered (Discrete), or coordinates from −1 to 1, scaled to the space's bounds (Box).
    Raises QfolioError for other spaces, for an unknown ID and if a dependency is not installed.
    """

    id: str = static("CartPole-v1")  # ID; with a module to import first: my_module:MyEnv-v0
    kwargs: str = static("")  # arguments of gymnasium.make, as JSON: {"continuous": true}
    horizon: int = static(0)  # steps of an episode; 0: the environment's limit

    def __post_init__(self) -> None:
        require_type("id", self.id, str, "the ID of an environment, such as 'CartPole-v1'")
        require_type("kwargs", self.kwargs, str, "JSON, such as '{\"continuous\": true}'")
        if not self.horizon:
            self.horizon = self.facts.limit

    def __check_init__(self) -> None:
        require(self, "horizon", lambda x: 1 <= x < 2**31, "from 0 to 2³¹ − 1")

    @property
    def name(self) -> str:
        return self.id

    @property
    def facts(self) -> "Facts":
        return _facts(self.id, self.kwargs)

    @property
    def actions(self) -> Discrete | Box:
        return self.facts.actions

    @property
    def states(self) -> int | None:
        return self.facts.states

    @property
    def observation_scale(self) -> tuple[float, ...] | float:
        """The bounds of an observation's numbers; 1 for those without a bound below a million."""
        return self.facts.scale

    @property
    def observation(self) -> tuple[tuple[int, ...], type]:
        """Shape and type of an observation."""
        return self.facts.shape, np.float32 if self.states is None else np.int32

    def reset(self, key: PRNGKeyArray) -> Array:
        """A placeholder: the state is in the environment."""
        return jnp.zeros(())

    def observe(self, state: Array) -> Array:
        """An observation of zeros, for its shape."""
        return jnp.zeros(*self.observation)

    def step(self, state: Array, action: Array, key: PRNGKeyArray) -> Step:
        raise QfolioError(f"{self.id} cannot be compiled; qfolio.train steps it from Python.")

    def make(self, **options: Any) -> Any:
        """The environment without its time limit and checks, which ``host.py`` applies itself."""
        return _make(self.id, self.kwargs, **options)


class Facts(NamedTuple):
    """An environment's constants, and the conversion of observations and actions."""

    limit: int  # of an episode, in steps
    shape: tuple[int, ...]  # of an observation
    states: int | None
    first_state: int
    scale: tuple[float, ...] | float
    actions: Discrete | Box
    first_action: int
    low: np.ndarray  # bounds of a Box of actions
    high: np.ndarray

    def given(self, actions: np.ndarray) -> list[Any]:
        """A batch of agents' actions in the environment's format."""
        if isinstance(self.actions, Discrete):
            return (actions.ravel() + self.first_action).tolist()
        # A diverged agent is detected by its losses; the environment should not get its NaN.
        share = (np.clip(np.nan_to_num(actions), -1.0, 1.0) + 1) / 2
        whole = np.issubdtype(self.low.dtype, np.integer)
        low, high = (x.astype(float) if whole else x for x in (self.low, self.high))
        share = share.reshape(-1, *low.shape)
        # Not low + share * (high - low): the range may overflow. Rounding may lead beyond a bound.
        made = np.clip(low * (1 - share) + high * share, low, high)
        return list(np.rint(made).astype(self.low.dtype) if whole else made)

    def seen(self, observation: Any) -> Any:
        """An environment's observation in the agents' format.

        Raises QfolioError for a number that is none of its states.
        """
        if self.states is None:
            return observation
        seen = observation - self.first_state
        if np.ndim(seen) == 0 and not (0 <= seen < self.states and seen == int(seen)):
            last = self.first_state + self.states - 1
            raise QfolioError(
                f"its observation is {observation} and its observation space has the whole numbers "
                f"from {self.first_state} to {last}"
            )
        return seen


def _facts(id: str, kwargs: str) -> Facts:
    """The facts of an environment, read again if another one is registered with its ID."""
    spec, (known, facts) = _spec(id), _known.get((id, kwargs), (None, None))
    if facts is None or known is not spec:
        facts = _read(id, kwargs)
        _known[id, kwargs] = spec, facts
    return facts


_known: dict[tuple[str, str], tuple[Any, Facts]] = {}


def _read(id: str, kwargs: str) -> Facts:
    spaces = _gymnasium().spaces
    env = _make(id, kwargs)
    seen: Any = getattr(env, "observation_space", None)
    done: Any = getattr(env, "action_space", None)
    env.close()
    if isinstance(seen, spaces.Box):
        low, high = seen.low.astype(float), seen.high.astype(float)
        bounds = np.maximum(np.abs(low), np.abs(high)).ravel()
        known = (bounds > 0) & (bounds < 1e6)
        scale = tuple(np.where(known, bounds, 1.0).tolist())
    elif not isinstance(seen, spaces.Discrete):
        _refuse(id, "observations", seen, "Discrete or a Box", "FlattenObservation")
    numbered = isinstance(done, spaces.Discrete)
    if not numbered and not (isinstance(done, spaces.Box) and done.is_bounded()):
        _refuse(id, "actions", done, "Discrete or a Box with bounds", "TransformAction")
    discrete = isinstance(seen, spaces.Discrete)
    return Facts(
        limit=_spec(id).max_episode_steps or UNLIMITED,
        shape=() if discrete else seen.shape,
        states=int(seen.n) if discrete else None,
        first_state=int(seen.start) if discrete else 0,
        scale=1.0 if discrete else scale,
        actions=Discrete(int(done.n)) if numbered else Box(math.prod(done.shape), 1.0),
        first_action=int(done.start) if numbered else 0,
        low=np.zeros(0) if numbered else done.low,
        high=np.zeros(0) if numbered else done.high,
    )


def _refuse(id: str, what: str, space: Any, wanted: str, wrapper: str) -> NoReturn:
    raise QfolioError(
        f"The {what} of {id} are {space}, but agents need {wanted}; register it with a wrapper "
        f"that converts them, such as gymnasium.wrappers.{wrapper}."
    )


def _make(id: str, kwargs: str, **options: Any) -> Any:
    error, arguments = _gymnasium().error, _arguments(kwargs)
    spec = copy.deepcopy(_spec(id))
    spec.order_enforce, spec.disable_env_checker = False, True  # they cost a third of a step
    try:
        return _gymnasium().make(spec, max_episode_steps=-1, **arguments, **options)
    except (error.DependencyNotInstalled, ImportError) as reason:
        box2d = 'pip install "qfolio[box2d]".' if "ox2" in str(reason) else _sentence(reason)
        raise QfolioError(f"{id} needs more than Gymnasium: {box2d}") from None
    except TypeError as reason:
        raise QfolioError(f"{id} cannot be made with kwargs={kwargs} ({reason}).") from None
    except error.Error as reason:
        raise QfolioError(f"{id} cannot be made: {_sentence(reason)}") from None
    except Exception as reason:  # of the environment's own code
        given = f" with kwargs={kwargs}" if kwargs else ""
        raise QfolioError(f"{id} cannot be made{given}: {one_line(reason)}.") from reason


def _spec(id: str) -> Any:
    """Gymnasium's specification of an ID."""
    gymnasium = _gymnasium()
    module, _, name = id.rpartition(":")
    try:
        if module or name.startswith("qfolio/"):
            import_own(module or "qfolio.adapters.gym")
        return gymnasium.spec(name)
    except gymnasium.error.Error as reason:
        space = name.rpartition("/")[0]
        there = [other for other in gymnasium.registry if other.rpartition("/")[0] == space]
        hint = near(name, there) if there else _sentence(reason)
        raise QfolioError(f"Gymnasium has no environment {name!r}; {hint}") from None


def _arguments(kwargs: str) -> dict[str, Any]:
    try:
        arguments = json.loads(kwargs or "{}")
    except ValueError:
        arguments = None
    if isinstance(arguments, dict):
        for name, instead in _ELSEWHERE.items():
            if name in arguments:
                raise QfolioError(f"kwargs sets {name}; {instead}.")
        return arguments
    raise QfolioError(
        f"kwargs is {kwargs}; it must be a JSON object, for example "
        """'kwargs={"continuous": true}'."""
    )


def _sentence(reason: Exception) -> str:
    return " ".join(str(reason).split()).rstrip(".") + "."


def _gymnasium() -> Any:
    with needs("gymnasium", otherwise='gym: needs Gymnasium: pip install "qfolio[gym]".'):
        import gymnasium
    return gymnasium
