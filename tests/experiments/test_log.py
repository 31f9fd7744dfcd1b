"""The log of an experiment: what it says, and that nothing counts twice."""

import contextlib
import errno
import os
from time import process_time

import numpy as np
import pytest

from qfolio.agents.ppo import PPO
from qfolio.core.errors import QfolioError
from qfolio.core.population import Population
from qfolio.experiments import log as logs
from qfolio.experiments.budget import Budget
from qfolio.experiments.events import EVENTS, read
from qfolio.experiments.fit import Training, fit
from qfolio.experiments.lasting import lasting
from qfolio.experiments.log import Log, Tracker, _parts, add_result, means, tracked
from qfolio.experiments.machines.messages import Report
from qfolio.experiments.machines.remote import hear
from qfolio.experiments.records import Records
from qfolio.experiments.run import Run

from jobs import wait_until
from listeners import Interrupt
from probes import Endless, Explosive


def logged(folder, kind=None):
    found, _ = read(folder / EVENTS)
    return found if kind is None else [event for event in found if event["event"] == kind]


def test_a_run_logs_its_beginning_its_records_and_its_end(task, agent, tmp_path):
    run = Run.create(task, agent, episodes=40, seeds=2, seed=3, out=tmp_path / "run")
    run.train()
    first, second, *_, last = logged(tmp_path / "run")
    assert (first["event"], first["kind"], first["task"], first["agents"], first["episodes"]) == (
        "start", "run", "pendulum", ["dqn"], 40,
    )  # fmt: skip
    assert (second["event"], second["step"], second["members"]) == (
        "running", 0, ["seed 3", "seed 4"],
    )  # fmt: skip
    assert (last["event"], last["state"]) == ("end", "done")
    records = logged(tmp_path / "run", "record")
    trained = [record for record in records if "return" in record["values"]]
    assert trained[-1]["step"] == run.done("steps")
    assert trained[-1]["share"] == 1.0
    assert {"loss", "max_q", "epsilon"} <= trained[-1]["values"].keys()
    graded = [record["values"] for record in records if "greedy return" in record["values"]]
    assert np.ravel([values["greedy return"] for values in graded]).tolist() == [
        row["return"] for row in run.evaluations
    ]


def test_records_are_means_of_all_episodes(task, agent, tmp_path, monkeypatch):
    monkeypatch.setattr(logs, "SHORTEST", 0.0)  # a record for every chunk
    monkeypatch.setattr(logs, "SHARE", 0.0)
    run = Run.create(task, agent, episodes=200, seeds=2, out=tmp_path / "run")
    run.train()
    records = [r for r in logged(tmp_path / "run", "record") if "return" in r["values"]]
    assert len(records) > 2
    before = 0.0
    for record in records:
        until = record["values"]["episode"][1]
        rows = [row for row in run.metrics if row["seed"] == 1 and before < row["episode"] <= until]
        expected = np.mean([row["return"] for row in rows])
        assert record["values"]["return"][1] == pytest.approx(expected, rel=1e-5)
        before = until
    assert before == run.population.member_episodes[1]


def test_a_long_chunk_makes_several_records(task, agent, tmp_path):
    run = Run.create(task, agent, steps=400, seeds=1, out=tmp_path / "run")
    run.train()
    records = [r for r in logged(tmp_path / "run", "record") if "return" in r["values"]]
    # Few episodes: a record for those of both environments.
    assert len(records) * agent.num_envs == len(run.metrics)
    returns = run.metrics.column("return").reshape(-1, agent.num_envs).mean(1)
    assert [r["values"]["return"] for r in records] == [
        [pytest.approx(each, rel=1e-5)] for each in returns.tolist()
    ]
    steps = [r["step"] for r in records]
    assert steps == sorted(set(steps))
    assert steps[-1] == run.done("steps")


def test_a_stopped_run_says_so_and_where_it_goes_on(task, agent, tmp_path):
    run = Run.create(task, agent, episodes=400, seeds=1, out=tmp_path / "run")
    run.train(listeners=[Interrupt()])
    *_, job, end = logged(tmp_path / "run")
    assert (job["event"], end["event"], end["state"]) == ("stopped", "end", "stopped")
    Run.open(tmp_path / "run").train(Budget(400))
    begun = logged(tmp_path / "run", "running")
    assert [event["step"] for event in begun] == [0, job["step"]]
    assert logged(tmp_path / "run")[-1]["state"] == "done"
    # The share is that of the whole training, not of what was left of it.
    events = [event for event in logged(tmp_path / "run") if event.get("share") is not None]
    shares = [event["share"] for event in events]
    assert shares == [
        pytest.approx(event["step"] / events[-1]["step"], abs=1e-4) for event in events
    ]
    assert 0 < begun[1]["share"] < 1


def test_an_error_ends_the_log(tmp_path, agent):
    run = Run.create(Explosive(), agent, episodes=400, out=tmp_path / "run")
    with pytest.raises(QfolioError) as raised:
        run.train()
    last = logged(tmp_path / "run")[-1]
    assert (last["state"], last["error"]) == ("failed", str(raised.value))


def test_a_full_disk_is_named_in_the_log(tmp_path):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "runs/mine/metrics.csv")
    with pytest.raises(OSError, match="No space"), Log(tmp_path).opened(kind="run"):
        raise full
    last = logged(tmp_path)[-1]
    assert last["state"] == "failed"
    assert last["error"] == "runs/mine/metrics.csv: No space left on device."


def test_a_cut_line_is_left_until_it_is_whole_and_skipped_if_never(tmp_path):
    path = tmp_path / EVENTS
    with Log(tmp_path).opened(kind="run"):
        pass
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"event":"rec')
    found, offset = read(path)
    assert ([event["event"] for event in found], offset) == (["start", "end"], len(whole))
    path.write_bytes(whole + b'{"event":"record","step":1}\n')
    assert read(path, offset)[0] == [{"event": "record", "step": 1}]
    path.write_bytes(whole + b'{"event":"rec')
    with Log(tmp_path).opened(kind="run"):
        pass
    assert [event["event"] for event in logged(tmp_path)] == ["start", "end"] * 2


@pytest.mark.parametrize("line", [b"[1]", b"{}", b'{"event":3}', b"\xff\xfe", b"[" * 10_000, b""])
def test_damaged_lines_are_skipped(tmp_path, line):
    (tmp_path / EVENTS).write_bytes(line + b'\n{"event":"start"}\n')
    assert logged(tmp_path) == [{"event": "start"}]


def test_a_member_without_an_episode_has_no_mean():
    rows = [{"seed": 7, "episode": 4, "return": 2.0, "loss": np.nan},
            {"seed": 7, "episode": 5, "return": 4.0, "loss": 1.0}]  # fmt: skip
    assert means(Records.of(rows), [1, 1], 3) == {
        "episode": [None, 5.0, None],
        "return": [None, 3.0, None],
        "loss": [None, 1.0, None],
    }


def training_far_away(left=0, members=(), ends=()):
    """A training on a worker, as the driver hears of it."""
    return Training(None, Budget(4), left=left, done=100, seconds=1.0, members=[*members],
                    ends=[*ends], where="process 7 on far")  # fmt: skip


def test_jobs_on_workers_are_logged_by_the_driver(tmp_path):
    with Log(tmp_path).opened(kind="backtest") as log:
        log.queue(["a"])
        job = log.job("a", ["seed 0"])
        rows = Records.of([{"seed": 0, "episode": 1, "return": 2.5}])
        hear(Report("on_start", training_far_away(left=100), Records()), job)
        hear(Report("on_chunk", training_far_away(members=[0], ends=[4]), rows), job)
        hear(Report("on_end", training_far_away(), Records()), job)
    names = [event["event"] for event in logged(tmp_path)]
    assert names == ["start", "queued", "running", "record", "done", "end"]
    assert logged(tmp_path, "running")[0]["worker"] == "process 7 on far"
    assert logged(tmp_path, "record")[0]["values"] == {"episode": [1.0], "return": [2.5]}
    assert logged(tmp_path, "done")[0]["step"] == 100


def test_the_file_is_touched_while_a_process_works(tmp_path, monkeypatch):
    monkeypatch.setattr(logs, "BEAT", 0.01)
    with Log(tmp_path).opened(kind="run"):
        os.utime(tmp_path / EVENTS, (1, 1))
        wait_until(lambda: (tmp_path / EVENTS).stat().st_mtime > 1000)


@pytest.mark.parametrize("environments", [1, 300])
def test_a_record_has_every_member_and_the_step_of_its_episodes(tmp_path, environments):
    """Environments of all members end their episodes at the same step."""
    agent = PPO(
        num_envs=environments, rollout_length=4, batch_size=4 * environments, epochs=1, hidden=(4,)
    )
    population = Population(Endless(horizon=4), agent, [0, 1, 2])
    with Log(tmp_path).opened(kind="run") as log:
        fit(population, Budget(50 * environments), [log.job(members=["a", "b", "c"])])
    records = logged(tmp_path, "record")
    assert len(records) > 10
    for record in records:
        assert record["step"] % (4 * environments) == 0
        episode = record["values"]["episode"]
        assert episode == [record["step"] / 4] * 3
        assert record["share"] == pytest.approx(episode[0] / (50 * environments), abs=1e-3)


def test_episodes_of_any_length_make_records_of_several_members():
    ends = np.sort(np.random.default_rng(0).permutation(400)[:40])
    parts = _parts(ends, 50, members=4)
    assert [part.stop - part.start for part in parts] == [4] * 10
    assert parts[-1].stop == 40
    many = _parts(np.arange(10_000), 10, members=200)
    assert {part.stop - part.start for part in many} == {800}  # four for each member


def test_trackers_hear_means_over_members(tmp_path):
    heard: list[object] = []

    class Listening(Tracker):
        def start(self, folder, about):
            heard.append((folder.name, about["kind"]))

        def log(self, values, step):
            heard.append((step, dict(values)))

        def finish(self):
            heard.append("finished")

    (tmp_path / "mine").mkdir()
    with tracked(Listening()), Log(tmp_path / "mine").opened(kind="run") as log:
        log.job("dqn", ["a", "b", "c"]).record(5, {"loss": [1.0, None, 3.0], "q": [None] * 3})
    with Log(tmp_path / "mine").opened(kind="run") as log:
        log.job().record(6, {"loss": [1.0]})  # nobody follows
    assert heard == [("mine", "run"), (5, {"dqn/loss": 2.0}), "finished"]


def test_grades_are_a_part_of_work_that_lasts(tmp_path):
    """They come before the end, and trackers hear of them; an error while grading is told."""
    heard: list[object] = []

    class Listening(Tracker):
        def log(self, values, step):
            heard.append((step, dict(values)))

        def finish(self):
            heard.append("finished")

    with lasting(), tracked(Listening()):
        for folder in ("a", "b"):
            (tmp_path / folder).mkdir()
            with Log(tmp_path / folder).opened(kind="run") as log:
                log.job().record(5, {"loss": [1.0]})
        add_result(tmp_path / "a", {"dqn": {"return": -1.5, "regret": None}})
        with Log(tmp_path / "a").opened(kind="run") as again:
            again.settle(True)
        assert heard == [(5, {"loss": 1.0}), (5, {"loss": 1.0}), (5, {"result/dqn/return": -1.5})]
    assert heard[3:] == ["finished", "finished"]
    assert [event["event"] for event in logged(tmp_path / "a")] == [
        "start", "record", "result", "end",
    ]  # fmt: skip
    (tmp_path / "d").mkdir()
    with lasting(), contextlib.suppress(QfolioError), Log(tmp_path / "d").opened(kind="run"):
        raise QfolioError("not finite")  # which the block around does without
    assert logged(tmp_path / "d")[-1]["state"] == "failed"
    (tmp_path / "c").mkdir()
    with pytest.raises(ValueError, match="of grading"), lasting():  # noqa: PT012
        with Log(tmp_path / "c").opened(kind="run") as log:
            log.settle(True)
        raise ValueError("of grading")
    assert logged(tmp_path / "c")[-1]["state"] == "failed"
    add_result(tmp_path / "c", {"dqn": {"return": 1.0}})  # of work that has ended
    assert logged(tmp_path / "c")[-1]["event"] == "result"


def test_a_log_without_a_folder_writes_nothing(task, agent, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Run.create(task, agent, episodes=4).train()
    assert not list(tmp_path.iterdir())


def test_logging_takes_little_of_a_training(tmp_path, monkeypatch):
    """Chunks of a millisecond, with ten episodes of eight members each: the clock is pretended."""
    now = [0.0]
    monkeypatch.setattr(logs, "perf_counter", lambda: now[0])
    members = [i % 8 for i in range(10)]
    training = training_far_away(left=100, members=members, ends=[100] * 10)
    row = dict.fromkeys(("seed", "episode", "return", "loss", "q"), 1.0)
    rows = Records.of([row] * 10)
    begun, chunks = process_time(), 20_000
    with Log(tmp_path).opened(kind="run") as log:
        job = log.job("", [f"seed {i}" for i in range(8)])
        for _ in range(chunks):
            now[0] += 1e-3
            training.seconds = now[0]
            job.on_chunk(training, rows)
    # It takes a hundredth, half of it for checking types; busy machines take longer.
    assert process_time() - begun < 0.04 * now[0]
