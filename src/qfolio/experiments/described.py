"""Tasks and agents in configurations: by name and settings."""

from typing import Any

from qfolio.core import settings
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import build, name_of


def describe(task: Task, agent: Agent) -> dict[str, Any]:
    """A task and an agent by name and settings, under the keys of configurations."""
    return {
        "task": name_of(task),
        "task_settings": settings.describe(task),
        "agent": name_of(agent),
        "agent_settings": settings.describe(agent),
    }


def task_of(name: str, described: dict[str, Any]) -> Task:
    """The task of a configuration; imports no module that only the configuration names."""
    task: Task = build("task", name, described)
    return task


def agent_of(name: str, described: dict[str, Any]) -> Agent:
    """The agent of a configuration; see ``task_of``."""
    agent: Agent = build("agent", name, described)
    return agent
