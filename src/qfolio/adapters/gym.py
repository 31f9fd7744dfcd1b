"""qfolio's tasks as environments of Gymnasium, for other libraries' agents.

>>> import gymnasium, qfolio.adapters.gym
>>> env = gymnasium.make("qfolio/Portfolio-v0", prices="prices.csv", cost=0.001, horizon=250)
>>> env = gymnasium.make("qfolio/Pendulum-v0", torques=0)

``IDS`` holds the others, one for each task that ``qfolio train`` knows by name.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qfolio.core import settings, simplex
from qfolio.core.errors import QfolioError, needs, require_type
from qfolio.core.evaluation import step_key
from qfolio.core.market import View
from qfolio.core.mdp import Discrete, Simplex
from qfolio.core.registry import TASKS, find
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.mandate.limits import mandate_text
from qfolio.portfolio.market import RUIN
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import load
from qfolio.portfolio.rewards import Outcome
from qfolio.portfolio.task import Portfolio

with needs(
    "gymnasium", otherwise='qfolio.adapters.gym needs Gymnasium: pip install "qfolio[gym]".'
):
    import gymnasium
    from gymnasium import spaces

ID = "qfolio/Portfolio-v0"

IDS = {name: f"qfolio/{where.partition(':')[2]}-v0" for name, where in TASKS.items()}
"""Environment IDs by task name, such as qfolio/Pendulum-v0."""

_LARGEST = float(np.finfo(np.float32).max)

Observation = dict[str, np.ndarray]


class PortfolioEnv(gymnasium.Env[Observation, Any]):
    """Trade the assets of a price table over ``horizon`` rows, starting from cash.

    **Observation**: "features", for each asset the window of scaled log returns (and any other
    features) up to today, of shape (assets, window, channels); and "holding", the weights of the
    assets held now (the rest is cash), of shape (assets,). Where assets come and go, "tradable" is
    1 for each asset that may be bought now; weight decided for other assets is spread over those,
    in proportion.

    **Action**: N + 1 numbers, cash first. Target weights are the nearest point of the simplex
    (Euclidean projection, no asset above ``max_weight``), so valid weights are used unchanged.
    With a mandate that allows short positions or a loan, the action is the weights of the N assets,
    and cash is the rest. With ``menu`` ("grid:10", "tilts:0.1"), it is the number of an allocation.
    An order that the mandate forbids becomes the nearest one that it allows.

    **Step**: a decision at row t is executed at the close of row t + lag, and its reward is that of
    the return of row t + lag + 1, net of the exact cost. Wealth is simulated in double precision,
    as in the backtest. Episodes are truncated after ``horizon`` steps, and terminate only at ruin.

    ``info`` holds "wealth" (1 at the start), "cost" (share of wealth paid for this step's trade),
    "turnover", "target" (weights decided, cash first), "date" (of the row observed) and
    "return_date" (of the row that earned the last return). Some of these values are of rows
    after the one observed, so agents must not use them.

    Args:
        prices: Anything that ``qfolio.load_prices`` reads (default: skfolio's 20 stocks).
        scaled_by: The table that sets the scale of observations (default: ``prices``); to test on
            later prices, pass the training prices.
        render_mode: "ansi" for a line of text, or None.
        task: Settings of the portfolio task, such as window, lag, cost, max_weight, menu, reward.

    ``reset`` draws the first row, unless given ``options={"start": row}``. Raises QfolioError for
    invalid settings, starts and actions.
    """

    metadata = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        prices: Any = None,
        *,
        scaled_by: Any = None,
        render_mode: str | None = None,
        **task: Any,
    ) -> None:
        if render_mode not in (None, "ansi"):
            raise QfolioError(f"render_mode is {render_mode!r}; it must be 'ansi' or None.")
        self.render_mode = render_mode
        self.prices = load(prices)
        if "mandate" in task:
            task["mandate"] = mandate_text(task["mandate"], self.prices.assets)
        chosen = settings.convert(Portfolio, task)
        self.task = Portfolio.of(self.prices, **chosen)
        self._conditions = Conditions.of(self.prices, self.task.costs)
        if scaled_by is not None:
            other = load(scaled_by)
            if (other.assets, other.feature_names) != (
                self.prices.assets,
                self.prices.feature_names,
            ):
                raise QfolioError("scaled_by must have the assets and features of prices.")
            scale = Portfolio.of(other, **{**chosen, "horizon": 1})  # whatever its length
            self.task = self.task.having(center=scale.center, scale=scale.scale)
        assets, channels = len(self.prices.assets), self.task.center.shape[0]
        self.first = int(self.task.first_decision)
        self.last = int(self.task.last_decision) - self.task.horizon + 1
        self._range = (0.0, 1.0) if self.task.feasible.long_only else (-_LARGEST, _LARGEST)
        self.observation_space = spaces.Dict(
            {
                "features": spaces.Box(
                    -_LARGEST, _LARGEST, (assets, self.task.window, channels), np.float32
                ),
                "holding": spaces.Box(*self._range, (assets,), np.float32),
                **(
                    {} if self.prices.tradable is None else {"tradable": spaces.MultiBinary(assets)}
                ),
            }
        )
        self.action_space = _action_space(self.task.actions)
        self._referents = self.task.referents
        self._row, self._steps = -1, self.task.horizon  # over

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in cash, at a row from ``first`` to ``last``: drawn, or ``start``."""
        super().reset(seed=seed)
        if options is not None:
            require_type("options", options, dict, 'a dictionary, such as {"start": 100}')
        if unknown := sorted({*(options or {})} - {"start"}):
            raise QfolioError(f"options has {unknown[0]!r}; the only option of reset is 'start'.")
        start = (options or {}).get("start")
        if start is None:
            start = self.np_random.integers(self.first, self.last + 1)
        elif not isinstance(start, int | np.integer) or not self.first <= start <= self.last:
            raise QfolioError(
                f"start is {start!r}; an episode of {self.task.horizon} steps can start at rows "
                f"{self.first} to {self.last} of this table."
            )
        self._row, self._steps, self._wealth = int(start), 0, 1.0
        self._held = np.eye(len(self.prices.assets) + 1)[0]
        self._plan = self.task.terms.begin(self._held)
        with jax.enable_x64(True):
            self._memory = _doubled(self.task.reward_function.init())
        self._target, self._cost, self._turnover = self._held, 0.0, 0.0
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes the decision at today's row and moves to the next row.

        Raises QfolioError for an invalid action, or after the end of an episode.
        """
        if self._steps >= self.task.horizon:
            raise QfolioError("The episode is over; call reset() first.")
        row, lag = self._row, self.task.lag
        given = self._checked(action)
        with jax.enable_x64(True):
            ordered, self._plan = _target(
                self._referents, self.task, np.int32(row), self._held, self._plan, given
            )
        target = np.asarray(ordered, float)
        self._target = target / target.sum()
        values, costs = self.prices.values[row : row + lag + 2], self.task.costs
        known = self._conditions.part(row, row + lag + 2)
        traded = simulate(
            values,
            self._target[None],
            first=0,
            cost=costs,
            lag=lag,
            start=self._held,
            conditions=known,
            long_only=self.task.feasible.long_only,
            wealth=self._wealth,
        )
        growth = max(1 + traded.returns[0], RUIN)
        earned = Outcome(growth, traded.cost[0], traded.weights[0])
        with jax.enable_x64(True):
            reward, memory = _reward(
                self._referents, self.task, np.int32(row), self._memory, earned
            )
            self._memory = _doubled(memory)
        coming = np.nan_to_num(values[1] / values[0], nan=1.0)
        self._held = costs.held(self._target, coming, known.holding(0, 1))
        self._wealth *= 1 + float(traded.returns[0])
        self._cost, self._turnover = float(traded.cost[0]), float(traded.turnover[0])
        self._row, self._steps = row + 1, self._steps + 1
        truncated = self._steps >= self.task.horizon and not traded.ruined
        if traded.ruined:
            self._steps = self.task.horizon
        return self._observe(), float(reward), bool(traded.ruined), truncated, self._info()

    def render(self) -> str | None:
        """A line with date, wealth and holdings; None without ``render_mode``."""
        if self.render_mode is None or self._row < 0:
            return None
        named = zip(("cash", *self.prices.assets), self._held, strict=True)
        held = ", ".join(f"{name} {weight:.0%}" for name, weight in named if abs(weight) >= 0.005)
        return f"{self._day(self._row)}  wealth {self._wealth:.4f}  {held}\n"

    def _checked(self, action: Any) -> np.ndarray:
        space = self.action_space
        if isinstance(space, spaces.Discrete):
            if not space.contains(action):
                raise QfolioError(f"The action is {action!r}; it must be from 0 to {space.n - 1}.")
            return np.asarray(action, np.int32)
        try:
            scores = np.asarray(action, float)
        except (TypeError, ValueError):
            scores = np.empty(0)
        if scores.shape != space.shape or not np.isfinite(scores).all():
            wanted = "cash first" if self.task.feasible.long_only else "the weights of the assets"
            right = scores.shape == space.shape
            found = "is not finite" if right else f"has the shape {scores.shape}"
            raise QfolioError(
                f"An action must be {space.shape[0]} finite numbers, {wanted}; this one {found}."
            )
        return scores

    def _observe(self) -> Observation:
        seen = {
            "features": np.array(_features(self.task, np.int32(self._row))),
            "holding": np.clip(self._held[1:], *self._range).astype(np.float32),
        }
        if self.prices.tradable is not None:
            seen["tradable"] = self.prices.tradable[self._row].astype(np.int8)
        return seen

    def _info(self) -> dict[str, Any]:
        earned = self._row + self.task.lag if self._steps else self._row
        return {
            "wealth": self._wealth,
            "cost": self._cost,
            "turnover": self._turnover,
            "target": self._target.copy(),
            "date": self._day(self._row),
            "return_date": self._day(earned),
        }

    def _day(self, row: int) -> str:
        return day(self.prices.dates[row])


_compiled = partial(jax.jit, static_argnums=0)
"""Compiles a function of what a task refers to, the task, and more. An environment looks the first
up once, not at each step as ``task_jit`` does, because that takes longer than a step."""


@_compiled
def _target(_referents: Any, task: Any, row: Any, held: Any, plan: Any, action: Any) -> Any:
    """The weights to trade to, and the plan at the next row."""
    holding = task.hold(held)._replace(plan=plan)
    traded, plan = task.trade(row, holding, task.wanted(row, holding, _on_simplex(task, action)))
    return traded, task.planned(row, plan)


@_compiled
def _reward(_referents: Any, task: Any, row: Any, memory: Any, earned: Outcome) -> Any:
    """The reward of a row, and the reward's state after it."""
    reward, memory = task.reward_function(memory, earned)
    return task.compared(row, row + 1, reward), memory


@jax.jit
def _features(task: Any, row: Any) -> Any:
    return task.features(row)


def _doubled(tree: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x, float), tree)


def _on_simplex(task: Any, action: Any) -> Any:
    if isinstance(task.actions, Simplex):
        return simplex.project(action, jnp.asarray(task.actions.caps))
    return action


def _action_space(actions: Any) -> spaces.Space[Any]:
    if isinstance(actions, Discrete):
        return spaces.Discrete(actions.n)
    if isinstance(actions, Simplex):
        return spaces.Box(-1.0, 1.0, (actions.assets + 1,), np.float32)
    return spaces.Box(-actions.bound, actions.bound, (actions.n,), np.float32)


class TaskEnv(gymnasium.Env[Any, Any]):
    """A task that ``qfolio train`` knows by name, as a compiled environment.

    Observations are those of qfolio's agents: a vector (Box), the index of a state (Discrete)
    or, in markets, a Dict of each asset's "features" and the "holding". Actions are an index
    (Discrete) or a vector (Box); portfolio weights are projected onto the nearest point of the
    simplex. Episodes are truncated after the task's ``horizon``. Raises QfolioError for invalid
    settings and actions.

    Args:
        name: The task, such as "pendulum".
        render_mode: Must be None.
        chosen: Settings of the task, such as torques=0.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, name: str, *, render_mode: str | None = None, **chosen: Any) -> None:
        if render_mode is not None:
            raise QfolioError(f"render_mode is {render_mode!r}; {name} has none.")
        task: Any = settings.build(find("task", name), chosen)
        self.task, self._steps = task, task.horizon  # over
        self._referents = task.referents
        self._there = jax.device_put(task)  # copies its arrays once, not at each step
        seen = jax.eval_shape(lambda key: task.observe(task.reset(key)), jax.random.key(0))
        number = lambda x: spaces.Box(-_LARGEST, _LARGEST, x.shape, np.float32)  # noqa: E731
        self._named = isinstance(seen, View)
        self.observation_space: spaces.Space[Any]
        if task.states is not None:
            self.observation_space = spaces.Discrete(task.states)
        elif self._named:
            shown = {k: number(x) for k, x in seen._asdict().items() if x is not None}
            self.observation_space = spaces.Dict(shown)
        else:
            self.observation_space = number(seen)
        self.action_space = _action_space(task.actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Draws a start state."""
        super().reset(seed=seed)
        self._steps = 0
        self._seed = np.uint32(self.np_random.integers(2**32, dtype=np.uint32))
        self._state, observation = _reset(self._referents, self._there, self._seed)
        return self._as_numpy(observation), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step of the task; raises QfolioError after the end of an episode."""
        if self._steps >= self.task.horizon:
            raise QfolioError("The episode is over; call reset() first.")
        numbered = isinstance(self.action_space, spaces.Discrete)
        try:
            given = np.asarray(action, None if numbered else np.float32)
        except (TypeError, ValueError):
            given = np.empty(0)
        if not self.action_space.contains(given) or not np.isfinite(given).all():
            raise QfolioError(f"The action is {action!r}; it must be in {self.action_space}.")
        given = given.astype(np.int32) if numbered else given
        time = np.int32(self._steps)
        after, observation = _step(
            self._referents, self._there, self._state, given, self._seed, time
        )
        self._state, self._steps = after.state, self._steps + 1
        terminated = bool(after.terminated)
        truncated = self._steps >= self.task.horizon and not terminated
        if terminated:
            self._steps = self.task.horizon
        return self._as_numpy(observation), float(after.reward), terminated, truncated, {}

    def _as_numpy(self, observation: Any) -> Any:
        if self._named:
            return {name: np.array(x) for name, x in observation._asdict().items() if x is not None}
        if isinstance(self.observation_space, spaces.Discrete):
            return np.int64(observation)
        return np.array(observation, np.float32)


@_compiled
def _reset(_referents: Any, task: Any, seed: Any) -> Any:
    state = task.reset(jax.random.key(seed))
    return state, task.observe(state)


@_compiled
def _step(_referents: Any, task: Any, state: Any, action: Any, seed: Any, time: Any) -> Any:
    key = step_key(jax.random.key(seed), time)
    after = task.step(state, _on_simplex(task, action), key)
    return after, task.observe(after.state)


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point="qfolio.adapters.gym:PortfolioEnv")
for _name, _id in IDS.items():
    if _id not in gymnasium.registry:
        gymnasium.register(_id, entry_point="qfolio.adapters.gym:TaskEnv", kwargs={"name": _name})
