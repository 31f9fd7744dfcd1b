"""The folder of a run.

It holds config.json (settings), metrics.csv and evaluation.csv (appended), checkpoint.safetensors
(the whole training state, replaced atomically), policy.safetensors (weights) and, at the end,
summary.json. The checkpoint is authoritative: rows ahead of it are dropped when a run is resumed,
and then recomputed bit for bit.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from qfolio.core.config import Config, read_config, write_config
from qfolio.core.errors import QfolioError
from qfolio.core.files import (
    naming,
    read_tree,
    require_there,
    tidy,
    write_bytes,
    write_json,
    write_tree,
)
from qfolio.experiments.budget import Budget, seed_range
from qfolio.experiments.records import Records, Row

CONFIG, METRICS, EVALUATION = "config.json", "metrics.csv", "evaluation.csv"
CHECKPOINT, POLICY, SUMMARY = "checkpoint.safetensors", "policy.safetensors", "summary.json"


class RunConfig(Config, frozen=True):
    """The configuration of a run: one agent, one task, its seeds, and their budget."""

    kind: ClassVar[str] = "run"
    format: ClassVar[int] = 4

    task: str
    task_settings: dict[str, Any]
    agent: str
    agent_settings: dict[str, Any]
    preset: str | None
    episodes: int | None
    steps: int | None
    seeds: int
    seed: int
    device: str
    versions: dict[str, str]
    started: str

    def __post_init__(self) -> None:
        _ = self.budget, self.seed_range

    @property
    def budget(self) -> Budget:
        """The budget of each seed."""
        return Budget(self.episodes, self.steps)

    @property
    def seed_range(self) -> range:
        """The agents' seeds."""
        return seed_range(self.seeds, self.seed)


class RunFolder:
    """Reads and writes a run's files.

    Writing raises QfolioError if the folder was moved or deleted.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._written: int | None = None  # when the checkpoint was that was last read or written

    def write_config(self, config: RunConfig) -> None:
        write_config(self.path / CONFIG, config)

    def read_config(self) -> RunConfig:
        """Reads config.json; raises QfolioError if the folder holds no run of this version."""
        return read_config(self.path / CONFIG, RunConfig)

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Writes the grades of the latest checkpoint; raises QfolioError if it is another one."""
        self.require_latest()
        write_json(self.path / SUMMARY, summary)

    def write_checkpoint(self, state: Any, weights: Any) -> None:
        """Writes policy and checkpoint; the checkpoint comes last because it marks the progress."""
        require_there(self.path)
        write_tree(self.path / POLICY, weights)
        write_tree(self.path / CHECKPOINT, state)
        self._written = self._last

    def read_checkpoint(self, template: Any) -> Any:
        """The state that ``write_checkpoint`` wrote, in the shape of ``template``."""
        self._written = self._last  # first: a later one is then noticed
        return read_tree(self.path / CHECKPOINT, template)

    def require_latest(self) -> None:
        """Raises QfolioError if someone else has written a checkpoint since the last one here."""
        if self._last not in (self._written, None):
            raise QfolioError(f"{self.path} was trained further elsewhere; open it again.")

    @property
    def _last(self) -> int | None:
        """When the checkpoint was written; None if there is none."""
        path = self.path / CHECKPOINT
        return path.stat().st_mtime_ns if path.exists() else None

    def append(self, name: str, rows: Records) -> None:
        """Appends rows to a table, with a header if it is new."""
        if rows:
            require_there(self.path)
            with naming(self.path / name), (self.path / name).open("ab") as file:
                file.write(rows.csv(header=file.tell() == 0))

    def rows(self, name: str, episodes: dict[int, int], steps: int) -> Records:
        """The rows of a table up to a checkpoint; skips a last row that a crash cut short.

        episodes: number of episodes at the checkpoint, by seed. steps: of each seed's environments.
        """
        records = Records.read(self.path / name, cut=True)
        if not {"seed", "episode"} <= records.columns.keys():
            return Records()
        most = np.array([episodes.get(seed, -1) for seed in records.column("seed").tolist()])
        done = records.column("episode") <= most
        if "env_steps" in records.columns:
            done &= records.column("env_steps") <= steps
        return records[done]

    def tidy(self, tables: dict[str, Records]) -> None:
        """Resets the tables to these rows, and removes temporary files of a killed process."""
        for name, rows in tables.items():
            if rows:
                write_bytes(self.path / name, rows.csv(header=True))
            else:
                (self.path / name).unlink(missing_ok=True)
        tidy(self.path)


def curve_point(rows: Sequence[Row]) -> dict[str, list[float]]:
    """The log's values for a point of the learning curve; rows: of evaluation.csv, one per seed."""
    names = {"greedy return": "return", "overestimation": "overestimation"}
    return {name: [row[key] for row in rows] for name, key in names.items()}
