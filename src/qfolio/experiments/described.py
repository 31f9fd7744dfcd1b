"""Tasks and agents in configurations: by name and settings."""

from typing import Any

from qfolio.core import settings
from qfolio.core.errors import QfolioError, require_type
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import build, name_of
from qfolio.core.text import quote


def describe(task: Task, agent: Agent) -> dict[str, Any]:
    """A task and an agent by name and settings, under the keys of configurations."""
    return {
        "task": name_of(task),
        "task_settings": settings.describe(task),
        "agent": name_of(agent),
        "agent_settings": settings.describe(agent),
    }


def task_of(name: str, described: dict[str, Any], given: Task | None = None) -> Task:
    """The task of a configuration; imports no module that only the configuration names.

    given: the task itself, if it cannot be restored. Raises QfolioError if it is another one.
    """
    if given is None:
        task: Task = build("task", name, described)
        return task
    require_type("task", given, Task, "a task, such as qfolio.Pendulum()")
    _require_same("task", given, name, described)
    return given


def agent_of(name: str, described: dict[str, Any], given: Agent | None = None) -> Agent:
    """The agent of a configuration; see ``task_of``."""
    if given is None:
        agent: Agent = build("agent", name, described)
        return agent
    require_type("agent", given, Agent, "an agent, such as qfolio.DQN()")
    _require_same("agent", given, name, described)
    return given


def _require_same(kind: str, given: Any, name: str, described: dict[str, Any]) -> None:
    """Raises QfolioError unless an agent or task is the one of a configuration."""
    for key, found, stored in (
        (kind, name_of(given), name),
        (f"{kind}_settings", settings.describe(given), described),
    ):
        if found != stored:
            raise QfolioError(
                f"{key} is {quote(found)}, but what the folder holds was trained with "
                f"{quote(stored)}; give that {kind}."
            )
