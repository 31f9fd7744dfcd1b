"""What a backtest has trained: in its folder or, without one, in memory."""

import re
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import shell
from qfolio.experiments.records import Records
from qfolio.portfolio.backtest.folder import BacktestFolder

LATEST = "latest"
"""Name of the first policies trained on the last rows of the table; see ``tomorrow``."""

_UPDATED = re.compile(rf"{LATEST}-([0-9]+)")


class Kept:
    """The policies of a backtest and the records of their training, by agent and fold.

    folder: where they are; None for in memory.
    """

    def __init__(self, folder: BacktestFolder | None) -> None:
        self.folder = folder
        self._policies: dict[tuple[str, str], Any] = {}
        self._records: dict[tuple[str, str], Records] = {}

    def has(self, agent: str, fold: str) -> bool:
        """Whether an agent is trained on a fold."""
        if self.folder is None:
            return (agent, fold) in self._policies
        return self.folder.has_policy(agent, fold)

    def names(self, agent: str) -> list[str]:
        """The folds that an agent is trained on, and its other policies."""
        if self.folder is None:
            return [fold for name, fold in self._policies if name == agent]
        return self.folder.policies(agent)

    def updates(self, agent: str) -> int:
        """Number of updates of an agent's newest policy for tomorrow; −1 before it has one."""
        return max(map(updates_of, self.names(agent)), default=-1)

    def newest(self, agent: str) -> str:
        """The name of an agent's newest policy for tomorrow."""
        return tomorrow(max(self.updates(agent), 0))

    def policy(self, agent: str, fold: str, template: Any) -> Any:
        """A policy, in the structure of the template; raises QfolioError if it is not trained."""
        self.require(agent, fold)
        if self.folder is None:
            return self._policies[agent, fold]
        return self.folder.read_policy(agent, fold, template)

    def require(self, agent: str, fold: str) -> None:
        """Raises QfolioError unless an agent is trained on a fold."""
        if not self.has(agent, fold):
            where = (
                f"qfolio backtest --resume {shell(self.folder.path)}" if self.folder else "run()"
            )
            raise QfolioError(f"The backtest is not finished; continue with {where} first.")

    def records(self, agent: str, fold: str) -> Records:
        """Every training episode of all seeds, in order of time; empty if there are none."""
        if self.folder is None:
            return self._records.get((agent, fold), Records())
        return self.folder.read_records(agent, fold)

    def write(self, agent: str, fold: str, rows: Records, policy: Any) -> None:
        """Keeps a fold; its records come first, because the policy marks it as trained."""
        if self.folder is None:
            self._records[agent, fold] = rows
        else:
            self.folder.write_records(agent, fold, rows)
        self.write_policy(agent, fold, policy)

    def write_policy(self, agent: str, fold: str, policy: Any) -> None:
        """Keeps a policy, without records of training."""
        if self.folder is None:
            self._policies[agent, fold] = policy
        else:
            self.folder.write_policy(agent, fold, policy)


def tomorrow(updates: int) -> str:
    """Name of the policies for tomorrow: latest, or latest-N after N updates."""
    return f"{LATEST}-{updates}" if updates else LATEST


def updates_of(name: str) -> int:
    """Number of updates of a policy for tomorrow; −1 for the policy of a fold."""
    match = _UPDATED.fullmatch(name)
    return int(match[1]) if match else -(name != LATEST)


def learning(learner: Any, updates: int, learned: np.datetime64) -> dict[str, Any]:
    """The policy for tomorrow as one tree, so that its file is always consistent."""
    seconds = np.array(learned, "datetime64[s]").astype(np.int64)
    return {"learner": learner, "updates": np.array(updates), "learned": seconds}
