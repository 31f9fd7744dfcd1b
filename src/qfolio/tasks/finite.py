"""Finite Markov decision processes: from your own arrays, and three well-known ones.

>>> task = qfolio.FiniteMDP(transitions, rewards, terminal=[3])
>>> task.optimum().action_values(0.99)
>>> qfolio.train(task, QLearning(), episodes=1000, seeds=8).grade()

States and actions are integers from 0, and the observation is the state's number: tabular agents
look it up, networks see it one-hot encoded.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from numpy.typing import ArrayLike

from qfolio.core.errors import QfolioError
from qfolio.core.fields import require, static
from qfolio.core.mdp import Discrete, Step, Task
from qfolio.solvers.finite import FiniteOptimum, Model


class FiniteMDP(Task):
    """A process given by its tables.

    Args:
        transitions: Probabilities, (state, action, next state); with ``successors``,
            (state, action, outcome).
        rewards: Rewards of each action, (state, action), or of each of its outcomes, in the shape
            of ``transitions``.
        start: The probability of starting in each state (default: uniform over states that are not
            terminal).
        terminal: The states that end an episode: state numbers, or true and false for each state.
            The tables' entries for these states are ignored.
        horizon: Steps after which an episode is truncated (default: 100).
        successors: The next state of each outcome, (state, action, outcome), for processes in
            which only few of many states can follow.

    Raises:
        QfolioError: An array has the wrong shape, or is not a distribution.
    """

    transitions: Float[np.ndarray, "state action outcome"]
    rewards: Float[np.ndarray, "state action outcome"]
    start: Float[np.ndarray, " state"]
    terminal: Bool[np.ndarray, " state"]
    successors: Int[np.ndarray, "state action outcome"]
    horizon: int = static(100)  # steps of an episode

    def __init__(
        self,
        transitions: ArrayLike,
        rewards: ArrayLike,
        start: ArrayLike | None = None,
        terminal: ArrayLike = (),
        horizon: int = 100,
        successors: ArrayLike | None = None,
    ) -> None:
        moves = _numbers("transitions", transitions)
        if moves.ndim != 3 or 0 in moves.shape:
            raise QfolioError(
                f"transitions has the shape {moves.shape}; it must be (state, action, next state)."
            )
        states = len(moves)
        pay = _numbers("rewards", rewards)
        if pay.shape == moves.shape[:2]:
            pay = np.broadcast_to(pay[:, :, None], moves.shape)
        if pay.shape != moves.shape:
            raise QfolioError(
                f"rewards has the shape {pay.shape}; it must be {moves.shape[:2]} or {moves.shape}."
            )
        if successors is None:
            if moves.shape[2] != states:
                raise QfolioError(
                    f"transitions has {states} states and {moves.shape[2]} next states; they must "
                    "be equal, unless successors is given."
                )
            moves, pay, after = _outcomes(moves, pay)
        else:
            after = np.asarray(successors)
            whole = after.dtype.kind in "iu" and after.shape == moves.shape
            if not whole or after.min() < 0 or after.max() >= states:
                raise QfolioError(
                    f"successors must hold whole numbers from 0 to {states - 1} in the shape of "
                    f"transitions, {moves.shape}."
                )
        self.terminal = _mask(terminal, states)
        _require_distribution("transitions", moves[~self.terminal], np.flatnonzero(~self.terminal))
        ended = self.terminal[:, None, None]
        first = np.arange(moves.shape[2]) == 0
        self.transitions = np.where(ended, first, moves)
        self.rewards = np.where(ended, 0.0, pay)
        here = np.arange(states)[:, None, None]
        self.successors = np.where(ended, here, after).astype(np.int32)
        begin = (~self.terminal).astype(float) if start is None else _numbers("start", start)
        if begin.shape != (states,):
            raise QfolioError(
                f"start has the shape {begin.shape}; it must be a probability for each of the "
                f"{states} states."
            )
        if start is not None:
            _require_distribution("start", begin[None], None)
        if begin[self.terminal].any() or not begin.any():
            raise QfolioError("An episode cannot start in a terminal state.")
        self.start = begin / begin.sum()
        self.horizon = horizon

    def __check_init__(self) -> None:
        require(self, "horizon", lambda x: 1 <= x <= 1_000_000, "from 1 to 1,000,000")

    @property
    def states(self) -> int:
        return self.transitions.shape[0]

    @property
    def actions(self) -> Discrete:
        """The actions, the same number in every state."""
        return Discrete(self.transitions.shape[1])

    def reset(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return _draw(key, jnp.asarray(self.start))

    def observe(self, state: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
        return state

    def step(self, state: Int[Array, ""], action: Array, key: PRNGKeyArray) -> Step:
        outcome = _draw(key, jnp.asarray(self.transitions)[state, action])
        after = jnp.asarray(self.successors)[state, action, outcome]
        reward = jnp.asarray(self.rewards, jnp.float32)[state, action, outcome]
        return Step(after, reward, jnp.asarray(self.terminal)[after])

    def optimum(self) -> FiniteOptimum:
        model = Model(self.transitions, self.rewards, self.successors, self.terminal)
        return FiniteOptimum(self, model)


class Cliff(FiniteMDP):
    """Cliff walking (Sutton & Barto 2018, example 6.6): Gymnasium's ``CliffWalking``.

    From the lower left of 4 × 12 cells to the lower right; each step pays −1, and a step into the
    cliff between them pays −100 and leads back to the start. Actions: up, right, down, left; if
    ``slippery``, the step goes that way or to either side, with probability 1/3 each.
    """

    slippery: bool = static(False)  # steps may go to a side
    horizon: int = static(200)  # steps of an episode

    def __init__(self, slippery: bool = False, horizon: int = 200) -> None:
        self.slippery = slippery
        rows, columns = 4, 12
        row, column = np.divmod(np.arange(rows * columns), columns)
        up, right, down, left = (
            ((row + i).clip(0, rows - 1)) * columns + (column + j).clip(0, columns - 1)
            for i, j in ((-1, 0), (0, 1), (1, 0), (0, -1))
        )
        begin, goal = (rows - 1) * columns, rows * columns - 1
        towards = _slip(np.stack([up, right, down, left], 1), slippery)
        falls = (towards > begin) & (towards < goal)
        super().__init__(
            np.full(towards.shape, 1 / towards.shape[2]),
            np.where(falls, -100.0, -1.0),
            start=np.arange(rows * columns) == begin,
            terminal=[goal],
            horizon=horizon,
            successors=np.where(falls, begin, towards),
        )


_LAKES = {
    4: "SFFF FHFH FFFH HFFG",
    8: "SFFFFFFF FFFFFFFF FFFHFFFF FFFFFHFF FFFHFFFF FHHFFFHF FHFFHFHF FFFHFFFG",
}
"""Gymnasium's maps: start, frozen, hole, goal."""


class FrozenLake(FiniteMDP):
    """Gymnasium's ``FrozenLake``: over the ice to the goal, which pays 1; holes end the episode.

    ``size`` 4 or 8. Actions: left, down, right, up; if ``slippery``, the step goes that way or to
    either side, with probability 1/3 each. ``horizon`` 0 stands for Gymnasium's, 100 or 200 steps.
    """

    size: int = static(4)  # cells of a side: 4 or 8
    slippery: bool = static(True)  # steps may go to a side
    horizon: int = static(0)  # steps of an episode; 0: Gymnasium's

    def __init__(self, size: int = 4, slippery: bool = True, horizon: int = 0) -> None:
        self.size, self.slippery = size, slippery
        require(self, "size", lambda x: x in _LAKES, "4 or 8")
        cells = np.array(list(_LAKES[size].replace(" ", "")))
        row, column = np.divmod(np.arange(size * size), size)
        ways = [
            (row + i).clip(0, size - 1) * size + (column + j).clip(0, size - 1)
            for i, j in ((0, -1), (1, 0), (0, 1), (-1, 0))
        ]
        towards = _slip(np.stack(ways, 1), slippery)
        super().__init__(
            np.full(towards.shape, 1 / towards.shape[2]),
            np.where(cells[towards] == "G", 1.0, 0.0),
            start=cells == "S",
            terminal=np.isin(cells, ("H", "G")),
            horizon=horizon or (100 if size == 4 else 200),
            successors=towards,
        )


class Garnet(FiniteMDP):
    """A random process (Garnet; Archibald, McKinnon & Thomas 1995), fixed by its seed.

    Each action leads to ``branching`` different states, with probabilities from cutting the unit
    interval at random points, and has a standard normal reward. It never ends.
    """

    n_states: int = static(50)  # number of states
    n_actions: int = static(4)  # actions in each state
    branching: int = static(3)  # states that an action may lead to
    seed: int = static(0)  # seed of the process itself
    horizon: int = static(100)  # steps of an episode

    def __init__(
        self,
        n_states: int = 50,
        n_actions: int = 4,
        branching: int = 3,
        seed: int = 0,
        horizon: int = 100,
    ) -> None:
        self.n_states, self.n_actions, self.branching = n_states, n_actions, branching
        self.seed = seed
        require(self, "n_states", lambda x: 1 <= x <= 100_000, "from 1 to 100,000")
        require(self, "n_actions", lambda x: 1 <= x <= 1000, "from 1 to 1000")
        require(self, "branching", lambda x: 1 <= x <= n_states, f"from 1 to n_states ({n_states})")
        require(self, "seed", lambda x: x >= 0, "at least 0")
        draw = np.random.default_rng(seed)
        shape = (n_states, n_actions)
        cuts = np.sort(draw.random((*shape, branching - 1)))
        after = [draw.choice(n_states, branching, replace=False) for _ in np.ndindex(shape)]
        super().__init__(
            np.diff(cuts, prepend=0.0, append=1.0),
            draw.standard_normal(shape),
            horizon=horizon,
            successors=np.reshape(after, (*shape, branching)),
        )


def _slip(
    towards: Int[np.ndarray, "state action"], slippery: bool
) -> Int[np.ndarray, "state action outcome"]:
    """Where an action may lead: its direction, or also to either side of it."""
    sides = (1, 0, -1) if slippery else (0,)
    return np.stack([np.roll(towards, side, axis=1) for side in sides], axis=2)


def _draw(key: PRNGKeyArray, weights: Float[Array, " n"]) -> Int[Array, ""]:
    """A random index, in proportion to its weight."""
    total = jnp.cumsum(weights.astype(jnp.float32))
    # Strictly above, so that an index of weight 0 is never drawn.
    return (total > jax.random.uniform(key) * total[-1]).argmax().astype(jnp.int32)


def _numbers(name: str, array: ArrayLike) -> Float[np.ndarray, "..."]:
    try:
        numbers = np.asarray(array, dtype=float)
    except (TypeError, ValueError):
        raise QfolioError(f"{name} must be an array of numbers.") from None
    if not np.isfinite(numbers).all():
        raise QfolioError(f"{name} holds a number that is not finite.")
    return numbers


def _mask(terminal: ArrayLike, states: int) -> Bool[np.ndarray, " state"]:
    """True for each terminal state."""
    given = np.asarray(terminal)
    if given.dtype == bool and given.shape == (states,):
        return given
    if given.size == 0:
        return np.zeros(states, bool)
    if given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= states:
        raise QfolioError(
            f"terminal must hold state numbers from 0 to {states - 1}, or true or false for each "
            "state."
        )
    return np.isin(np.arange(states), given)


def _require_distribution(
    name: str, rows: Float[np.ndarray, "... outcome"], states: Sequence[int] | np.ndarray | None
) -> None:
    """Raises QfolioError for the first row that is not a distribution."""
    bad = (rows < 0).any(-1) | (abs(rows.sum(-1) - 1) > 1e-6)
    if not bad.any():
        return
    place = np.unravel_index(int(bad.argmax()), bad.shape)
    of = "" if states is None else f" of state {states[int(place[0])]} and action {place[1]}"
    total = rows[place].sum()
    wrong = "one is negative" if (rows[place] < 0).any() else f"they sum to {total:.6g}"
    raise QfolioError(f"{name}{of} must be probabilities that sum to 1; {wrong}.")


def _outcomes(
    moves: Float[np.ndarray, "state action next"], pay: Float[np.ndarray, "state action next"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The possible outcomes, from a table over all next states."""
    count = max(1, int((moves != 0).sum(-1).max()))
    after = np.argsort(moves == 0, axis=-1, kind="stable")[..., :count]
    return np.take_along_axis(moves, after, -1), np.take_along_axis(pay, after, -1), after
