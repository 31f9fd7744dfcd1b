"""Faults of a task that look like faults of learning."""

from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError, is_out_of_memory
from qfolio.core.mdp import Agent, Discrete, Simplex, Task, Transition
from qfolio.core.registry import own_modules
from qfolio.core.training import (
    TrainingState,
    absorb,
    begin,
    chunk_steps,
    episode_steps,
    healthy,
    play,
)

SECONDS = 10.0
"""Most time in which a fault is sought, except for compiling."""

OFF = 1e-3
"""How far weights may be off in single precision."""


class Checked(NamedTuple):
    """Whether the steps of a rollout are right, and how many of its episode came before each."""

    before: Int[Array, "time environment"]
    seen: Bool[Array, "time environment"]
    acted: Bool[Array, "time environment"]
    paid: Bool[Array, "time environment"]
    seen_next: Bool[Array, "time environment"]


def find(task: Task, agent: Agent, seed: int, steps: int = 0) -> str | None:
    """A sentence on the first observation or reward that is not finite; None if all are.

    Observations of a task with ``states`` have to be numbers of states. Trains again from the
    beginning until then, or until learning fails first. It takes at most ``SECONDS`` and as many
    ``steps`` as the training took, but at least an episode's. Where memory is too small for a
    second training, none is found.
    """
    try:
        return _find(task, agent, seed, steps)
    except Exception as error:
        if is_out_of_memory(error):
            return None
        raise


def _find(task: Task, agent: Agent, seed: int, steps: int) -> str | None:
    """``find``, which may run out of memory."""
    arrays, rest = eqx.partition((task, agent), eqx.is_array)

    def both(arrays: PyTree) -> tuple[Task, Agent]:
        found: Any = eqx.combine(arrays, rest)
        return found

    state = jax.jit(lambda arrays: begin(*both(arrays), jnp.uint32(seed)))(arrays)

    @partial(jax.jit, static_argnames="learning", donate_argnames="state")
    def train(
        arrays: PyTree, state: TrainingState, most: Array, *, learning: bool
    ) -> tuple[TrainingState, Checked]:
        """At most so many rollouts, and what the last one was like."""
        return _until_wrong(*both(arrays), state, most, learning=learning)

    warm_up = agent.whole_rollouts(agent.warm_up())
    wanted = agent.whole_rollouts(max(steps, episode_steps(task, agent)))
    done, over = 0, perf_counter() + SECONDS
    while done < wanted and perf_counter() < over:
        stop = min(done + chunk_steps(task, agent), wanted if done >= warm_up else warm_up)
        most = np.int32((stop - done) // agent.rollout_steps)
        state, checked = train(arrays, state, most, learning=done >= warm_up)
        if said := _told(task, agent, jax.tree.map(np.asarray, checked)):
            return said
        if not state.healthy:
            return None
        done = stop
    return None


def _told(task: Task, agent: Agent, checked: Checked) -> str | None:
    """A sentence on the first step of a rollout that is wrong; None if none is."""
    fine = [each.all(1) for each in checked[1:]]
    for time in range(len(checked.before)):
        right = [bool(each[time]) for each in fine]
        if all(right):
            continue
        first = right.index(False)
        step = int(checked.before[time, checked[1 + first][time].argmin()])
        if first == 1:
            return (
                f"The action of {type(agent).__name__} is not finite at step {step + 1} of an "
                "episode; check its init and act."
            )
        if first == 2:
            parts = "reward and cost model" if hasattr(task, "cost_model") else "step"
            return (
                f"The reward of {task.name} is not finite at step {step + 1} of an episode; check "
                f"its {parts}."
            )
        step += first == 3
        where = f"after step {step}" if step else "at the start"
        wrong = "finite" if task.states is None else f"from 0 to {task.states - 1}"
        return (
            f"The observation of {task.name} is not {wrong} {where} of an episode; check its "
            f"observe, step and reset{'' if task.states is None else ', and its states'}."
        )
    return None


def require_actions(task: Task, agent: Agent, learned: PyTree | None = None) -> None:
    """Raises QfolioError if a user's own agent chooses what the task does not have.

    These are weights that nobody can hold, numbers of no choice, or numbers that are not finite, at
    the start of an episode.

    learned: what members have learned, with a leading member axis (default: an untrained agent).
    """
    if not (task.compiled and own_modules(agent)):
        return

    def chosen(key: PRNGKeyArray) -> tuple[Bool[Array, ""], dict[str, Array]]:
        agent_key, reset_key, act_key = jax.random.split(key, 3)
        starts = jax.vmap(task.reset)(jax.random.split(reset_key, agent.num_envs))
        seen = jax.vmap(task.observe)(starts)
        finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(seen)]).all()
        if learned is not None:
            return finite, {"policy": jax.vmap(agent.policy, in_axes=(0, None))(learned, seen)}
        state = agent.init(task, agent_key)
        acts = agent.act(state, seen, act_key)
        return finite, {"act": acts, "policy": agent.policy(agent.weights(state), seen)}

    finite, found = jax.jit(chosen)(jax.random.key(0))
    if not finite:  # which ``find`` tells of the task
        return
    for method, actions in found.items():
        if said := _refused(task.actions, np.asarray(actions)):
            raise QfolioError(f"{type(agent).__name__}.{method} gives {said}")


def _refused(actions: Any, given: np.ndarray) -> str:
    """Why a task does not have the actions given; empty if it has them."""
    if not np.isfinite(given).all():
        return "an action that is not finite."
    if isinstance(actions, Discrete):
        wrong = given[(given < 0) | (given >= actions.n)]
        return (
            f"the action {wrong[0]:g}; it must be from 0 to {actions.n - 1}." if wrong.size else ""
        )
    if isinstance(actions, Simplex):
        sums = given.sum(-1)
        worst = float(sums.ravel()[abs(sums - 1).argmax()])
        if float(given.min()) < -OFF or abs(worst - 1) > OFF:
            return (
                f"weights of at least {float(given.min()):.3g} that sum to {worst:.3g}; weights, "
                "cash first, must be at least 0 and sum to 1, as a softmax is."
            )
    return ""


def _until_wrong(
    task: Task, agent: Agent, state: TrainingState, most: Array, *, learning: bool
) -> tuple[TrainingState, Checked]:
    """Trains for at most so many rollouts, until one is wrong or learning fails."""

    def train(state: TrainingState) -> tuple[TrainingState, Checked]:
        before = state.tally.steps
        state, rollout = play(task, agent, state)
        state, _ = absorb(task, agent, state, rollout, learning=learning)
        state = eqx.tree_at(lambda s: s.healthy, state, healthy(agent, state))
        return state, _checked(task, rollout, before)

    def goes_on(carry: tuple[Array, TrainingState, Checked]) -> Bool[Array, ""]:
        count, state, checked = carry
        return (count < most) & state.healthy & jnp.stack([x.all() for x in checked[1:]]).all()

    shapes = jax.eval_shape(train, state)[1]
    right = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), shapes)
    start = jnp.array(0, jnp.int32), state, right
    step = lambda carry: (carry[0] + 1, *train(carry[1]))  # noqa: E731
    _, state, checked = lax.while_loop(goes_on, step, start)
    return state, checked


def _checked(task: Task, rollout: Transition, before: Int[Array, " environment"]) -> Checked:
    """before: steps of each environment's episode before the rollout."""
    least, most = (-jnp.inf, jnp.inf) if task.states is None else (0, task.states - 1)
    each = lambda x: x.reshape(*rollout.reward.shape, -1).all(-1)  # noqa: E731

    def valid(seen: PyTree) -> Bool[Array, "time environment"]:
        leaves = jax.tree.leaves(seen)
        fine = [each(jnp.isfinite(x) & (least <= x) & (x <= most)) for x in leaves]
        return jnp.stack(fine).all(0)

    over = rollout.terminated | rollout.truncated
    count = lambda steps, over: (jnp.where(over, 0, steps + 1), steps)  # noqa: E731
    return Checked(
        lax.scan(count, before, over)[1],
        valid(rollout.observation),
        each(jnp.isfinite(rollout.action)),
        jnp.isfinite(rollout.reward),
        valid(rollout.next_observation),
    )
