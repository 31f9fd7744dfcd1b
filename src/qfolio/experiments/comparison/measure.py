"""The measures of a finished run in a comparison: its grades, its learning curve and its cost."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qfolio.core.host import HostPopulation
from qfolio.core.training import TrainingState, begin
from qfolio.experiments.comparison.operations import operations_per_step
from qfolio.experiments.comparison.ranking import Result
from qfolio.experiments.grading import curve_optimum
from qfolio.experiments.run import Run


def measure(run: Run, devices: int) -> Result:
    """Grades a run and measures its cost.

    devices: number of devices that trained its seeds side by side.
    """
    summary = run.summary()
    seeds = len(run.population.seeds)
    rows = run.evaluations
    members = jax.eval_shape(partial(begin, run.task, run.agent), jnp.uint32(0))
    weights = _read_by_policy(run, members)
    at_once = 1 if isinstance(run.population, HostPopulation) else min(devices, seeds)
    return Result(
        returns=summary["return_per_seed"],
        optimum=summary["optimum"],
        starts=run.population.starts,
        curve_starts=run.population.curve_starts,
        curve_steps=[int(row["env_steps"]) for row in rows[::seeds]],
        curve_returns=np.reshape([row["return"] for row in rows], (-1, seeds)).tolist(),
        curve_optimum=curve_optimum(run.population),
        episodes=summary["episodes"],
        env_steps=summary["env_steps"],
        seconds_train=summary["seconds_train"],
        seconds_compile=summary["seconds_compile"],
        # The members of a device take turns, or share it.
        seconds_per_seed=summary["seconds_train"] / -(-seeds // at_once),
        steps_per_second=summary["steps_per_second"],
        operations_per_step=operations_per_step(run.task, run.agent),
        state_bytes=_bytes(jax.tree.leaves(members)),
        policy_bytes=_bytes(weights),
        parameters=sum(x.size for x in weights if jnp.issubdtype(x.dtype, jnp.floating)),
    )


def _read_by_policy(run: Run, members: TrainingState) -> list[Any]:
    """The arrays that decisions depend on: of the weights, a critic is left out."""
    weights = jax.eval_shape(run.agent.weights, members.agent)
    seen = jax.eval_shape(jax.vmap(run.task.observe), members.task)
    program = jax.make_jaxpr(run.agent.policy)(weights, seen).jaxpr
    read = {id(x) for equation in program.eqns for x in equation.invars}
    read |= {id(x) for x in program.outvars}
    leaves = jax.tree.leaves(weights)
    return [leaf for leaf, x in zip(leaves, program.invars, strict=False) if id(x) in read]


def _bytes(leaves: list[Any]) -> int:
    return int(sum(leaf.size * leaf.dtype.itemsize for leaf in leaves))
