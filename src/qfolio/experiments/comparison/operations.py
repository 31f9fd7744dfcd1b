"""An agent's arithmetic operations, counted in its program instead of measured."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent, Task
from qfolio.core.training import advance, begin


def operations_per_step(task: Task, agent: Agent) -> float | None:
    """Floating-point operations in matrix products per environment step, counted in the program.

    A product of (n, k) and (k, m) counts 2nkm, the usual convention; all else is left out. None if
    the task is not part of the program.
    """
    state = jax.eval_shape(partial(begin, task, agent), jnp.uint32(0))
    learn = partial(advance, task, agent, learning=True)
    try:
        program = jax.make_jaxpr(learn)(state, jax.ShapeDtypeStruct((), jnp.int32))
    except QfolioError:
        return None
    # The loop over rollouts has no fixed length, so that its body counts once.
    return _operations(program.jaxpr) / (agent.rollout_steps * agent.num_envs)


def _operations(program: Any) -> float:
    total = 0.0
    for equation in program.eqns:
        name, params = equation.primitive.name, equation.params
        if name == "dot_general":
            (contracted, _), _ = params["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            total += 2 * equation.outvars[0].aval.size * math.prod(shape[i] for i in contracted)
        elif name == "conv_general_dilated":
            kernel = equation.invars[1].aval
            outputs = kernel.shape[params["dimension_numbers"].rhs_spec[0]]
            total += 2 * equation.outvars[0].aval.size * kernel.size / outputs
        inner = [_operations(program) for program in _programs(params)]
        times = params["length"] if name == "scan" else 1
        total += times * (max(inner) if name == "cond" else sum(inner))
    return total


def _programs(params: dict[str, Any]) -> list[Any]:
    """The programs inside an equation of a program."""
    lists = (value if isinstance(value, tuple) else (value,) for value in params.values())
    values = [getattr(value, "jaxpr", value) for values in lists for value in values]
    return [value for value in values if hasattr(value, "eqns")]
