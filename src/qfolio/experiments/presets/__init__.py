"""Presets: hyperparameters tuned for each task and agent."""

from qfolio.core.errors import QfolioError
from qfolio.core.registry import AGENTS, GYM, TASKS
from qfolio.experiments.presets import finite, gymnasium, markets, pendulum, portfolio
from qfolio.experiments.presets.preset import Preset, Presets

__all__ = ["PRESETS", "Preset", "default_agent", "preset", "presets_of"]

PRESETS: Presets = {
    **pendulum.PRESETS,
    **finite.PRESETS,
    **markets.PRESETS,
    **gymnasium.PRESETS,
    **portfolio.PRESETS,
}
"""Presets by task and agent."""


def default_agent(task: str) -> str:
    """The first agent that has presets for a task, or a default; the task need not exist."""
    default = "dqn" if task in (*TASKS, "portfolio") else "ppo"
    return next((agent for name, agent in PRESETS if name == task), default)


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
    """The preset of that name; raises QfolioError if there is none."""
    presets = presets_of(task, agent)
    if name not in presets:
        there = f"choose from {', '.join(presets)}" if presets else "there are none"
        raise QfolioError(f"there is no preset {name!r} for {agent} on {task}; {there}.")
    return presets[name]
