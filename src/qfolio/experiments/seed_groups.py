"""Training the seeds of a run in groups: each group is a job, wherever it runs.

Finished groups wait in the run's folder seeds/, each in a run folder of its own. When the last one
is finished, all are joined into the run.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import jax
import msgspec
import numpy as np
from jaxtyping import PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.files import new_folder, require_there
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import short
from qfolio.experiments.budget import Budget
from qfolio.experiments.executor import Executor, at_once
from qfolio.experiments.fit import Listener
from qfolio.experiments.log import Log, seed_names
from qfolio.experiments.records import Records
from qfolio.experiments.run_folder import EVALUATION, METRICS, RunConfig, RunFolder, curve_point
from qfolio.experiments.seeds import Seeds, TrainedSeeds

FOLDER = "seeds"


@dataclass(frozen=True)
class SeedsJob:
    """Trains some seeds of a run, as one population.

    label: of the run. config: for these seeds alone. most: number of seeds of the run's largest
    group, whose programs all share. start: the states to continue from (default: those before the
    first step).
    """

    label: str
    task: Task
    agent: Agent
    config: RunConfig
    most: int
    start: PyTree | None = None

    @property
    def name(self) -> str:
        return f"{self.label}/{self.config.seed}"

    @property
    def members(self) -> list[str]:
        return seed_names(self.config.seed_range)

    def run(self, listeners: Sequence[Listener]) -> TrainedSeeds | QfolioError | None:
        """The trained seeds, or why they could not be trained; None if Ctrl-C stopped it."""
        try:
            seeds = Seeds(self.task, self.agent, self.config, None, self.most)
            if self.start is not None:
                seeds.population.restore(self.start)
            seeds.train_here(seeds.budget, listeners, Log(None).job(members=self.members))
        except QfolioError as error:
            return error
        if seeds.interrupted and seeds.budget.left(seeds.population):
            return None
        compiling = seeds.population.seconds_compile
        return TrainedSeeds(self.config, seeds.state(), seeds.metrics, seeds.evaluations, compiling)


class SeedGroups:
    """The groups of a run's seeds; ``jobs`` trains those that are missing."""

    def __init__(self, run: Seeds) -> None:
        self._run = run
        self._done: dict[int, TrainedSeeds] = {}  # by the first seed

    @property
    def begun(self) -> bool:
        """Whether some groups are finished but not yet joined into the run."""
        return bool(self._done) or (self._place is not None and self._place.exists())

    def jobs(
        self, executor: Executor, budget: Budget | None = None, label: str | None = None
    ) -> list[SeedsJob]:
        """The jobs of the groups that are missing; pass each result to ``store``.

        Each seed takes as many steps as its episodes would if none ended early, so that its result
        does not depend on seeds of other groups.

        budget: of each seed (default: the run's). label: prefix of the jobs' names (default: the
        agent's name).
        """
        run, budget = self._run, budget or self._run.budget
        if not budget.left(run.population):
            self._clear()
            return []
        steps, state = budget.planned(run.population), run.state()
        if self._place is not None:
            self._done = {part.config.seed: part for part in _read(self._place, state)}
        for part in self._done.values():
            if part.config.steps != steps:
                raise QfolioError(
                    f"Some seeds of the run have been trained for {part.config.steps:,} steps, not "
                    f"for {steps:,}; finish that training first, with the earlier budget."
                )
        # In steps, so that a run resumed in this process trains as long as its groups would.
        run.aim_at(Budget(steps=steps))
        if not (missing := self.missing):
            self._join()
        groups = _groups(missing, executor)
        first, start = run.config.seed, state["training"] if run.population.steps else None
        return [
            SeedsJob(
                label or short(run.config.agent),
                run.task,
                run.agent,
                msgspec.structs.replace(
                    run.config, seed=group.start, seeds=len(group), episodes=None, steps=steps
                ),
                max(map(len, groups)),
                _members(start, group.start - first, group.stop - first),
            )
            for group in groups
        ]

    def store(self, job: SeedsJob, trained: TrainedSeeds | QfolioError, log: Log) -> None:
        """Stores the result of a job; after the last one, joins all groups into the run.

        Raises QfolioError if the job could not train its seeds. log: receives its learning curve.
        """
        if isinstance(trained, QfolioError):
            raise trained
        self._done[trained.config.seed] = trained
        if self._place is not None:
            require_there(self._place.parent)
            _write(self._place, trained, self._run.agent)
        said = log.job(job.name, job.members)
        for step, rows in groupby(trained.evaluations, lambda row: row["env_steps"]):
            said.record(int(step), curve_point(list(rows)))
        if not self.missing:
            self._join()

    @property
    def missing(self) -> list[int]:
        """The seeds that are in no finished group."""
        there = {seed for part in self._done.values() for seed in part.config.seed_range}
        return [seed for seed in self._run.config.seed_range if seed not in there]

    @property
    def _place(self) -> Path | None:
        return None if self._run.folder is None else self._run.folder / FOLDER

    def _join(self) -> None:
        self._run.adopt(_joined(list(self._done.values()), self._run))
        self._clear()

    def _clear(self) -> None:
        self._done = {}
        if self._place is not None:
            shutil.rmtree(self._place, ignore_errors=True)


def _groups(seeds: Sequence[int], executor: Executor) -> list[range]:
    """Groups of consecutive seeds, each of which fills a worker's devices; seeds: ascending."""
    size = at_once(executor)
    groups: list[range] = []
    for seed in seeds:
        if groups and groups[-1].stop == seed and len(groups[-1]) < size:
            groups[-1] = range(groups[-1].start, seed + 1)
        else:
            groups.append(range(seed, seed + 1))
    return groups


def _joined(parts: Sequence[TrainedSeeds], run: Seeds) -> TrainedSeeds:
    """Joins the groups of seeds into one; their times are added up.

    Rows are ordered as in one population: by time, then by seed.
    """
    parts = sorted(parts, key=lambda part: part.config.seed)
    states = [part.state["training"] for part in parts]
    episodes = Records.joined(part.metrics for part in parts)
    points = Records.joined(part.evaluations for part in parts)
    # Environments finish their episodes at the same time, unless some end early.
    lap = (episodes.column("episode") - 1) // run.agent.num_envs
    by_time = np.lexsort([episodes.column("episode"), episodes.column("seed"), lap])
    return TrainedSeeds(
        run.config,
        {
            "training": jax.tree.map(lambda *x: np.concatenate(x), *states),
            "seconds_train": sum(part.state["seconds_train"] for part in parts),
        },
        episodes[by_time],
        points[np.lexsort([points.column("seed"), points.column("env_steps")])],
        sum(part.seconds_compile for part in parts),
    )


def _members(state: PyTree, first: int, last: int) -> PyTree:
    return jax.tree.map(lambda x: x[first:last], state)


def _write(place: Path, part: TrainedSeeds, agent: Agent) -> None:
    """Writes finished seeds into the folder of a run's seeds."""
    with new_folder(place / str(part.config.seed)) as unfinished:
        files = RunFolder(unfinished)
        files.write_config(part.config)
        files.append(METRICS, part.metrics)
        files.append(EVALUATION, part.evaluations)
        files.write_checkpoint(part.state, agent.weights(part.state["training"].agent))


def _read(place: Path, state: PyTree) -> Iterator[TrainedSeeds]:
    """Reads the finished seeds in such a folder; state: a template, the whole run's state."""
    for path in place.glob("[0-9]*"):
        files = RunFolder(path)
        config = files.read_config()
        template = {**state, "training": _members(state["training"], 0, config.seeds)}
        kept = files.read_checkpoint(template)
        episodes = kept["training"].episodes.tolist()
        most = dict(zip(config.seed_range, episodes, strict=True))
        steps = config.budget.amount
        metrics, evaluations = (files.rows(n, most, steps) for n in (METRICS, EVALUATION))
        yield TrainedSeeds(config, kept, metrics, evaluations)
