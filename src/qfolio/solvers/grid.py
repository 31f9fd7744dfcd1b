"""Exact solutions by dynamic programming on a grid (Bellman 1957), for deterministic tasks in 2-D.

Backward induction gives the optimal value with k steps to go at each grid point, with bilinear
interpolation between them. The optimal policy looks one exact step ahead and takes the action with
the best interpolated value, so that its return is one that was really attained.
"""

import contextlib
import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Key, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.files import cache_directory, read_arrays, write_arrays
from qfolio.core.mdp import Discrete, Step, Task

OPTIMIZED: dict[str, int | str | bool] = {"xla_backend_optimization_level": 3}
"""Options of the compiler, whatever its flags say: solving takes long without optimization."""


class GridOptimum:
    """The optimum of a deterministic task whose state is a pair of coordinates.

    axes: the grid points of both coordinates, equally spaced; a periodic axis omits its end.
    state: builds a task state from two coordinates. Solutions are cached on disk.
    """

    def __init__(
        self,
        task: Task,
        state: Callable[[Array, Array], PyTree],
        axes: tuple[Array, Array],
        periodic: tuple[bool, bool],
    ) -> None:
        self.task, self.state, self.axes, self.periodic = task, state, axes, periodic

    def returns(self, keys: Key[Array, " start"]) -> np.ndarray:
        """Undiscounted returns over the task's horizon of the optimal policy, one for each key."""
        starts = jax.vmap(self.task.reset)(keys)
        solve = jax.jit(
            lambda: self._follow(self._solve(), starts),
            compiler_options=OPTIMIZED,
        )
        name = np.asarray(jax.random.key_data(keys)).tobytes()
        return self._cached(name, lambda: {"returns": solve()})["returns"]

    def stationary(self, discount: float) -> tuple[np.ndarray, np.ndarray]:
        """Value and best action, each (n, m), for the infinite-horizon discounted problem.

        Values are off by at most γ/(1 − γ) times 1e-4: 0.01 with a discount of 0.99.
        """

        def solve() -> dict[str, Array]:
            # Backward induction until the values converge, at most to float32's precision.
            def improve(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
                values, _, k = carry
                better = self._action_values(values, discount).max(0)
                return better, jnp.abs(better - values).max(), k + 1

            n, m = self._shape
            start = (jnp.zeros((n, m)), jnp.array(jnp.inf), jnp.array(0))
            values, _, _ = lax.while_loop(lambda c: (c[1] > 1e-4) & (c[2] < 5000), improve, start)
            actions = self._action_values(values, discount).argmax(0)
            return {"value": values, "action": actions.astype(jnp.int32)}

        compiled = jax.jit(solve, compiler_options=OPTIMIZED)
        solution = self._cached(f"stationary {discount}".encode(), compiled)
        return solution["value"], solution["action"]

    @property
    def _shape(self) -> tuple[int, int]:
        return len(self.axes[0]), len(self.axes[1])

    @property
    def _actions(self) -> Int[Array, " action"]:
        assert isinstance(self.task.actions, Discrete)
        return jnp.arange(self.task.actions.n)

    def _look_ahead(self, values: Array, states: PyTree, action: Array, discount: float) -> Array:
        """r + γ V(s') for one action in each of the states (k, …)."""
        after = self._step(states, jnp.broadcast_to(action, jax.tree.leaves(states)[0].shape))
        return after.reward + discount * self._interpolate(values, *after.state)

    def _step(self, states: PyTree, actions: Int[Array, " k"]) -> Step:
        unused = jax.random.key(0)  # the task is deterministic
        return jax.vmap(self.task.step, (0, 0, None))(states, actions, unused)

    def _action_values(self, values: Array, discount: float) -> Float[Array, "action n m"]:
        points = self.state(*(x.ravel() for x in jnp.meshgrid(*self.axes, indexing="ij")))
        look = lambda action: self._look_ahead(values, points, action, discount)  # noqa: E731
        return lax.map(look, self._actions).reshape(-1, *self._shape)

    def _solve(self) -> Float[Array, "steps n m"]:
        """Undiscounted values with 0, 1, … steps to go, one fewer than the task's horizon."""

        def back(values: Array, _: None) -> tuple[Array, Array]:
            return self._action_values(values, 1.0).max(0), values

        return lax.scan(back, jnp.zeros(self._shape), None, length=self.task.horizon)[1]

    def _follow(self, values: Float[Array, "steps n m"], starts: PyTree) -> Float[Array, " start"]:
        """Returns of the policy that is greedy one exact step ahead of ``values``."""

        def step(states: PyTree, to_go: Array) -> tuple[PyTree, Array]:
            q = jax.vmap(lambda a: self._look_ahead(to_go, states, a, 1.0))(self._actions)
            after = self._step(states, q.argmax(0))
            return after.state, after.reward

        return lax.scan(step, starts, values, reverse=True)[1].sum(0)

    def _interpolate(self, values: Array, x: Array, y: Array) -> Array:
        """Bilinear interpolation of ``values`` at coordinates (x, y)."""
        (i, i_next, u), (j, j_next, v) = (
            cell(axis, periodic, at)
            for axis, periodic, at in zip(self.axes, self.periodic, (x, y), strict=True)
        )
        low = (1 - u) * values[i, j] + u * values[i_next, j]
        high = (1 - u) * values[i, j_next] + u * values[i_next, j_next]
        return (1 - v) * low + v * high

    def _cached(
        self, name: bytes, compute: Callable[[], dict[str, Array]]
    ) -> dict[str, np.ndarray]:
        parts = [name, repr(self.task).encode(), repr((self._shape, self.periodic)).encode()]
        arrays = (*self.axes, *jax.tree.leaves(self.task))  # a task's text shows their shapes only
        parts += [np.asarray(array).tobytes() for array in arrays]
        kinds = [kind for kind in type(self.task).__mro__ if issubclass(kind, Task)]
        try:
            sources = [*map(inspect.getsourcefile, kinds), __file__]
        except (OSError, TypeError):  # a class of a notebook: nothing tells whether it has changed
            return {key: np.asarray(array) for key, array in compute().items()}
        parts += [Path(source).read_bytes() for source in sources if source]
        path = cache_directory() / "optimum" / hashlib.sha256(b"|".join(parts)).hexdigest()
        try:
            return read_arrays(path)
        except QfolioError:  # not solved yet, or damaged
            solution = {key: np.asarray(array) for key, array in compute().items()}
            with contextlib.suppress(OSError):  # an unwritable cache only costs time
                write_arrays(path, solution)
            return solution


def cell(axis: Array, periodic: bool, at: Array) -> tuple[Array, Array, Array]:
    """The two grid indices around a coordinate and how far it lies between them, in [0, 1]."""
    n = len(axis)
    position = (at - axis[0]) / (axis[1] - axis[0])
    if periodic:
        index = jnp.floor(position).astype(jnp.int32)
        return index % n, (index + 1) % n, position - index
    index = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, n - 2)
    return index, index + 1, jnp.clip(position - index, 0.0, 1.0)
