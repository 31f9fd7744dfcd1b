"""Tasks and agents as configurations describe them: by name and settings."""

import sys
from typing import Any

from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import AGENTS, TASKS, find, name_of


def describe(task: Task, agent: Agent) -> dict[str, Any]:
    """Both by name and settings, under the names that configurations give them."""
    return {
        "task": name_of(TASKS, task),
        "task_settings": settings.describe(task),
        "agent": name_of(AGENTS, agent),
        "agent_settings": settings.describe(agent),
    }


def task_of(name: str, described: dict[str, Any]) -> Task:
    """The task of a configuration; it imports no module that a stranger may have named there."""
    module, _, id = str(described.get("id", "")).rpartition(":")
    if module and module not in sys.modules:
        raise QfolioError(
            f"The run is on {id} of the module {module}, which only you may import: do so first, "
            "in Python, and then open the run (qfolio.Run.open)."
        )
    return settings.build(find("task", TASKS, name), described)


def agent_of(name: str, described: dict[str, Any]) -> Agent:
    """The agent of a configuration."""
    return settings.build(find("agent", AGENTS, name), described)
