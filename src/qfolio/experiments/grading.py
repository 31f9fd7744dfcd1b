"""Grading policies: returns on the fixed start states, the exact optimum, and the regret."""

from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from qfolio.core import faults
from qfolio.core.errors import QfolioError, require_type, require_whole
from qfolio.core.evaluation import greedy, start_keys
from qfolio.core.mdp import Optimum, Task
from qfolio.core.population import Population
from qfolio.core.statistics import mean_interval, regret
from qfolio.core.text import listed
from qfolio.experiments.budget import MOST_STARTS
from qfolio.solvers.followed import FollowedOptimum


def grade(population: Population, starts: int | None = None) -> dict[str, Any]:
    """Returns, optimum and regret of each member's greedy policy, as JSON values.

    Regrets are None if the optimum is unknown or 0.
    starts: how many of the fixed start states (default: those of the population's kind). Raises
    QfolioError if a return is not finite.
    """
    if starts is not None:
        require_whole("starts", starts, 1, MOST_STARTS)
    task, keys = population.task, start_keys(starts or population.starts)
    faults.require_actions(task, population.agent, population.weights())
    played = population.evaluate(keys)
    returns = played.returns.mean(1)
    if not np.isfinite(returns).all():  # although all losses were: no file could hold it
        bad = listed(
            [str(s) for s, x in zip(population.seeds, returns, strict=True) if not np.isfinite(x)]
        )
        raise QfolioError(
            population.task_fault()
            or f"The return of seed {bad} is not finite; check the step of {task.name}."
        )
    best = optimal_returns(task, keys)
    optimum = None if best is None else float(best.mean())
    regrets = regret(returns, optimum)
    interval = mean_interval(returns)
    return {
        "return_mean": float(returns.mean()),
        "return_ci95": None if interval is None else list(interval),
        "return_per_seed": returns.tolist(),
        "optimum": optimum,
        "regret_per_seed": None if regrets is None else regrets.tolist(),
        "overestimation_per_seed": [
            float(error) if np.isfinite(error) else None for error in played.overestimation
        ],
        "rule": _rule(population),
    }


def curve_optimum(population: Population) -> float | None:
    """The optimal mean return on the start states of the learning curve, if it is known."""
    best = optimal_returns(population.task, start_keys())
    return None if best is None else float(best[: population.curve_starts].mean())


def optimal_returns(task: Task, keys: Key[Array, " start"]) -> np.ndarray | None:
    """The best policy's returns, one for each key, if they are known.

    Raises QfolioError unless the task's optimum gives them.
    """
    solution, place = task.optimum(), f"{type(task).__name__}.optimum()"
    if solution is None:
        return None
    require_type(place, solution, Optimum, "None, or an object with a method returns")
    found = np.asarray(solution.returns(keys))
    wanted = f"it must give a finite number for each of the {len(keys):,} keys"
    if found.shape != keys.shape or found.dtype.kind not in "fiu":
        shape = ",".join(map(str, found.shape))
        raise QfolioError(f"{place}.returns gives {found.dtype}[{shape}]; {wanted}.")
    if not np.isfinite(found).all():
        raise QfolioError(f"{place}.returns gives numbers that are not finite; {wanted}.")
    return found


def _rule(population: Population) -> dict[str, Any] | None:
    """The members' policies and the best one as few numbers, in tasks that define them."""
    solution = population.task.optimum()
    if not isinstance(solution, FollowedOptimum):
        return None
    task, agent, members = population.task, population.agent, population.weights()
    play = jax.jit(lambda weights, state: greedy(task, agent, weights)(state))
    policies = (
        partial(play, jax.tree.map(lambda x, i=i: x[i], members))
        for i in range(len(population.seeds))
    )
    return {
        "exact": task.rule(solution.policy),
        "per_seed": [task.rule(policy) for policy in policies],
    }
