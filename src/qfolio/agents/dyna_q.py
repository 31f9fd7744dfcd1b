"""Dyna-Q (Sutton 1990): Q-learning that also learns a model, and from what the model imagines.

Each real step is learned from as by Q-learning, and counted: how often action a of state s led to
s', and with what reward on average. Then ``planning`` imagined steps follow: a state and action
that was seen before, any of them alike, with an outcome drawn by its count. They are learned from
in the same way. Every real step is so used many times, which saves real steps and costs time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.agents.tabular import Move, TableState, Tabular
from qfolio.fields import require, static
from qfolio.mdp import Metrics, Task, Transition


class Counts(eqx.Module):
    """The model: of each entry (state · actions + action), the outcomes that were seen.

    An outcome is the next state's number, or the number of states where the task ended.
    """

    outcomes: Int[Array, "entry outcome"]  # −1: none yet
    counts: Float[Array, "entry outcome"]
    rewards: Float[Array, "entry outcome"]  # summed
    seen: Int[Array, " entry"]  # the entries in the order of their first visit
    entries: Int[Array, ""]  # how many were seen

    @classmethod
    def empty(cls, entries: int, outcomes: int) -> "Counts":
        zeros = jnp.zeros((entries, outcomes))
        none = jnp.full(zeros.shape, -1, jnp.int32)
        return cls(none, zeros, zeros, jnp.zeros(entries, jnp.int32), jnp.array(0, jnp.int32))

    def add(self, entry: Int[Array, ""], outcome: Int[Array, ""], reward: Array) -> "Counts":
        """With one more step; where there is no room, its outcome replaces the rarest."""
        counts = self.counts[entry]
        same = self.outcomes[entry] == outcome
        slot = jnp.where(same.any(), same.argmax(), counts.argmin())
        place, kept = (entry, slot), same[slot]
        first = counts.sum() == 0
        return Counts(
            outcomes=self.outcomes.at[place].set(outcome),
            counts=self.counts.at[place].set(kept * counts[slot] + 1.0),
            rewards=self.rewards.at[place].set(kept * self.rewards[place] + reward),
            seen=self.seen.at[self.entries].set(entry),  # overwritten, if it is not the first
            entries=self.entries + first.astype(jnp.int32),
        )

    def imagine(self, n: int, shape: tuple[int, int], key: PRNGKeyArray) -> Move:
        """``n`` steps from entries that were seen; ``shape`` is (state, action)."""
        states, actions = shape
        entry_key, outcome_key = jax.random.split(key)
        entry = self.seen[jax.random.randint(entry_key, (n,), 0, self.entries)]
        total = jnp.cumsum(self.counts[entry], axis=1)
        drawn = jax.random.uniform(outcome_key, (n, 1)) * total[:, -1:]
        place = (entry, (total > drawn).argmax(1))
        outcome = self.outcomes[place]
        return Move(
            state=entry // actions,
            action=entry % actions,
            reward=self.rewards[place] / self.counts[place],
            next_state=jnp.minimum(outcome, states - 1),
            terminated=outcome == states,
            truncated=jnp.zeros(n, bool),
        )


class DynaState(TableState):
    """What Dyna-Q remembers beside its table."""

    model: Counts


class DynaQ(Tabular):
    """Q-learning from real steps and imagined ones."""

    planning: int = static(10)  # imagined steps after each step of all environments
    outcomes: int = static(8)  # next states that the model holds of each state and action

    def __check_init__(self) -> None:
        require(self, "planning", lambda x: 1 <= x <= 4096, "from 1 to 4096; without, q-learning")
        require(self, "outcomes", lambda x: 1 <= x <= 4096, "from 1 to 4096")

    def init(self, task: Task, key: PRNGKeyArray) -> DynaState:
        state = super().init(task, key)
        outcomes = min(self.outcomes, state.tables.shape[1] + 1)  # every state, and the end
        model = Counts.empty(state.tables.size, outcomes)
        return DynaState(state.cells, state.episodes, model)

    def learn(
        self, task: Task, state: DynaState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[DynaState, Metrics]:
        _, *shape = state.tables.shape
        move = Move.of(rollout)
        state = self._update(state, move)
        entry = move.state * shape[1] + move.action
        outcome = jnp.where(move.terminated, shape[0], move.next_state)
        model = state.model
        if self.environments == 1:
            model = model.add(entry[0], outcome[0], move.reward[0])
        else:
            add = lambda model, step: (model.add(*step), None)  # noqa: E731
            model, _ = lax.scan(add, model, (entry, outcome, move.reward))
        state = eqx.tree_at(lambda s: s.model, state, model)
        state = self._update(state, model.imagine(self.planning, (shape[0], shape[1]), key))
        return self.observe(state, rollout), {}

    def _update(self, state: DynaState, move: Move) -> DynaState:
        return self.update(state, move, state.tables[0, move.next_state].max(-1))
