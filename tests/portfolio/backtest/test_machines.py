"""Backtests and studies on several workers equal those in one process, to the bit."""

import importlib
import importlib.util
import itertools
import multiprocessing
from typing import Any

import numpy as np
import pytest

from qfolio.core.registry import trust
from qfolio.experiments import presets
from qfolio.experiments.executor import Here
from qfolio.experiments.fit import Listener
from qfolio.experiments.machines.choice import on
from qfolio.experiments.machines.processes import Processes
from qfolio.portfolio.backtest.kept import LATEST
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.study.run import Study

from listeners import Interrupt
from tables import price_table, random_walk
from tiny import DQN, PATHWISE

AGENTS = {"pathwise": PATHWISE}


def table(seed=0):
    values = random_walk(200, 30, seed, drift=3e-4)
    return price_table(values, [f"A{i}" for i in range(30)], source=f"made up {seed}")


def create(folder, agents=AGENTS):
    return Backtest.create(table(), agents, train="80d", test="40d", seeds=2, out=folder)


def files(folder):
    """The content of all files that hold results."""
    kept = [path for path in folder.rglob("*") if path.suffix in (".safetensors", ".csv")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in kept}


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    backtest = create(tmp_path_factory.mktemp("backtests") / "run")
    backtest.run()
    return files(backtest.folder)


class Shares(Listener):
    def __init__(self, job, into):
        self.shares = into.setdefault(job.name, [])

    def on_chunk(self, training, rows):
        self.shares.append(training.share)


@pytest.mark.slow
def test_processes_equal_this_process(here, tmp_path):
    heard: dict[str, list[float]] = {}
    backtest = create(tmp_path / "run")
    backtest.run(lambda job, done, share: [Shares(job, heard)], Processes(2, cores=1))
    found = files(backtest.folder)
    assert found.keys() == here.keys()
    assert [name for name in here if found[name] != here[name]] == []
    assert len(heard) == 4  # jobs, of which listeners heard until they were finished
    assert all(shares[-1] == 1.0 for shares in heard.values())


@pytest.mark.slow
def test_stopped_and_resumed_elsewhere(here, tmp_path):
    """Ctrl-C in the driver keeps what is done; a resumed run asks for the rest alone."""
    backtest, jobs = create(tmp_path / "run"), []

    def stop_at_the_third(job, done, share):
        jobs.append(job.name)
        return [Interrupt()] if len(jobs) == 3 else []

    backtest.run(stop_at_the_third, Processes(1, cores=1))
    assert backtest.interrupted
    kept = {f"pathwise/{path.stem}" for path in (tmp_path / "run").rglob("policies/*/*")}
    assert kept >= set(jobs[:2])
    resumed, asked = Backtest.open(tmp_path / "run"), []

    def note(job, done, share):
        asked.append(job.name)
        return []

    workers = Processes(2, cores=1)
    resumed.run(note, workers)
    assert not resumed.interrupted
    assert set(asked) == {job.name for job in create(None).jobs(workers)} - kept
    assert files(tmp_path / "run") == here


@pytest.mark.slow
def test_a_worker_that_is_killed(here, tmp_path):
    """Its job is trained again, by another worker: the second one, or one that has begun since."""
    backtest, told = create(tmp_path / "run"), []

    class Kill(Listener):
        def on_start(self, training):
            for child in multiprocessing.active_children():
                child.kill()

    def listen(job, done, share):
        told.append(job.name)
        return [Kill()] if len(told) == 2 else []

    backtest.run(listen, Processes(1, cores=1))
    assert len(told) == 5
    assert [a for a, b in itertools.pairwise(told) if a == b] != []
    assert files(tmp_path / "run") == here


@pytest.mark.optimized
def test_whole_programs_round_alike_whatever_the_workers(tmp_path):
    """Groups of folds differ with the cores of a worker; what is learned does not."""
    prices = price_table(random_walk(700, 12, 0, drift=3e-4), [f"A{i}" for i in range(12)])
    agents = {name: presets.preset("fast", "portfolio", name) for name in ("tilts", "sac")}
    agents = {name: preset._replace(episodes=96) for name, preset in agents.items()}
    found: list[dict[str, bytes]] = []
    for executor in (Here(), Processes(1), Processes(2, cores=1)):
        backtest = Backtest.create(
            prices, AGENTS | agents | {"dqn": DQN}, train="500d", test="100d", seeds=2,
            out=tmp_path / f"{len(found)}",
        )  # fmt: skip
        backtest.run(executor=executor)
        found.append(files(backtest.folder))
    assert found[0] == found[1] == found[2]


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Ray's own
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason='needs pip install "ray"')
def test_ray_equals_this_process(here, tmp_path):
    ray = importlib.import_module("ray")
    # Not the cluster of another test.
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        backtest = create(tmp_path / "run")
        backtest.run(executor=on("ray"))
    finally:
        ray.shutdown()
    assert files(backtest.folder) == here


@pytest.mark.slow
def test_a_study_on_processes(tmp_path):
    done: list[Any] = []
    for executor in (Here(), Processes(2, cores=1)):
        study = Study.create(
            {"one": table(0), "two": table(1)}, AGENTS, out=tmp_path / f"{len(done)}",
            costs=(0.001, 0.005), train="80d", test="40d", seeds=2, baselines=[],
        )  # fmt: skip
        study.run(executor=executor)
        assert len(study.config.looks) == 4
        done.append((study.result(), files(study.folder)))
    assert done[0] == done[1]


OWN = """
import jax.numpy as jnp
from qfolio.portfolio.rewards import Log

class Twice(Log):
    def __call__(self, state, outcome):
        reward, state = super().__call__(state, outcome)
        return 2 * reward, state
"""


@pytest.mark.slow
def test_workers_import_what_the_user_has_named(tmp_path, monkeypatch):
    """A reward of the user's own, which the settings of the task name."""
    (tmp_path / "own_reward_of_a_test.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    trust(["own_reward_of_a_test"])
    preset = AGENTS["pathwise"]
    task = {**preset.task, "reward": "own_reward_of_a_test:Twice"}
    backtest = create(tmp_path / "run", {"pathwise": preset._replace(task=task)})
    backtest.run(executor=Processes(1, cores=1))
    policy = create(None)  # of the ordinary reward
    policy.run(executor=Processes(1, cores=1))
    rewards = [np.mean([row["return"] for row in made.records("pathwise", LATEST)])
               for made in (backtest, policy)]  # fmt: skip
    assert rewards[0] == pytest.approx(2 * rewards[1], rel=0.5)
    assert rewards[0] != rewards[1]
