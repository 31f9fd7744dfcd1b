"""Members trained side by side in one compiled program, each one seed of one agent on one task."""

from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from threading import Lock
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from qfolio.core import faults
from qfolio.core.devices import Members, keyed, require_memory
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import CURVE_STARTS, STARTS, Greedy, evaluate, tail_steps
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import name_of
from qfolio.core.training import Episodes, TrainingState, advance, begin, chunk_steps, episode_steps

LARGE = 1000
"""Least size of an array that members share. Each member has its own copy of smaller arrays even if
they are equal, so that the program also serves members whose arrays differ."""


class Population:
    """Members trained side by side, and the programs that do it.

    tasks, agents: one for all members, or one for each, differing in numbers and arrays only.
    seeds: one for each member.
    room: size of the largest population that shares these programs (default: this one's).
    starts, curve_starts: how many starts a final evaluation and the learning curve use.

    Raises QfolioError if the agents' settings need different programs, or memory is too small.
    """

    starts, curve_starts = STARTS, CURVE_STARTS

    def __init__(
        self,
        tasks: Task | Sequence[Task],
        agents: Agent | Sequence[Agent],
        seeds: Sequence[int],
        room: int = 0,
    ) -> None:
        self.seeds, self._room = list(seeds), room
        tasks = [tasks] * len(self.seeds) if isinstance(tasks, Task) else list(tasks)
        agents = [agents] * len(self.seeds) if isinstance(agents, Agent) else list(agents)
        agents = [agent.fitted(task) for task, agent in zip(tasks, agents, strict=True)]
        if len({jax.tree.structure(agent) for agent in agents}) > 1:
            raise QfolioError(
                "members of one population must share all settings that shape the program; train "
                "agents that differ in them in separate populations."
            )
        # Only properties that all members share are read from the first.
        self.task, self.agent = tasks[0], agents[0]
        self._tail = max(tail_steps(agent.discount) for agent in agents)
        self.seconds_compile = 0.0
        own, shared, self._join, form = _split(list(zip(tasks, agents, strict=True)))
        self._begin(own, shared, (form, self.task.referents))

    def _require_memory(self) -> None:
        """Raises QfolioError if memory is too small for a form that has not been run before."""
        if not self._programs:
            first = jax.eval_shape(lambda: self.agent.init(self.task, jax.random.key(0)))
            require_memory(first, self._held)

    @property
    def _held(self) -> int:
        """How many members' states are in memory."""
        return self._members.slots

    def _begin(self, own: list[np.ndarray], shared: list[Any], form: Hashable) -> None:
        """Sets up the members before their first step; ``own`` and ``shared`` are from ``_split``.

        form: everything about tasks and agents that a compiled program depends on.
        """
        self._members = Members(len(self.seeds), self._room)
        self._own, self._shared = self._members.place(own), self._members.share(shared)
        # The key holds everything that a compiled program depends on.
        rows = chunk_steps(self.task, self.agent)
        self._programs = programs_of((form, self._members.form, rows))
        self._require_memory()
        seeds = self._members.place(np.array(self.seeds, np.uint32))
        self._states: list[TrainingState] = self._run("begin", begin, seeds, once=True)

    @property
    def steps(self) -> int:
        """Steps of each environment so far; after an exception, of the member with the fewest."""
        return int(self._fetch(lambda state: state.steps).min())

    @property
    def member_episodes(self) -> list[int]:
        """Finished episodes of each member."""
        return self._fetch(lambda state: state.episodes).tolist()

    @property
    def episodes(self) -> int:
        """Finished episodes of the member that has finished fewest."""
        return min(self.member_episodes)

    @property
    def healthy(self) -> list[bool]:
        """Whether the losses and weights of each member have been finite so far."""
        return self._fetch(lambda state: state.healthy).tolist()

    @property
    def env_steps(self) -> int:
        """Steps of each member so far, over all its environments."""
        return self.steps * self.agent.num_envs

    def steps_left(self, episodes: int | None = None, *, steps: int | None = None) -> int:
        """Steps of each environment until every member has used its budget; 0 if all have.

        episodes: budget per member; the result assumes that no episode ends early. steps: budget
        per member, over all its environments.
        """
        if steps is not None:
            return max(0, -(-steps // self.agent.num_envs) - self.steps)
        missing = (episodes or 0) - self.episodes
        if missing <= 0:
            return 0
        rounds = -(-missing // self.agent.num_envs)
        under_way = int(self._fetch(lambda state: state.tally.steps).max())
        return max(1, rounds * episode_steps(self.task, self.agent) - under_way)

    def advance(self, steps: int, *, strict: bool = True) -> Episodes:
        """Advances at most one chunk; returns records as numpy arrays (member, time, environment).

        steps: of each environment, rounded up to whole rollouts. strict: raises QfolioError if a
        loss is not finite; its states are of no use then. Without it, the other members continue,
        and ``healthy`` shows which failed.
        """
        episodes = self._advance(*self._plan(steps, chunk_steps(self.task, self.agent)))
        if strict:
            self._require_healthy()
        return self._members.fetch(episodes)

    def _advance(self, steps: int, learning: bool) -> list[Episodes]:
        """Takes some steps; returns their records, still at the places."""

        def program(
            task: Task, agent: Agent, state: TrainingState, steps: Array
        ) -> tuple[TrainingState, Episodes]:
            return advance(task, agent, state, steps, learning=learning)

        name = "learn" if learning else "collect"
        done = self._run(name, program, self._states, np.int32(steps), donate=True)
        self._states = [state for state, _ in done]
        return [episodes for _, episodes in done]

    @property
    def learning(self) -> bool:
        """Whether the next steps learn; the warm-up only stores experience."""
        return self._plan(1, 1)[1]

    def _plan(self, steps: int, most: int) -> tuple[int, bool]:
        """How many steps to take now, in whole rollouts, and whether they learn."""
        warm_up = self.agent.whole_rollouts(self.agent.warm_up()) - self.steps
        steps = min(steps, most, warm_up if warm_up > 0 else most)
        return self.agent.whole_rollouts(steps), warm_up <= 0

    def _require_healthy(self) -> None:
        healthy = self.healthy
        if not all(healthy):
            first = healthy.index(False)
            if fault := self.task_fault(first):
                raise QfolioError(f"With seed {self.seeds[first]}, {fault[0].lower()}{fault[1:]}")
            bad = {str(s): None for s, ok in zip(self.seeds, healthy, strict=True) if not ok}
            raise QfolioError(
                f"The loss of seed {', '.join(bad)} is no longer finite after {self.steps} steps; "
                "lower learning_rate, or bound the gradient (huber_delta or max_grad_norm, "
                "whichever the agent has)."
            )

    def task_fault(self, member: int = 0) -> str | None:
        """What is wrong with a member's task, if the fault is not in the learning."""
        task, agent = self._member(member)
        return faults.find(task, agent, self.seeds[member], self.steps)

    def policy(self, member: int = 0) -> Callable[[PyTree], PyTree]:
        """A member's greedy policy as it is now: a function of one observation to its action.

        It raises QfolioError for an observation of another shape.
        """
        weights = jax.tree.map(lambda x: x[member], self.weights())
        task, agent = self._member(member)
        act = jax.jit(lambda weights, seen: agent.policy(weights, seen))
        known = jax.eval_shape(lambda: task.observe(task.reset(jax.random.key(0))))
        shape = jax.tree.map(np.shape, known)

        def policy(observation: PyTree) -> PyTree:
            if (given := jax.tree.map(np.shape, observation)) != shape:
                raise QfolioError(
                    f"The observation has the shape {given}; that of {name_of(task)} is {shape}."
                )
            seen = jax.tree.map(lambda x: np.asarray(x)[None], observation)
            return jax.tree.map(lambda x: np.asarray(x)[0], act(weights, seen))

        return policy

    def _member(self, member: int) -> tuple[Task, Agent]:
        """A member's task and agent."""
        own = jax.tree.map(lambda leaf: jnp.asarray(leaf[member]), self._members.fetch(self._own))
        found: tuple[Task, Agent] = self._join(own, self._shared[0])
        return found

    def evaluate(self, keys: Key[Array, " start"], tail: int | None = None) -> Greedy:
        """Greedy returns (member, start) and overestimation (member,) of the current policies.

        tail: steps beyond the horizon for the overestimation (default: ``tail_steps`` of the
        largest discount).
        """
        tail = self._tail if tail is None else tail

        def program(task: Task, agent: Agent, weights: PyTree, keys: Array) -> Greedy:
            return evaluate(task, agent, weights, keys, tail)

        weights = [self.agent.weights(state.agent) for state in self._states]
        greedy = self._run(f"evaluate {len(keys)} {tail}", program, weights, keys)
        return self._members.fetch(greedy)

    def weights(self) -> PyTree:
        """The members' learned weights as numpy arrays."""
        return self._fetch(lambda state: self.agent.weights(state.agent))

    def fetch(self) -> TrainingState:
        """The members' states as numpy arrays, with a leading member axis."""
        return self._fetch(lambda state: state)

    def restore(self, state: TrainingState) -> None:
        """Restores the states that ``fetch`` returned."""
        self._states = list(map(keyed, self._members.place(state), self._states))

    def _fetch(self, where: Callable[[TrainingState], PyTree]) -> PyTree:
        """Parts of the members' states as numpy arrays, with a leading member axis."""
        return self._members.fetch([where(state) for state in self._states])

    def _run(
        self,
        name: str,
        function: Callable[..., Any],
        members: list[Any],
        *args: Any,
        **how: bool,
    ) -> list[Any]:
        """Runs ``function(task, agent, member, *args)`` for all members, at all places.

        members: a tree for each place. how: to compile it, see ``Members.compile``.
        """
        same = [self._members.share(arg) for arg in args]
        found: list[Any] = self._start(name, function, members, self._own, *same, **how)
        return found

    def _start(
        self,
        name: str,
        function: Callable[..., Any],
        member: Any,
        own: Any,
        *args: Any,
        **how: bool,
    ) -> Any:
        """Calls the program of this name, which is compiled when the name is first used.

        own: the numbers of the member's agent and task.
        """

        def one(member: Any, own: Any, shared: Any, *args: Any) -> Any:
            return function(*self._join(own, shared), member, *args)

        args = (member, own, self._shared, *args)
        if name not in self._programs:
            start = perf_counter()
            with self._programs.compiling:
                if name not in self._programs:
                    self._programs[name] = self._compile(one, *args, **how)
            self.seconds_compile += perf_counter() - start
        return self._call(self._programs[name], *args)

    def _compile(
        self, one: Callable[..., Any], *args: Any, donate: bool = False, once: bool = False
    ) -> Any:
        """Compiles for arguments shaped like these."""
        here = [arg[0] for arg in args]
        return self._members.compile(one, *here, split=2, donate=donate, once=once)

    def _call(self, program: Any, *args: Any) -> Any:
        """Calls what ``_compile`` returned, for this or another population of the same form."""
        return self._members.run(program, *args)


class Rehearsal(Population):
    """Compiles the programs of such a population; its states are only shapes, without memory."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        for learning in (False, True) if self.agent.warm_up() else (True,):
            self._advance(0, learning)

    def _call(self, program: Any, *args: Any) -> Any:
        return [program.shapes]


class Programs(dict[str, Any]):
    """Compiled programs by name; the thread that compiles one holds ``compiling``."""

    def __init__(self) -> None:
        super().__init__()
        self.compiling = Lock()


@lru_cache(maxsize=32)
def programs_of(form: Hashable) -> Programs:
    """The programs that all populations of one form share."""
    return Programs()


def _split(
    members: Sequence[PyTree],
) -> tuple[list[np.ndarray], list[Any], Callable[[Any, Any], PyTree], Hashable]:
    """Splits the members' numbers and arrays into own and shared ones.

    Each member has its own numbers, so that one program serves all members; an array is shared if
    it is large and the same object in all. Returns the own leaves with a leading member axis, the
    shared ones, a function that rebuilds one member, and a key of all that a program depends on.
    """
    columns = list(zip(*(jax.tree.leaves(member) for member in members), strict=True))
    structure = jax.tree.structure(members[0])
    is_own = [
        isinstance(column[0], float)
        or (isinstance(column[0], np.ndarray | Array) and column[0].size < LARGE)
        or any(leaf is not column[0] for leaf in column)
        for column in columns
    ]
    own = [
        np.stack([np.asarray(x, np.float32 if isinstance(x, float) else None) for x in column])
        for column, mine in zip(columns, is_own, strict=True)
        if mine
    ]
    shared = [column[0] for column, mine in zip(columns, is_own, strict=True) if not mine]

    def join(own: list[Array], shared: list[Any]) -> PyTree:
        mine, common = iter(own), iter(shared)
        return jax.tree.unflatten(structure, [next(mine if m else common) for m in is_own])

    shapes = tuple(
        (np.shape(column[0]), getattr(column[0], "dtype", type(column[0]))) for column in columns
    )
    return own, shared, join, (structure, tuple(is_own), shapes)
