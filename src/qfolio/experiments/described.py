"""Tasks and agents in configurations: by name and settings."""

from typing import Any

from qfolio.core import settings
from qfolio.core.errors import QfolioError, require_type
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import Kind, build, name_of
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
    task: Task = _part("task", Task, "a task, such as qfolio.Pendulum()", name, described, given)
    return task


def agent_of(name: str, described: dict[str, Any], given: Agent | None = None) -> Agent:
    """The agent of a configuration; see ``task_of``."""
    agent: Agent = _part("agent", Agent, "an agent, such as qfolio.DQN()", name, described, given)
    return agent


def _part(
    kind: Kind, base: type, wanted: str, name: str, described: dict[str, Any], given: Any
) -> Any:
    if given is None:
        return build(kind, name, described)
    require_type(kind, given, base, wanted)
    for key, found, stored in (
        (kind, name_of(given), name),
        (f"{kind}_settings", settings.describe(given), described),
    ):
        if found != stored:
            raise QfolioError(
                f"{key} is {quote(found)}, but what the folder holds was trained with "
                f"{quote(stored)}; give that {kind}."
            )
    return given
