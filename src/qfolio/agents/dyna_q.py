"""Dyna-Q (Sutton 1990): Q-learning from real steps and from steps of a learned model.

Q-learning learns from each real step, and the model counts it: how often action a in state s led to
s', and with what mean reward. Then ``planning_steps`` imagined steps follow, which are learned from
in the same way: a state and action seen before, drawn uniformly, with an outcome drawn in
proportion to its count. This uses each real step many times, at the price of computing time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.agents.tabular import Move, TableState, Tabular
from qfolio.core.errors import QfolioError
from qfolio.core.fields import require, static
from qfolio.core.mdp import Task


class Counts(eqx.Module):
    """The model: the outcomes seen of each entry, numbered state · actions + action.

    An outcome is the next state's number, or the number of states if the task ended.
    """

    # Outcome (−1: none), how often it was seen, and its rewards summed; one array, because XLA
    # would copy three at every step.
    table: Float[Array, "entry outcome 3"]
    seen: Int[Array, " entry"]  # the entries in the order of their first visit
    entries: Int[Array, ""]  # how many were seen

    @classmethod
    def empty(cls, entries: int, outcomes: int) -> "Counts":
        """A model of ``entries`` entries with room for ``outcomes`` outcomes each."""
        table = jnp.zeros((entries, outcomes, 3)).at[..., 0].set(-1.0)
        return cls(table, jnp.zeros(entries, jnp.int32), jnp.array(0, jnp.int32))

    def add(
        self,
        entry: Int[Array, " batch"],
        outcome: Int[Array, " batch"],
        reward: Float[Array, " batch"],
    ) -> "Counts":
        """Adds a step of each entry; of several steps of one entry, only the last is counted.

        If there is no room for an outcome, it replaces the rarest.
        """
        if len(entry) == 1:  # XLA scatters two in place, but not one
            entry, outcome, reward = (jnp.tile(x, 2) for x in (entry, outcome, reward))
        rows = self.table[entry]
        outcomes, counts, rewards = (rows[..., i] for i in range(3))
        same = outcomes == outcome[:, None]
        slot = jnp.where(same.any(1), same.argmax(1), counts.argmin(1))
        now = [
            jnp.broadcast_to(outcome[:, None], same.shape),
            same * counts + 1.0,
            same * rewards + reward[:, None],
        ]
        here = jnp.arange(same.shape[1]) == slot[:, None]
        rows = jnp.where(here[..., None], jnp.stack(now, -1), rows)
        last = ~jnp.triu(entry[:, None] == entry, 1).any(1)
        fresh = last & (counts.sum(1) == 0)
        nowhere = len(self.seen)
        place = jnp.where(fresh, self.entries + fresh.cumsum() - 1, nowhere)
        return Counts(
            table=self.table.at[jnp.where(last, entry, nowhere)].set(rows),
            seen=self.seen.at[place].set(entry),
            entries=self.entries + fresh.sum(dtype=jnp.int32),
        )

    def imagine(self, n: int, shape: tuple[int, int], key: PRNGKeyArray) -> Move:
        """``n`` steps from entries that were seen; ``shape`` is (state, action)."""
        states, actions = shape
        entry_key, outcome_key = jax.random.split(key)
        entry = self.seen[jax.random.randint(entry_key, (n,), 0, self.entries)]
        rows = self.table[entry]
        total = jnp.cumsum(rows[..., 1], axis=1)
        drawn = jax.random.uniform(outcome_key, (n, 1)) * total[:, -1:]
        slot = (total > drawn).argmax(1)
        outcome, count, reward = jnp.take_along_axis(rows, slot[:, None, None], 1)[:, 0].T
        next_state = outcome.astype(jnp.int32)
        return Move(
            state=entry // actions,
            action=entry % actions,
            reward=reward / count,
            next_state=jnp.minimum(next_state, states - 1),
            terminated=next_state == states,
            truncated=jnp.zeros(n, bool),
        )


class DynaState(TableState):
    """A table and the model."""

    model: Counts


class DynaQ(Tabular):
    """Q-learning from real steps and imagined ones."""

    planning_steps: int = static(10)  # imagined steps after each step of all environments
    outcomes: int = static(8)  # next states that the model keeps for each state and action

    def __check_init__(self) -> None:
        require(
            self,
            "planning_steps",
            lambda x: 1 <= x <= 4096,
            "from 1 to 4096; without planning, use q-learning",
        )
        require(self, "outcomes", lambda x: 1 <= x <= 4096, "from 1 to 4096")

    def init(self, task: Task, key: PRNGKeyArray) -> DynaState:
        state = super().init(task, key)
        _, states, actions = state.tables.shape
        if states >= 2**24:
            raise QfolioError(f"dyna-q needs fewer than 2²⁴ states; this task has {states}.")
        outcomes = min(self.outcomes, states + 1)  # every state, and the end
        model = Counts.empty(states * actions, outcomes)
        return DynaState(state.cells, state.episodes, model)

    def improve(self, state: DynaState, move: Move, key: PRNGKeyArray) -> DynaState:
        _, *shape = state.tables.shape
        state = self._update(state, move)
        entry = move.state * shape[1] + move.action
        outcome = jnp.where(move.terminated, shape[0], move.next_state)
        model = state.model.add(entry, outcome, move.reward)
        state = eqx.tree_at(lambda s: s.model, state, model)
        return self._update(state, model.imagine(self.planning_steps, (shape[0], shape[1]), key))

    def _update(self, state: DynaState, move: Move) -> DynaState:
        return self.update(state, move, state.tables[0, move.next_state].max(-1))
