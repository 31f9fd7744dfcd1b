"""Action values in a table, for tasks whose observation is a number: Q-learning and its relatives.

A step (s, a, r, s') moves one entry of the table towards a target, Q(s, a) ← Q(s, a) + α (r + γ
v(s') − Q(s, a)), with v(s') = 0 if the task terminated, but not at a time limit. The agents differ
in v(s'), the estimate of the next state's value:

- Q-learning (Watkins 1989): max_a Q(s', a).
- SARSA (Rummery & Niranjan 1994): Q(s', a') of the next action.
- Expected SARSA (van Seijen et al. 2009): the mean of Q(s', ·) over the ε-greedy policy.
- Double Q-learning (van Hasselt 2010): two tables; one selects the best action, the other values
  it, and a fair coin decides which of them learns.

docs/algorithms/tabular.md lists every formula and each deviation from the papers.
"""

import abc
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from qfolio.core.errors import QfolioError
from qfolio.core.fields import Group, number, require, static
from qfolio.core.mdp import Agent, Discrete, Metrics, Task, Transition
from qfolio.learning.exploration import EpsilonSchedule, epsilon_greedy
from qfolio.learning.targets import bootstrap, td_target

Tables = Float[Array | np.ndarray, "*member table state action"]
"""One table, or two for double Q-learning, which acts on their mean."""


class Move(NamedTuple):
    """A step of each environment; states are numbers."""

    state: Int[Array, " batch"]
    action: Int[Array, " batch"]
    reward: Float[Array, " batch"]
    next_state: Int[Array, " batch"]
    terminated: Bool[Array, " batch"]
    truncated: Bool[Array, " batch"]

    @classmethod
    def of(cls, rollout: Transition) -> "Move":
        """The only step of a rollout."""
        step = (rollout.observation, rollout.action, rollout.reward, rollout.next_observation)
        return cls(*(x[0] for x in (*step, rollout.terminated, rollout.truncated)))


class TableState(eqx.Module):
    """The state of a tabular agent."""

    # Value and number of updates, which sets the step size. They are one array, and learning
    # reports no errors, because XLA would otherwise copy the tables at every step.
    cells: Float[Array, "table state action 2"]
    episodes: Int[Array, ""]  # finished; ε follows it

    @property
    def tables(self) -> Tables:
        """The action values, of shape (table, state, action)."""
        return self.cells[..., 0]


State = TypeVar("State", bound=TableState)


class Tabular(Agent):
    """A table of action values and ε-greedy actions; subclasses define ``improve``."""

    num_envs: int = static(1)  # environments stepped side by side
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    discount: float = number(0.99)  # γ, the discount per step
    learning_rate: float = number(0.1)  # α: how far an entry moves towards its target
    learning_rate_decay: float = number(0.0)  # d: after n updates of an entry, α/(1 + d n)
    initial_value: float = number(0.0)  # of every entry; optimistic above the largest return
    epsilon_start: float = number(1.0)  # share of random actions at the start
    epsilon_end: float = number(0.01)  # least share of random actions
    epsilon_decay: float = number(0.995)  # factor on ε per finished episode

    count = 1  # of tables

    _epsilon = Group(EpsilonSchedule)

    def __check_init__(self) -> None:
        require(self, "num_envs", lambda x: 1 <= x <= 4096, "from 1 to 4096")
        fractions = "discount learning_rate epsilon_start epsilon_end epsilon_decay"
        require(self, fractions, lambda x: 0 <= x <= 1, "between 0 and 1")
        require(self, "learning_rate_decay", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "initial_value", lambda x: abs(x) <= 1e30, "from −1e30 to 1e30")

    def init(self, task: Task, key: PRNGKeyArray) -> TableState:
        if task.states is None or not isinstance(task.actions, Discrete):
            missing = "numbered states" if task.states is None else "numbered actions"
            raise QfolioError(
                f"A table needs {missing}, but {task.name} has none; use a task that has, "
                "such as pendulum/grid, or another agent, such as dqn."
            )
        shape = (self.count, task.states, task.actions.n)
        full = jnp.full(shape, jnp.asarray(self.initial_value, jnp.float32))
        return TableState(jnp.stack([full, jnp.zeros(shape)], -1), jnp.array(0, jnp.int32))

    def monitor(self, state: TableState) -> Metrics:
        return {"epsilon": self._epsilon(state.episodes)}

    def weights(self, state: TableState) -> Tables:
        return state.tables

    def action_values(
        self, weights: Tables, observation: Int[Array, "*batch"]
    ) -> Float[Array, "*batch action"]:
        return jnp.asarray(weights)[:, observation].mean(0)

    def policy(self, weights: Tables, observation: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
        return self.action_values(weights, observation).argmax(-1)

    def act(
        self, state: TableState, observation: Int[Array, " batch"], key: PRNGKeyArray
    ) -> Int[Array, " batch"]:
        values = self.action_values(state.tables, observation)
        return epsilon_greedy(key, values, self._epsilon(state.episodes))

    def learn(
        self, task: Task, state: State, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[State, Metrics]:
        move, states = Move.of(rollout), state.cells.shape[1]
        # What is added beyond a table is dropped: a state that is none spoils the first instead.
        there = (move.state >= 0) & (move.state < states)
        seen, reward = jnp.where(there, move.state, 0), jnp.where(there, move.reward, jnp.nan)
        state = self.improve(state, move._replace(state=seen, reward=reward), key)
        return self.observe(state, rollout), {}

    @abc.abstractmethod
    def improve(self, state: Any, move: Move, key: PRNGKeyArray) -> Any:
        """The state after learning from a step of each environment."""

    def observe(self, state: State, rollout: Transition) -> State:
        finished = (rollout.terminated | rollout.truncated).sum(dtype=jnp.int32)
        return eqx.tree_at(lambda s: s.episodes, state, state.episodes + finished)

    def update(
        self,
        state: State,
        move: Move,
        following: Float[Array, " batch"],
        table: Int[Array, " batch"] | int = 0,
    ) -> State:
        """Moves each entry towards r + γ v(s'), with v(s') as ``following``."""
        _, states, actions, _ = state.cells.shape
        entry = (table * states + move.state) * actions + move.action
        cells = state.cells.reshape(-1, 2)
        value, visits = cells[entry].T
        error = td_target(move.reward, move.terminated, following, self.discount) - value
        # An array that is read beyond its end gives its last entry, so two states would share it.
        there = (move.next_state >= 0) & (move.next_state < states)
        error = jnp.where(there, error, jnp.nan)
        rate = self.learning_rate / (1 + self.learning_rate_decay * visits)
        step = jnp.stack([step_share(entry, rate) * error, jnp.ones_like(error)], 1)
        if len(entry) == 1:  # a dummy row: XLA scatters two in place, but not one
            entry, step = jnp.append(entry, len(cells)), jnp.concatenate([step, step])
        cells = cells.at[entry].add(step).reshape(state.cells.shape)
        return eqx.tree_at(lambda s: s.cells, state, cells)


def step_share(entry: Int[Array, " batch"], rate: Float[Array, " batch"]) -> Float[Array, " batch"]:
    """The share of each error that is added to its entry: α, if no other move has that entry.

    n moves of one entry together have the effect of n steps of α towards their mean target:
    1 − (1 − α)ⁿ.
    """
    if len(entry) == 1:
        return rate
    n = (entry[:, None] == entry).sum(1)
    return jnp.where(n == 1, rate, (1 - (1 - rate) ** n) / n)


class QLearning(Tabular):
    """Q-learning: targets the best action's value, whichever action is taken."""

    def improve(self, state: TableState, move: Move, key: PRNGKeyArray) -> TableState:
        return self.update(state, move, state.tables[0, move.next_state].max(-1))


class ExpectedSarsa(Tabular):
    """Expected SARSA: targets the mean value of the ε-greedy policy's actions."""

    def improve(self, state: TableState, move: Move, key: PRNGKeyArray) -> TableState:
        epsilon, values = self._epsilon(state.episodes), state.tables[0, move.next_state]
        following = (1 - epsilon) * values.max(-1) + epsilon * values.mean(-1)
        return self.update(state, move, following)


class DoubleQ(Tabular):
    """Double Q-learning: one table selects the best action, the other values it."""

    count = 2

    def improve(self, state: TableState, move: Move, key: PRNGKeyArray) -> TableState:
        batch = jnp.arange(self.num_envs)
        learner = jax.random.bernoulli(key, shape=batch.shape).astype(jnp.int32)
        values = state.tables[:, move.next_state]
        following = bootstrap(values[1 - learner, batch], selector=values[learner, batch])
        return self.update(state, move, following, learner)


class SarsaState(TableState):
    """A table and the last step."""

    last: Move  # waits for the next action


class Sarsa(Tabular):
    """SARSA: targets the value of the next action.

    Learning from a step waits until the next one shows that action. After a truncation there is
    none, and one is drawn from the policy.
    """

    def init(self, task: Task, key: PRNGKeyArray) -> SarsaState:
        state = super().init(task, key)
        zeros = jnp.zeros(self.num_envs, jnp.int32)
        never = zeros.astype(bool)
        # No step waits at first: updates of a state that does not exist are dropped.
        nowhere = jnp.full_like(zeros, state.tables.shape[1])
        last = Move(nowhere, zeros, zeros.astype(jnp.float32), zeros, never, never)
        return SarsaState(state.cells, state.episodes, last)

    def improve(self, state: SarsaState, move: Move, key: PRNGKeyArray) -> SarsaState:
        last = state.last
        values = state.tables[0, last.next_state]
        drawn = epsilon_greedy(key, values, self._epsilon(state.episodes))
        action = jnp.where(last.truncated, drawn, move.action)
        following = jnp.take_along_axis(values, action[:, None], axis=1)[:, 0]
        state = self.update(state, last, following)
        return eqx.tree_at(lambda s: s.last, state, move)

    def cut(self, state: SarsaState) -> SarsaState:
        return eqx.tree_at(lambda s: s.last.truncated, state, jnp.ones(self.num_envs, bool))

    def carry_over(self, state: SarsaState, fresh: SarsaState) -> SarsaState:
        return eqx.tree_at(lambda s: s.last, state, fresh.last)
