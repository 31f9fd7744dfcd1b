"""Several agents on one task, trained one after the other on the same seeds, and its folder.

The folder holds comparison.json (settings, written at the start; what each agent reached, added as
soon as it is finished; and the ranking that follows), a run folder for each agent in agents/ (so
that ``qfolio evaluate`` and ``watch`` know it) and, at the end, the report. What was stopped goes
on from the last checkpoint of the agent that was training.
"""

import dataclasses
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qfolio.core import devices, settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.files import new_folder, read_json, require_types, write_json
from qfolio.core.host import HostPopulation
from qfolio.core.mdp import Agent, Task
from qfolio.core.registry import AGENTS, TASKS, name_of
from qfolio.core.training import begin
from qfolio.core.version import __version__
from qfolio.experiments.comparison.operations import operations_per_step
from qfolio.experiments.comparison.ranking import Result, conclusion, listed, rank
from qfolio.experiments.run import Progress, Run, check_counts, configured_agent, configured_task

FORMAT = 1
"""Of comparison.json."""

FILE = "comparison.json"

COARSE = 10
"""Fewer points than these say little about when a learning curve came near the goal."""


@dataclass(frozen=True)
class Entrant:
    """An agent with the task as it needs it, and how long it trains.

    preset: which settings these are, for people to read.
    """

    task: Task
    agent: Agent
    preset: str | None
    budget: dict[str, int]  # episodes or steps, as ``Run.create`` takes them


Listener = Callable[[str, int, Progress | None], None]
"""Called with an agent's name and number (from 0): before it trains, and with where it is then."""


class Comparison:
    """Made by ``create`` or ``open``; ``run`` trains and grades who is missing.

    results: by agent, of those that are finished. failures: why others could not be.
    """

    def __init__(self, config: dict[str, Any], results: dict[str, Result], folder: Path) -> None:
        self.config, self.results, self.folder = config, results, folder
        self.failures: dict[str, str] = {}
        self.interrupted = False
        self.entrants = {
            name: _entrant(config["task"], entry) for name, entry in config["agents"].items()
        }

    @classmethod
    def create(
        cls,
        entrants: dict[str, Entrant],
        *,
        seeds: int,
        seed: int = 0,
        command: str = "",
        note: str = "",
        out: Path | str,
    ) -> "Comparison":
        """A comparison before its first agent; those that do not fit are refused here.

        Args:
            entrants: Two agents or more, by name.
            seeds: Trained of each, from ``seed`` on.
            command: What was typed to start it, for the report.
            note: What readers of the report should know, in a sentence.
            out: A new or empty folder.
        """
        if len(entrants) < 2:
            raise QfolioError(
                "A comparison needs two agents or more; name them with --agents, for example "
                "--agents dqn:fast,dqn:report."
            )
        for name, entrant in entrants.items():
            episodes, steps = (entrant.budget.get(unit) for unit in ("episodes", "steps"))
            check_counts(episodes, seeds, seed, steps=steps)
            _require_fit(name, entrant, seeds)
        tasks = list(dict.fromkeys(name_of(TASKS, entrant.task) for entrant in entrants.values()))
        if len(tasks) > 1:
            raise QfolioError(f"A comparison has one task, and here are {', '.join(tasks)}.")
        config = {
            "format": FORMAT,
            "kind": "comparison",
            "version": __version__,
            "task": tasks[0],
            "seeds": int(seeds),
            "seed": int(seed),
            "command": command,
            "note": note,
            "agents": {
                name: {
                    "agent": name_of(AGENTS, entrant.agent),
                    "preset": entrant.preset,
                    "agent_settings": settings.describe(entrant.agent),
                    "task_settings": settings.describe(entrant.task),
                    "budget": entrant.budget,
                }
                for name, entrant in entrants.items()
            },
            **devices.circumstances(),
        }
        with new_folder(Path(out)) as folder:
            write_json(folder / FILE, {**config, "results": {}})
        return cls(config, {}, Path(out))

    @classmethod
    def open(cls, folder: Path | str) -> "Comparison":
        """A comparison as its last finished agent left it."""
        path = Path(folder) / FILE
        if not path.is_file():
            raise QfolioError(f"{folder} is no comparison: it has no {FILE}.")
        content = read_json(path)
        if content.get("format") != FORMAT or content.get("kind") != "comparison":
            raise QfolioError(f"{path} was written in another format; compare anew.")
        try:
            _check(content)
            results = {name: Result(**entry) for name, entry in content["results"].items()}
        except (QfolioError, TypeError) as error:
            raise QfolioError(f"{path} is damaged: {error}") from None
        kept = ("results", "failures", "ranking", "conclusion", "notes")
        config = {key: value for key, value in content.items() if key not in kept}
        return cls(config, results, Path(folder))

    def place(self, name: str) -> Path:
        """The run folder of an agent."""
        return self.folder / "agents" / _folder_name(name)

    def run(self, listener: Listener | None = None) -> None:
        """Trains and grades every agent that has no result yet.

        A first Ctrl-C stops after the current chunk and sets ``interrupted``. An agent that
        diverges is left out and noted in ``failures``.
        """
        self.interrupted = False
        for number, name in enumerate(self.entrants):
            if name in self.results:
                continue
            tell = partial(listener, name, number) if listener else None
            if tell is not None:
                tell(None)
            try:
                run = self._open(name)
                run.train(listener=tell)
            except QfolioError as error:
                self.failures[name] = str(error)
                continue
            if run.interrupted:
                self.interrupted = True
                return
            self.results[name] = _result(run)
            self._write()

    def finish(self) -> dict[str, Any]:
        """The whole of comparison.json, with the ranking of all agents that are finished."""
        if len(self.results) < 2:
            reasons = "; ".join(f"{name}: {why}" for name, why in self.failures.items())
            raise QfolioError(f"There are not two agents to compare. {reasons}")
        self._write()
        return read_json(self.folder / FILE)

    def notes(self) -> list[str]:
        """What a reader has to know before he compares, in sentences."""
        notes = [f"{name} could not be trained. {why}" for name, why in self.failures.items()]
        notes += filter(None, [self.config["note"]])
        entrants = {name: self.entrants[name] for name in self.entrants if name in self.results}
        tasks = {name: settings.describe(entrant.task) for name, entrant in entrants.items()}
        differing = [_differing(key, tasks) for key in next(iter(tasks.values()))]
        if any(differing):
            said = "; ".join(filter(None, differing))
            notes.append(f"The task is not quite the same for all: {said}. {self._comparable()}")
        steps = {name: self.results[name].env_steps for name in entrants}
        most, least = max(steps, key=lambda n: steps[n]), min(steps, key=lambda n: steps[n])
        if steps[most] > 1.05 * steps[least]:
            notes.append(
                f"Budgets differ: from {steps[least]:,} environment steps a seed "
                f"({least}) to {steps[most]:,} ({most})."
            )
        coarse = [name for name in entrants if len(self.results[name].curve_steps) < COARSE]
        if coarse:
            notes.append(
                f"The learning curves of {listed(coarse)} have fewer than {COARSE} points, as so "
                "much is trained between two looks: what they need to come near the goal is less "
                "than stated."
            )
        return notes

    def _comparable(self) -> str:
        """Whether start states, lengths and optima are alike, found by looking at them."""
        tasks = [entrant.task for name, entrant in self.entrants.items() if name in self.results]
        starts = [jax.vmap(task.reset)(start_keys()) for task in tasks]
        optima = [result.optimum for result in self.results.values()]
        known = [optimum for optimum in optima if optimum is not None]
        alike = {
            "start states": all(_same(starts[0], start) for start in starts),
            "lengths of episodes": all(task.horizon == tasks[0].horizon for task in tasks),
        }
        if known:
            alike["exact optima"] = bool(np.allclose(known, known[0], rtol=1e-4))
        if all(alike.values()):
            return f"Their {listed(list(alike))} are the same (this was checked): results compare."
        differ = listed([name for name, same in alike.items() if not same])
        if len(known) == len(optima):
            return f"Their {differ} differ, too: each regret is a share of the agent's own optimum."
        return f"Their {differ} differ, too: returns do not compare."

    def _open(self, name: str) -> Run:
        """The agent's run, from its last checkpoint if there is one."""
        entrant, place = self.entrants[name], self.place(name)
        if (place / "config.json").exists():
            return Run.open(place)
        return Run.create(
            entrant.task,
            entrant.agent,
            seeds=self.config["seeds"],
            seed=self.config["seed"],
            preset=entrant.preset,
            out=place,
            **entrant.budget,
        )

    def _write(self) -> None:
        results = {name: self.results[name] for name in self.entrants if name in self.results}
        content = {
            **self.config,
            "results": {name: dataclasses.asdict(result) for name, result in results.items()},
            "failures": self.failures,
        }
        if len(results) > 1 and len(results) + len(self.failures) == len(self.entrants):
            ranking = rank(results)
            content |= {
                "ranking": ranking,
                "conclusion": conclusion(ranking),
                "notes": self.notes(),
            }
        write_json(self.folder / FILE, content)


def _folder_name(name: str) -> str:
    return name.replace(":", "-")


def _require_fit(name: str, entrant: Entrant, seeds: int) -> None:
    """Raises QfolioError where an agent cannot learn the task, by tracing and not by computing."""
    try:
        state = jax.eval_shape(partial(begin, entrant.task, entrant.agent), jnp.uint32(0))
        devices.require_memory(state, seeds)
    except QfolioError as error:
        raise QfolioError(f"{name}: {error}") from None


def _entrant(task: str, entry: dict[str, Any]) -> Entrant:
    return Entrant(
        configured_task({"task": task, **entry}),
        configured_agent(entry),
        entry["preset"],
        entry["budget"],
    )


def _differing(key: str, tasks: dict[str, dict[str, Any]]) -> str | None:
    """Who has which value of a task's setting; None where all have the same."""
    values: dict[str, list[str]] = {}
    for name, entry in tasks.items():
        value = entry[key]
        values.setdefault("empty" if value == "" else str(value), []).append(name)
    groups = (f"{value} for {listed(names)}" for value, names in values.items())
    return f"{key} is {', '.join(groups)}" if len(values) > 1 else None


def _check(content: dict[str, Any]) -> None:
    """Raises QfolioError where settings are missing or of the wrong type."""
    wanted = {"task": str, "seeds": int, "seed": int, "command": str, "note": str,
              "agents": dict, "results": dict, "device": str}  # fmt: skip
    require_types(content, wanted)
    parts = {"agent": str, "preset": str | None, "agent_settings": dict, "task_settings": dict,
             "budget": dict}  # fmt: skip
    for name, entry in content["agents"].items():
        # Names become folders.
        if not isinstance(entry, dict) or not re.fullmatch(r"[\w-]+(:[\w-]+)?", name):
            raise QfolioError(f"the agent {name!r} is not described.")
        require_types(entry, parts)
    if not content["results"].keys() <= content["agents"].keys():
        raise QfolioError("there are results of agents that it does not have.")


def _result(run: Run) -> Result:
    """Grades a finished run and measures what it took."""
    summary = run.summary()
    seeds = len(run.population.seeds)
    solution, curve_optimum = run.task.optimum(), None
    if solution is not None:
        curve_optimum = float(solution.returns(start_keys())[: run.population.curve_starts].mean())
    rows = run.evaluations[: len(run.evaluations) // seeds * seeds]
    members = jax.eval_shape(partial(begin, run.task, run.agent), jnp.uint32(0))
    weights = jax.tree.leaves(jax.eval_shape(run.agent.weights, members.agent))
    at_once = 1 if isinstance(run.population, HostPopulation) else min(len(jax.devices()), seeds)
    return Result(
        returns=summary["return_per_seed"],
        optimum=summary["optimum"],
        starts=run.population.starts,
        curve_starts=run.population.curve_starts,
        curve_steps=[int(row["env_steps"]) for row in rows[::seeds]],
        curve_returns=np.reshape([row["return"] for row in rows], (-1, seeds)).tolist(),
        curve_optimum=curve_optimum,
        episodes=summary["episodes"],
        env_steps=summary["env_steps"],
        seconds_train=summary["seconds_train"],
        seconds_compile=summary["seconds_compile"],
        # The members of a device take turns, or share it.
        seconds_per_seed=summary["seconds_train"] / -(-seeds // at_once),
        steps_per_second=summary["steps_per_second"],
        operations_per_step=operations_per_step(run.task, run.agent),
        state_bytes=_bytes(jax.tree.leaves(members)),
        policy_bytes=_bytes(weights),
        parameters=sum(x.size for x in weights if jnp.issubdtype(x.dtype, jnp.floating)),
    )


def _bytes(leaves: list[Any]) -> int:
    return int(sum(leaf.size * leaf.dtype.itemsize for leaf in leaves))


def _same(first: Any, second: Any) -> bool:
    """Whether two pytrees hold the same numbers."""
    pair = jax.tree.leaves(first), jax.tree.leaves(second)
    return len(pair[0]) == len(pair[1]) and all(map(np.array_equal, *pair))
