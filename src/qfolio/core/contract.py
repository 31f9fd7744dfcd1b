"""What the methods of a task, an agent and a reward must return, checked on shapes before use."""

from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from numbers import Integral
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr
from jaxtyping import PRNGKeyArray, PyTree

from qfolio.core.arrays import numbers
from qfolio.core.errors import QfolioError, require_methods, require_type, require_whole
from qfolio.core.mdp import Actions, Agent, Box, Discrete, ExogenousTask, Step, Task, Transition
from qfolio.core.text import amount, csv_cell

SHOWN = 200
"""Most characters of a message that show what a method returned."""

RESERVED = ("seed", "episode", "env_steps", "return", "greedy return", "overestimation")
"""Names that the records of a training already have."""

NUMBER: Any = jax.ShapeDtypeStruct((), jnp.float32)
TRUTH: Any = jax.ShapeDtypeStruct((), jnp.bool_)


def require_task(task: Task, key: PRNGKeyArray) -> Any:
    """The shapes of a Transition of a task; raises QfolioError unless its methods fit each other.

    Each is traced once; an exception of its own is left as it is.
    """
    require_methods(type(task), Task, ExogenousTask)
    start = _shapes(task, "reset", key)
    seen = _shapes(task, "observe", start)
    _require_observation(task, seen)
    action = _form(task.actions)
    if task.compiled:
        after = _shapes(task, "step", start, action, key)
        if not isinstance(after, Step):
            raise _refused(task, "step", after, "Step(state, reward, terminated)")
        _require_like(task, "step", after.state, start, " as state", "reset")
        if not _is_number(after.reward):
            raise _refused(task, "step", after.reward, _shown(NUMBER), " as reward")
        _require_like(task, "step", after.terminated, TRUTH, " as terminated")
    step = Transition(start, seen, action, NUMBER, start, seen, TRUTH, TRUTH)
    _require_metrics(task, "measure", _shapes(task, "measure", step))
    return step


def require_reward(reward: Any, outcome: PyTree) -> None:
    """Raises QfolioError unless ``reward(state, outcome)`` returns a number and the next state."""
    start = _shapes(reward, "init")
    found = _shapes(reward, "__call__", start, outcome)
    if not (isinstance(found, tuple) and len(found) == 2 and _is_number(found[0])):
        raise _refused(reward, "__call__", found, "a number, and the next state")
    _require_like(reward, "__call__", found[1], start, " as state", "init")


def require_agent(
    task: Task, agent: Agent, state: Any, step: Any, key: PRNGKeyArray
) -> tuple[Any, Any]:
    """The shapes of the metrics that an agent reports of learning, and measures of a step.

    Raises QfolioError unless the agent's methods fit each other and the task. Each is traced once;
    an exception of its own is left as it is.

    state: the agent's, before any experience. step: from ``require_task``.
    """
    kind, steps = type(agent), agent.warm_up()
    require_whole(f"{kind.__name__}.warm_up()", steps, 0, 2**31 - 1)
    if steps and kind.observe is Agent.observe:
        raise QfolioError(
            f"{kind.__name__} warms up for {amount(steps, 'step')}, but stores nothing then; "
            "define observe, or leave warm_up out."
        )
    state = jax.eval_shape(lambda: _arrays(agent, "init", state))
    seen = _repeated(step.observation, agent.num_envs)
    acts = _shapes(agent, "act", state, seen, key)
    step = step._replace(action=_chosen(task, acts))
    batch = _repeated(step, agent.num_envs)
    rollout = _repeated(batch, agent.rollout_steps)
    _require_like(agent, "act", acts, batch.action)
    stored = _shapes(agent, "observe", state, rollout)
    _require_like(agent, "observe", stored, state, like="init")
    _require_like(agent, "cut", _shapes(agent, "cut", state), state, like="init")
    learned = jax.eval_shape(learning_of(task, agent), task, agent, state, rollout, key)
    if not (isinstance(learned, tuple) and len(learned) == 2):
        raise _refused(agent, "learn", learned, "the next state, and a dict of metrics")
    _require_like(agent, "learn", learned[0], state, " as state", "init")
    _require_metrics(agent, "learn", learned[1])
    monitored = _shapes(agent, "monitor", state)
    _require_metrics(agent, "monitor", monitored)
    measured = _shapes(agent, "measure", step, of=(task,))
    _require_metrics(agent, "measure", measured)
    _require_apart(task, agent, learn=learned[1], monitor=monitored, measure=measured)
    weights = _shapes(agent, "weights", state)
    if not jax.tree.leaves(weights):
        raise _refused(agent, "weights", weights, "an array, or several")
    if any(jnp.issubdtype(x.dtype, jax.dtypes.prng_key) for x in jax.tree.leaves(weights)):
        raise _refused(agent, "weights", weights, "arrays of numbers, without random keys")
    starts = _repeated(step, agent.num_envs + 1)  # an evaluation has batches of another size
    chosen = _shapes(agent, "policy", weights, starts.observation)
    _require_like(agent, "policy", chosen, starts.action)
    values = _shapes(agent, "action_values", weights, starts.observation)
    if values is not None and isinstance(task.actions, Discrete):
        each = jax.ShapeDtypeStruct((agent.num_envs + 1, task.actions.n), jnp.float32)
        _require_like(agent, "action_values", values, each)
    return learned[1], measured


def learning_of(task: Task, agent: Agent) -> Callable[..., Any]:
    """``agent.learn`` as a function of task, agent, state, rollout and key.

    Tracing it takes most of the time that a program takes to trace. ``require_agent`` and the
    program that trains share one trace, if the types of the arguments agree.
    """
    return _learning_of(jax.tree.structure((task, agent)), task.referents)


@lru_cache(maxsize=8)
def _learning_of(_structure: Hashable, _referents: Hashable) -> Callable[..., Any]:
    def learn(task: Task, agent: Agent, state: Any, rollout: Any, key: PRNGKeyArray) -> Any:
        return _arrays(agent, "learn", agent.learn(task, state, rollout, key))

    return jax.jit(learn, inline=True)


def _form(actions: Actions) -> Any:
    """Shape and type of an action."""
    if isinstance(actions, Discrete):
        return jax.ShapeDtypeStruct((), jnp.int32)
    length = actions.n if isinstance(actions, Box) else 1 + actions.assets
    return jax.ShapeDtypeStruct((length,), jnp.float32)


def _chosen(task: Task, acts: PyTree) -> Any:
    """The form of an agent's actions: the task's; in a market with debts, cash may come first."""
    form = _form(task.actions)
    if isinstance(task, ExogenousTask) and isinstance(task.actions, Box):
        with_cash = jax.ShapeDtypeStruct((task.actions.n + 1,), form.dtype)
        if getattr(acts, "shape", ())[1:] == with_cash.shape:
            return with_cash
    return form


def _repeated(tree: PyTree, count: int) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), tree)


def _shapes(owner: object, name: str, *args: Any, of: tuple[Task, ...] = ()) -> Any:
    """The shapes of what a method returns; of: its first arguments, if it takes a task."""
    method = getattr(owner, name)
    checked = wraps(method)(lambda *args: _arrays(owner, name, method(*of, *args)))
    return jax.eval_shape(checked, *args)


def _arrays(owner: object, name: str, found: Any) -> Any:
    """What a method returns; raises QfolioError unless it consists of arrays and numbers."""
    for leaf in jax.tree.leaves(found):
        if not eqx.is_array_like(leaf):
            raise QfolioError(
                f"{type(owner).__name__}.{name} returns {type(leaf).__name__}; it must return "
                "arrays, perhaps in tuples, dicts or modules of equinox."
            )
    return found


def _is_number(found: PyTree) -> bool:
    """Whether a result is one real number, of any type."""
    kinds = (jnp.bool_, jnp.integer, jnp.floating)
    alone = jax.tree.leaves(found) == [found] and not found.shape
    return alone and any(jnp.issubdtype(found.dtype, kind) for kind in kinds)


def _require_observation(task: Task, seen: PyTree) -> None:
    """Raises QfolioError unless an observation is of numbers, or one of a task's states.

    Its scale has to fit it.
    """
    leaves = jax.tree.leaves(seen)
    kinds = [jnp.issubdtype(x.dtype, jnp.number) or x.dtype == bool for x in leaves]
    if not (kinds and all(kinds)):
        raise _refused(task, "observe", seen, "an array of numbers, or several")
    if task.states is not None:
        require_type(f"states of {type(task).__name__}", task.states, Integral, "a whole number")
        if leaves != [seen] or seen.shape or not jnp.issubdtype(seen.dtype, jnp.integer):
            raise _refused(task, "observe", seen, f"a whole number below its states, {task.states}")
    scale = numbers(f"observation_scale of {type(task).__name__}", task.observation_scale)
    size = sum(x.size for x in leaves)
    if scale.shape not in ((), (size,)) or not (np.isfinite(scale) & (scale > 0)).all():
        raise QfolioError(
            f"observation_scale of {type(task).__name__} is {task.observation_scale}; it must be a "
            f"positive number, or one for each of the {size} numbers of an observation."
        )


def _require_like(
    owner: object, name: str, found: PyTree, wanted: PyTree, place: str = "", like: str = ""
) -> None:
    """Raises QfolioError unless a result has the structure, shapes and types that are wanted.

    like: the method whose result it has to be like.
    """
    like = like and f", like that of {type(owner).__name__}.{like}"
    forms: list[Any] = [jax.tree.structure(x) for x in (found, wanted)]
    if forms[0] != forms[1]:
        raise _refused(owner, name, found, _shown(wanted) + like, place)
    each = zip(jax.tree.leaves_with_path(found), jax.tree.leaves(wanted), strict=True)
    for (path, leaf), want in each:
        if (leaf.shape, leaf.dtype) != (want.shape, want.dtype):
            place += f" at {keystr(path)}" if path else ""
            raise _refused(owner, name, leaf, _shown(want) + like, place)


def _require_metrics(owner: object, name: str, found: Any) -> None:
    """Raises QfolioError unless metrics are scalars, with names that records can hold."""
    if not isinstance(found, dict) or any(getattr(x, "shape", 1) for x in found.values()):
        raise _refused(owner, name, found, "a dict of names and scalars", " as metrics")
    for metric in found:
        said = f"{type(owner).__name__}.{name} returns the metric {metric!r}"
        if metric in RESERVED:
            raise QfolioError(f"{said}, a name that the records already have; rename it.")
        text = isinstance(metric, str) and metric.strip() and metric.isprintable()
        if not text or csv_cell(metric) != metric:
            raise QfolioError(
                f"{said}; a name must be text that no spreadsheet reads as a formula."
            )


def _require_apart(task: Task, agent: Agent, **metrics: dict[str, Any]) -> None:
    """Raises QfolioError if two methods name a metric alike; metrics: by the method's name."""
    owners: dict[str, str] = {}
    for method, found in metrics.items():
        of_task = method == "measure" and type(agent).measure is Agent.measure
        place = f"{type(task if of_task else agent).__name__}.{method}"
        for name in found:
            if name in owners:
                raise QfolioError(
                    f"{owners[name]} and {place} both return a metric {name!r}; rename one of them."
                )
            owners[name] = place


def _refused(owner: object, name: str, found: PyTree, wanted: str, place: str = "") -> QfolioError:
    return QfolioError(
        f"{type(owner).__name__}.{name} returns {_shown(found)}{place}; it must be {wanted}."
    )


def _shown(tree: PyTree) -> str:
    """Shapes and types on one line, such as (float32[3], bool[])."""
    short = lambda x: f"{x.dtype}[{','.join(map(str, x.shape))}]"  # noqa: E731
    text = " ".join(str(jax.tree.map(short, tree)).replace("'", "").split())
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}…"
