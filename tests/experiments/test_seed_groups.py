"""Runs whose seeds train in groups: the same as all of them side by side, to the bit."""

import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.budget import Budget
from qfolio.experiments.events import EVENTS, read
from qfolio.experiments.executor import Here
from qfolio.experiments.machines.processes import Processes
from qfolio.experiments.run import Run, train

from jobs import Elsewhere
from listeners import Interrupt, Tell
from populations import assert_same
from shell import TINY, qfolio

EPISODES, SEEDS = 12, 3


def start(task, agent, out=None, **changes):
    return Run.create(task, agent, **{"episodes": EPISODES, "seeds": SEEDS, "out": out} | changes)


def logged(folder, kind):
    found, _ = read(folder / EVENTS)
    return [event for event in found if event["event"] == kind]


def same(first, second):
    """Whether two runs agree to the bit."""
    assert_same(first.population.fetch(), second.population.fetch())
    assert first.metrics == second.metrics
    assert first.evaluations == second.evaluations
    assert first.grade() == second.grade()


def test_groups_are_the_run(task, agent, tmp_path):
    here, elsewhere = start(task, agent, tmp_path / "here"), start(task, agent, tmp_path / "there")
    here.train()
    executor, heard = Elsewhere(), set[float]()

    def listen(job, done, share):
        assert (done, share) == (len(executor.ran[1:]) / SEEDS, 1 / SEEDS)
        return [Tell(lambda training, rows: heard.update(row["seed"] for row in rows))]

    elsewhere.train(executor=executor, listen=listen)
    assert executor.ran == ["dqn/0", "dqn/1", "dqn/2"]
    assert heard == {0, 1, 2}
    same(here, elsewhere)
    same(here, Run.open(tmp_path / "there"))
    jobs = [(event["job"], event["members"]) for event in logged(tmp_path / "there", "running")]
    assert jobs == [(f"dqn/{seed}", [f"seed {seed}"]) for seed in range(SEEDS)]
    graded = [
        (event["step"], event["values"]["greedy return"])
        for event in logged(tmp_path / "there", "record")
        if event["job"] == "dqn/1" and "greedy return" in event["values"]
    ]
    curve = [row for row in here.evaluations if row["seed"] == 1]
    assert graded == [(row["env_steps"], [row["return"]]) for row in curve]
    assert logged(tmp_path / "there", "end")[-1]["state"] == "done"
    names = [{path.name for path in run.folder.iterdir()} for run in (here, elsewhere)]
    assert names[0] == names[1]
    for name in ("metrics.csv", "evaluation.csv", "policy.safetensors"):
        assert (here.folder / name).read_bytes() == (elsewhere.folder / name).read_bytes()


def test_a_worker_with_several_devices_gets_as_many_seeds(task, agent):
    executor = Elsewhere()
    executor.devices = 4
    (first, last) = start(task, agent, seeds=6, seed=5).groups.jobs(executor)
    assert [first.name, last.name] == ["dqn/5", "dqn/9"]
    assert (list(first.config.seed_range), list(last.config.seed_range)) == ([5, 6, 7, 8], [9, 10])
    assert first.most == last.most == 4


@pytest.mark.parametrize("folder", [True, False])
def test_a_stopped_run_asks_for_what_is_missing(task, agent, tmp_path, folder, monkeypatch):
    monkeypatch.setenv("NPROC", "1")  # a seed at a time
    run = start(task, agent, tmp_path / "run" if folder else None)
    run.train(executor=Elsewhere(), listen=lambda job, *_: [Interrupt()] * (job.name == "dqn/1"))
    assert run.interrupted
    assert run.population.steps == 0
    if folder:
        assert logged(tmp_path / "run", "end")[-1]["state"] == "stopped"
        assert Run.open(tmp_path / "run" / "seeds" / "0").episodes == EPISODES
        run = Run.open(tmp_path / "run")
    with pytest.raises(QfolioError, match="trained for 300 steps, not for 500; finish"):
        run.train(Budget(20), executor=Elsewhere())
    told = []

    def listen(job, done, share):
        told.append((job.name, done, share))
        return []

    run.train(executor=Here(), listen=listen)
    third = pytest.approx(1 / 3)
    assert told == [("dqn/1", third, third), ("dqn/2", pytest.approx(2 / 3), third)]
    assert not run.interrupted
    assert not run.groups.begun
    alone = start(task, agent)
    alone.train()
    same(alone, run)


def test_seeds_of_a_folder_that_was_moved_are_not_written_into_a_new_one(task, agent, tmp_path):
    """A new one would lack the run's settings, so that nothing could be done with the seeds."""
    run = start(task, agent, tmp_path / "run")

    def listen(job, done, share):
        if job.name == "dqn/1":
            (tmp_path / "run").rename(tmp_path / "moved")
        return []

    with pytest.raises(QfolioError, match="run is gone; if it was moved, resume it there"):
        run.train(executor=Elsewhere(), listen=listen)
    assert not (tmp_path / "run").exists()
    again = Run.open(tmp_path / "moved")
    assert again.groups.begun
    again.train(executor=Elsewhere())
    alone = start(task, agent)
    alone.train()
    same(alone, again)


def test_a_run_that_was_stopped_before_its_first_group_keeps_its_steps(task, agent, tmp_path):
    """Episodes may end early: resumed in this process, it has to take the steps of its groups."""
    run = start(task, agent, tmp_path / "run")
    run.train(executor=Elsewhere(), listen=lambda *_: [Interrupt()])
    assert not run.groups.begun
    again = Run.open(tmp_path / "run")
    assert again.budget == Budget(steps=300)
    again.train()
    elsewhere = start(task, agent)
    elsewhere.train(executor=Elsewhere())
    same(elsewhere, again)


def test_groups_that_were_all_there(task, agent, tmp_path):
    """The driver was killed before it could make them the run, or after that."""
    run = start(task, agent, tmp_path / "run")
    executor = Elsewhere()
    with pytest.MonkeyPatch.context() as killed:
        killed.setattr(Run, "adopt", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run.train(executor=executor)
    assert len(executor.ran) == SEEDS
    run, executor = Run.open(tmp_path / "run"), Elsewhere()
    with pytest.MonkeyPatch.context() as killed:
        killed.setattr("shutil.rmtree", lambda *_, **__: None)
        run.train(executor=executor)
    again = Run.open(tmp_path / "run")
    assert again.groups.begun
    again.train(executor=executor)
    assert not again.groups.begun
    assert executor.ran == []
    alone = start(task, agent)
    alone.train()
    same(alone, again)


def test_a_finished_run_goes_on(task, agent, tmp_path):
    here, there = start(task, agent), start(task, agent, tmp_path / "run")
    here.train()
    there.train(executor=Elsewhere())
    here.train(Budget(20))
    Run.open(tmp_path / "run").train(Budget(20), executor=Elsewhere())
    same(here, Run.open(tmp_path / "run"))


def test_a_loss_that_is_not_finite(task, agent):
    wild = type(agent)(hidden=(16,), num_envs=2, batch_size=8, replay_capacity=200,
                       learning_starts=20, learning_rate=1e29)  # fmt: skip
    with pytest.raises(QfolioError, match="The loss of seed 0 is no longer finite"):
        start(task, wild).train(executor=Elsewhere())


@pytest.mark.slow
def test_processes(task, agent):
    here = train(task, agent, episodes=EPISODES, seeds=SEEDS)
    there = train(task, agent, episodes=EPISODES, seeds=SEEDS, executor=Processes(2, cores=1))
    same(here, there)


def test_the_command(monkeypatch, capsys, tmp_path):
    arguments = ["train", *TINY, "--episodes", 4, "--seeds", 2, "--no-compare"]
    folder, executor = tmp_path / "run", Elsewhere()
    assert qfolio(monkeypatch, *arguments, "--live", "--on", "processes:1") == 2
    assert "leave out --on, or --live" in capsys.readouterr().err
    monkeypatch.setattr("qfolio.experiments.machines.choice.on", lambda text: executor)
    assert qfolio(monkeypatch, *arguments, "--out", folder, "--on", "processes:1") == 0
    assert executor.ran == ["dqn/0", "dqn/1"]
    assert (folder / "report.html").exists()
    assert "100%" in capsys.readouterr().out
