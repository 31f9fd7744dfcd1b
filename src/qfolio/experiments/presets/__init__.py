"""Presets: hyperparameters tuned for each task and agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qfolio.core.errors import QfolioError, require_type
from qfolio.core.registry import AGENTS, GYM, TASKS
from qfolio.core.text import listed, near
from qfolio.experiments.presets import finite, gymnasium, markets, pendulum, portfolio
from qfolio.experiments.presets.preset import Preset, Presets

if TYPE_CHECKING:
    from qfolio.core.mdp import Task
    from qfolio.experiments.run_folder import RunConfig

__all__ = ["PRESETS", "Preset", "changes", "default_agent", "preset", "presets_of"]

PRESETS: Presets = {
    **pendulum.PRESETS,
    **finite.PRESETS,
    **markets.PRESETS,
    **gymnasium.PRESETS,
    **portfolio.PRESETS,
}
"""Presets by task and agent."""


def default_agent(task: str) -> str:
    """The first agent with presets for a task, or a default agent; accepts unknown tasks."""
    default = "dqn" if task in (*TASKS, "portfolio") else "ppo"
    return next(iter(_suited(task)), default)


def _suited(task: str) -> list[str]:
    """The agents with presets for a task."""
    return [agent for name, agent in PRESETS if name == task]


def presets_of(task: str, agent: str) -> dict[str, Preset]:
    """Presets by name; the agent's defaults if it or the task is not qfolio's."""
    known = PRESETS.get((task, agent), {})
    if known or (task in (*TASKS, "portfolio") and agent in AGENTS):
        return known
    if task.startswith(GYM):
        return {"fast": gymnasium.of_any(task.removeprefix(GYM), agent)}
    if task == "portfolio":
        return {"fast": portfolio.of_any(agent)}
    return {"fast": Preset(agent, {}, steps=100_000, seeds=4)}


def preset(name: str, task: str = "pendulum", agent: str = "dqn") -> Preset:
    """The preset of that name for an agent on a task.

    Args:
        name: Such as "fast".
        task: A name that ``qfolio train`` knows, or "portfolio".
        agent: A name that ``qfolio train`` knows.

    Raises:
        QfolioError: There is no such preset; the message names the closest, or those that exist.
    """
    for argument, value in {"name": name, "task": task, "agent": agent}.items():
        require_type(argument, value, str, "text")
    if ":" not in agent and agent not in AGENTS:  # others are a user's own
        raise QfolioError(f"there is no agent {agent!r}; {near(agent, _suited(task) or AGENTS)}")
    presets = presets_of(task, agent)
    if not presets:
        raise QfolioError(f"{agent} has no preset for {task}; {_fitting(task, agent)}.")
    if name not in presets:
        raise QfolioError(
            f"there is no preset {name!r} for {agent} on {task}; {near(name, presets)}"
        )
    return presets[name]


def _fitting(task: str, agent: str) -> str:
    """Advice on what to use instead of a task and an agent that do not fit together."""
    suited = [other for other, name in PRESETS if name == agent]
    twins = [other for other in suited if other.partition("/")[0] == task.partition("/")[0]]
    others = f"on {task} use {listed(_suited(task), 'or')}"
    if twins:
        return f"use it on {listed(twins, 'or')}, or {others}"
    if suited == ["portfolio"]:
        return f"it is an agent for price tables (qfolio backtest); {others}"
    return others


def changes(config: RunConfig, task: type[Task]) -> tuple[str, dict[str, tuple[Any, Any]]] | None:
    """The preset of a run, and the settings that differ from it: the run's value and the preset's.

    A run without a preset is compared with the first one; None if there is none.
    task: the class of the run's task.
    """
    from qfolio.experiments.described import plain

    known = presets_of(config.task, config.agent)
    if not known:
        return None
    name = config.preset if config.preset in known else next(iter(known))
    own = known[name].described(task)
    chosen = plain(config.agent_settings | config.task_settings)
    return name, {
        key: (value, own.get(key)) for key, value in chosen.items() if value != own.get(key)
    }
