import contextlib
import copy
import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
from datetime import date
from enum import Enum
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import load_file

import qfolio.core.files
from qfolio.agents.ddpg import DDPG
from qfolio.agents.dqn import DQN
from qfolio.agents.pathwise import Pathwise
from qfolio.agents.tabular import QLearning
from qfolio.core.errors import QfolioError
from qfolio.core.fields import static
from qfolio.core.files import write_arrays
from qfolio.core.mdp import Discrete, Step, Task
from qfolio.core.text import four_digits
from qfolio.experiments.budget import Budget
from qfolio.experiments.described import OTHERS, agent_of, recorded
from qfolio.experiments.grading import curve_optimum
from qfolio.experiments.run import Run, train
from qfolio.portfolio.synthetic.ar1 import Ar1
from qfolio.portfolio.synthetic.kelly import Kelly
from qfolio.tasks.finite import Cliff, FiniteMDP

from listeners import Interrupt, Tell
from probes import Aim, Explosive, OneState, RewardDelay


def create(task, agent, folder, episodes=12, **options):
    return Run.create(task, agent, episodes=episodes, out=folder, **options)


def contents(folder):
    """Everything that a resumed run must have in common with one that was never interrupted."""
    arrays = load_file(folder / "checkpoint.safetensors")
    del arrays["seconds_train"]
    return arrays, (folder / "metrics.csv").read_text(), (folder / "evaluation.csv").read_text()


def assert_same(folder, other, same_plan=True):
    arrays, metrics, evaluation = contents(folder)
    expected, expected_metrics, expected_evaluation = contents(other)
    if same_plan:  # which says when the learning curve gets its points
        assert evaluation == expected_evaluation
    assert arrays.keys() == expected.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, expected[name], err_msg=name)
    assert metrics == expected_metrics


def test_n_and_n_episodes_equal_2n(task, agent, tmp_path):
    create(task, agent, tmp_path / "straight", episodes=24, seeds=2).train()
    create(task, agent, tmp_path / "halves", episodes=12, seeds=2).train()
    again = Run.open(tmp_path / "halves")
    assert again.episodes == 12
    again.train(Budget(24))
    assert_same(tmp_path / "halves", tmp_path / "straight", same_plan=False)


def test_a_run_that_was_moved_says_so_and_goes_on_there(task, agent, tmp_path):
    create(task, agent, tmp_path / "straight").train()
    run = create(task, agent, tmp_path / "run")
    moved = tmp_path / "moved"
    with pytest.raises(QfolioError, match="run is gone; if it was moved, resume it there"):
        run.train(listeners=[Tell(lambda *_: moved.exists() or run.folder.rename(moved))])
    assert not run.folder.exists()
    Run.open(moved).train()
    assert_same(moved, tmp_path / "straight")


def test_a_run_is_opened_with_what_it_was_trained_with(task, agent, tmp_path):
    """Another agent would train on, and config.json would still name the first."""
    create(task, agent, tmp_path / "run", seeds=1).train()
    assert Run.open(tmp_path / "run", task=task, agent=agent).episodes == 12
    other = dataclasses.replace(agent, learning_rate=0.9)
    with pytest.raises(QfolioError, match=r"agent_settings is .*but .* was trained with"):
        Run.open(tmp_path / "run", agent=other)
    with pytest.raises(QfolioError, match=r"task is .market/ar1., but .* was trained with"):
        Run.open(tmp_path / "run", task=Ar1())


class Unit(Enum):
    DAY, MONTH = "day", "month"


class Bandit(OneState):
    """Pays the number that an action chooses from an array."""

    pay: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 1.0]))

    def step(self, state, action, key):
        return Step(state, jnp.asarray(self.pay)[action], jnp.array(True))


class Wrapped(Task):
    """Another task, of which it is a copy."""

    inner: Task = RewardDelay()
    horizon: int = static(2)

    @property
    def actions(self):
        return self.inner.actions

    def reset(self, key):
        return self.inner.reset(key)

    def observe(self, state):
        return self.inner.observe(state)

    def step(self, state, action, key):
        return self.inner.step(state, action, key)


@pytest.mark.parametrize(
    ("made", "other", "default", "field"),
    [
        (lambda: Bandit(pay=np.array([5.0, 1.0])), Bandit(pay=np.array([5.0, 2.0])), Bandit(),
         "pay"),
        (lambda: Wrapped(inner=Aim(bound=3.0)), Wrapped(inner=Aim(bound=4.0)), Wrapped(), "inner"),
        (lambda: Wrapped(inner=Bandit(pay=np.array([5.0, 1.0]))), Wrapped(inner=Bandit()),
         Wrapped(), "inner"),
    ],
)  # fmt: skip
def test_a_field_that_no_folder_holds_is_not_replaced(made, other, default, field, tmp_path):
    """Neither by its default nor by another that is given."""
    agent = DQN(hidden=(4,)) if made().actions == Discrete(2) else DDPG(hidden=(4,))
    create(made(), agent, tmp_path / "run")
    with pytest.raises(QfolioError, match=rf"{field} of the task .* is no setting, .*\(folder, ta"):
        Run.open(tmp_path / "run")
    with pytest.raises(
        QfolioError, match=f"{field} of the task is not what the folder was trained"
    ):
        Run.open(tmp_path / "run", task=other)
    Run.open(tmp_path / "run", task=made())
    create(default, DQN(hidden=(4,)), tmp_path / "default")
    Run.open(tmp_path / "default")
    with pytest.raises(
        QfolioError, match=f"{field} of the task is not what the folder was trained"
    ):
        Run.open(tmp_path / "default", task=other)


def test_a_folder_that_says_nothing_of_an_array_is_opened(tmp_path):
    """As folders of earlier versions do."""
    task = Bandit(pay=np.array([5.0, 1.0]))
    create(task, DQN(hidden=(4,)), tmp_path / "run")
    file = tmp_path / "run" / "config.json"
    config = json.loads(file.read_text())
    assert config["task_settings"].pop(OTHERS).keys() == {"pay"}
    file.write_text(json.dumps(config))
    assert Run.open(tmp_path / "run", task=task).task is task


class Holding(OneState):
    """Holds anything, which shapes the program."""

    held: Any = eqx.field(static=True, default=None)


@dataclasses.dataclass
class Box:
    """Holds arrays, too, without a warning of jax."""

    content: Any


def digest(content):
    return recorded(Holding(held=Box(content)))[OTHERS]["held"]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (np.float32, np.float64),
        (b"a", b"b"),
        ({1, 2}, {1, 3}),
        (range(3), range(4)),
        (1 + 2j, 1 + 3j),
        (date(2020, 1, 1), date(2020, 1, 2)),
        (np.datetime64(5, "s"), np.datetime64(5, "m")),
        (Unit.DAY, Unit.MONTH),
        (partial(max, 1), partial(max, 2)),
        (partial(max, key=abs), partial(max, key=len)),
        (pd.DataFrame({"a": [1.0]}), pd.DataFrame({"b": [1.0]})),
        (pd.DataFrame({"a": ["x"]}), pd.DataFrame({"b": ["x"]})),
        (pd.Series([1.0], ["a"]), pd.Series([1.0], ["b"])),
    ],
)
def test_fields_with_another_content_have_another_digest(first, second):
    assert digest(first) == digest(copy.deepcopy(first))
    assert digest(first) != digest(second)


def test_equal_fields_have_the_same_digest():
    assert digest(np.float64(0.5)) == digest(0.5)
    assert digest(np.int32(3)) == digest(3)
    assert digest({"a": 1, "b": {2, 3}}) == digest({"b": {3, 2}, "a": 1})
    assert digest({"b", "a", 1, None}) == digest({None, 1, "a", "b"})
    assert digest(np.array(np.float32, object)) == digest(np.array(np.float32, object))


def test_where_an_agent_itself_is_given_is_said():
    """A backtest takes several."""
    described = recorded(Towards(held=np.ones(2)))
    with pytest.raises(QfolioError, match=r"opened, as agent=…, or in agents=\{…\} of a backtest"):
        agent_of(f"{__name__}:Towards", described)


class Towards(DQN):
    held: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))


def test_tables_that_follow_from_settings_are_not_recorded():
    assert OTHERS not in recorded(Cliff())
    assert OTHERS in recorded(FiniteMDP(np.ones((1, 1, 1)), np.ones((1, 1))))


@pytest.mark.parametrize("starts", [0, -1, 10**9])
def test_a_grade_needs_starts(starts, task, agent):
    with pytest.raises(QfolioError, match=f"starts is {starts}; it must be from 1 to 1048576"):
        Run.create(task, agent, episodes=1).grade(starts)


def test_a_run_says_what_it_is(task, agent, tmp_path):
    run = Run.create(task, agent, steps=1000, seeds=2, out=tmp_path / "run")
    assert repr(run) == f"<Run: dqn on pendulum, 2 seeds, 0 of 1,000 steps, in {tmp_path / 'run'}>"


def test_a_run_shows_itself_in_a_notebook(task, agent, tmp_path):
    run = Run.create(task, agent, episodes=12, seeds=2, preset="<b>", out=tmp_path / "run")
    assert "0 of 12 episodes" in run._repr_html_()
    run.train()
    shown = run._repr_html_()
    assert "preset &lt;b&gt;" in shown
    assert "<svg" in shown
    assert "greedy return, 64 starts" in shown
    assert f"<td>{four_digits(run.evaluations[-1]['return'])}</td>" in shown


def test_steps_say_how_far_as_episodes_do(task, agent, tmp_path):
    create(task, agent, tmp_path / "straight", episodes=None, steps=300, seeds=2).train()
    create(task, agent, tmp_path / "halves", episodes=None, steps=133, seeds=2).train()
    again = Run.open(tmp_path / "halves")
    assert (again.done("steps"), again.budget) == (134, Budget(steps=133))
    again.train(Budget(steps=300))
    assert_same(tmp_path / "halves", tmp_path / "straight", same_plan=False)
    again.train(Budget(14))  # episodes of 25 steps
    assert again.budget == Budget(14)
    assert again.done("steps") == 350


IN_A_MARKET = {
    "pathwise": (Ar1(horizon=20), Pathwise(rollout_length=10, num_envs=3, hidden=(4, 4))),
    "dqn": (
        Ar1(horizon=20, menu="grid:2"),
        DQN(hidden=(8,), all_actions=True, num_envs=2, batch_size=8, replay_capacity=100,
            learning_starts=20, episode_steps=0, learning_rate_steps=200.0),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", IN_A_MARKET)
def test_n_and_n_episodes_equal_2n_in_a_market(name, tmp_path):
    task, agent = IN_A_MARKET[name]
    create(task, agent, tmp_path / "straight", episodes=240, seeds=2).train()
    create(task, agent, tmp_path / "halves", episodes=120, seeds=2).train()
    Run.open(tmp_path / "halves").train(Budget(240))
    assert_same(tmp_path / "halves", tmp_path / "straight", same_plan=False)


SCRIPT = """
import sys
from qfolio.core import devices
devices.configure()
from qfolio.experiments import seeds
from qfolio.experiments.run import Run
from qfolio.experiments.fit import Listener
from qfolio.agents.dqn import DQN
from qfolio.tasks.pendulum import Pendulum
seeds.CHECKPOINT_SECONDS = 0.0
agent = DQN(hidden=(16,), num_envs=2, batch_size=8, replay_capacity=200, learning_starts=20,
            episode_steps=0, learning_rate_steps=200.0)
run = Run.create(Pendulum(horizon=25), agent, episodes={episodes}, seeds=2, out={out!r})
print("started", flush=True)
class Wait(Listener):
    def on_chunk(self, training, rows):
        print(training.population.episodes, flush=True)
        sys.stdin.readline()
run.train(listeners=[Wait()])
"""


@pytest.mark.slow
def test_killed_at_a_random_moment(task, agent, tmp_path):
    """SIGKILL falls anywhere, also into the writing of a checkpoint, which happens all the time.

    The child asks before each chunk, so that it cannot be done before the signal comes.
    """
    seed = time.time_ns()
    print("seed of the moments:", seed)  # shown if the test fails
    moments = random.Random(seed)
    episodes = 960
    straight = create(task, agent, tmp_path / "straight", episodes=episodes, seeds=2)
    straight.train()
    for i in range(4):
        folder = tmp_path / f"killed{i}"
        script = SCRIPT.format(episodes=episodes, out=str(folder))
        process = subprocess.Popen(
            [sys.executable, "-c", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ,
        )
        assert process.stdout is not None
        assert process.stdin is not None
        process.stdout.readline()
        # The first chunk only collects, and a checkpoint is written after the child has asked.
        for _ in range(moments.randint(3, 20)):
            process.stdout.readline()
            process.stdin.write("go on\n")
            process.stdin.flush()
        time.sleep(moments.uniform(0, 0.05))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        resumed = Run.open(folder)
        assert 0 < resumed.episodes < episodes
        resumed.train()
        assert_same(folder, tmp_path / "straight")


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one(task, agent, tmp_path, monkeypatch):
    run = create(task, agent, tmp_path / "run")
    before = (tmp_path / "run" / "checkpoint.safetensors").read_bytes()

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(qfolio.core.files.os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        run.train()
    assert (tmp_path / "run" / "checkpoint.safetensors").read_bytes() == before
    leftovers = [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]
    assert leftovers == []


def test_killed_before_the_first_checkpoint(task, agent, tmp_path):
    """The curve's point at the start is on disk by then, and must not come twice."""
    create(task, agent, tmp_path / "straight").train()
    create(task, agent, tmp_path / "killed").evaluate()
    Run.open(tmp_path / "killed").train()
    assert_same(tmp_path / "killed", tmp_path / "straight")


def test_ctrl_c_stops_with_a_checkpoint(task, agent, tmp_path):
    run = create(task, agent, tmp_path / "run", episodes=24 * 50)

    run.train(listeners=[Interrupt(lambda training: training.population.episodes >= 24)])
    assert run.interrupted
    assert 0 < run.episodes < 24 * 50
    assert Run.open(tmp_path / "run").episodes == run.episodes


def test_a_run_that_goes_on_has_the_same_curve_where_episodes_end_early(tmp_path):
    agent = QLearning(epsilon_decay=0.99)
    create(Cliff(), agent, tmp_path / "straight", episodes=600).train()
    stopped = create(Cliff(), agent, tmp_path / "stopped", episodes=600)
    stopped.train(listeners=[Interrupt(lambda training: training.population.episodes >= 200)])
    assert 0 < stopped.episodes < 600
    Run.open(tmp_path / "stopped").train()
    assert_same(tmp_path / "stopped", tmp_path / "straight")


def test_an_infinite_loss_keeps_the_last_good_checkpoint(tmp_path):
    agent = DQN(hidden=(4,), num_envs=2, batch_size=8, learning_starts=4, episode_steps=0)
    run = create(Explosive(), agent, tmp_path / "run")
    before = (tmp_path / "run" / "checkpoint.safetensors").read_bytes()
    with pytest.raises(QfolioError, match="reward of Explosive is not finite"):
        run.train()
    assert (tmp_path / "run" / "checkpoint.safetensors").read_bytes() == before


def test_rows_ahead_of_the_checkpoint_are_dropped(task, agent, tmp_path):
    create(task, agent, tmp_path / "run", episodes=4).train()
    metrics = tmp_path / "run" / "metrics.csv"
    good = metrics.read_text()
    metrics.write_text(good + "0,5,-100.0,0.1,0.9,1.0\n0,6,-1")
    spoilt = metrics.read_text()
    run = Run.open(tmp_path / "run")
    assert len(run.metrics) == 4
    assert metrics.read_text() == spoilt, "reading a run changes nothing"
    run.train(Budget(8))
    assert metrics.read_text().startswith(good)
    assert [row["episode"] for row in run.metrics] == [1, 2, 3, 4, 5, 6, 7, 8]


def test_two_processes_cannot_train_in_one_folder(task, agent, tmp_path):
    run, other = create(task, agent, tmp_path / "run"), Run.open(tmp_path / "run")
    tried = []

    def meanwhile(training, rows):
        with pytest.raises(QfolioError, match=rf"in use by process {os.getpid()}"):
            other.train()
        tried.append(rows)

    run.train(listeners=[Tell(meanwhile)])
    assert tried
    Run.open(tmp_path / "run").train()


def test_a_run_that_was_trained_further_elsewhere_is_not_cut_back(task, agent, tmp_path):
    run, other = create(task, agent, tmp_path / "run"), Run.open(tmp_path / "run")
    other.train()
    other.summary()
    before, graded = contents(tmp_path / "run"), (tmp_path / "run" / "summary.json").read_bytes()
    with pytest.raises(QfolioError, match="run was trained further elsewhere; open it again"):
        run.train(Budget(2))
    with pytest.raises(QfolioError, match="run was trained further elsewhere; open it again"):
        run.summary()  # of what it was before
    np.testing.assert_equal(contents(tmp_path / "run"), before)
    assert (tmp_path / "run" / "summary.json").read_bytes() == graded
    other.train(Budget(14))
    other.train(Budget(16))
    assert Run.open(tmp_path / "run").episodes == 16


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "a row lost"])
def test_a_learning_curve_that_was_damaged(task, agent, tmp_path, damage):
    """Whole points stay; where there is none, the curve begins again with where the run is."""
    create(task, agent, tmp_path / "run", seeds=2).train()
    path = tmp_path / "run" / "evaluation.csv"
    lines = path.read_text().splitlines(keepends=True)
    if damage == "missing":
        path.unlink()
    else:
        kept = {
            "empty": [],
            "cut": [*lines[:4], lines[4][:5]],
            "a row lost": [*lines[:3], *lines[4:]],
        }
        path.write_text("".join(kept[damage]))
    run = Run.open(tmp_path / "run")
    run.train()
    points = {row["env_steps"] for row in run.evaluations}
    assert len(run.evaluations) == 2 * len(points)
    assert len(points) == {"missing": 1, "empty": 1, "cut": 1}.get(
        damage, (len(lines) - 1) // 2 - 1
    )


@pytest.mark.parametrize(
    "text",
    [
        "seed,episode,return\ninf,1,2\n",
        "seed,episode\n0,1_0\n",
        "seed\n" + "9" * 200_000,
        "seed,episode," + "9" * 200_000 + "\n0,1,2",
        "\x00",
        "a,b\n1\n",
    ],
)
def test_damaged_tables_are_refused_or_skipped(task, agent, tmp_path, text):
    create(task, agent, tmp_path / "run")
    (tmp_path / "run" / "metrics.csv").write_text(text)
    damaged = "9" * 1000 in text or "_" in text
    with pytest.raises(QfolioError, match="metrics") if damaged else contextlib.nullcontext():
        assert Run.open(tmp_path / "run").metrics == []


@pytest.mark.slow
def test_weights_that_are_not_finite_stop_training(task, tmp_path):
    agent = DQN(hidden=(4,), num_envs=2, batch_size=8, learning_starts=4, learning_rate=1e30)
    run = create(task, agent, tmp_path / "run")
    with pytest.raises(QfolioError, match="no longer finite"):
        run.train()


def test_unfinished_files_of_a_killed_process_are_swept(task, agent, tmp_path):
    run = create(task, agent, tmp_path / "run", episodes=2)
    left = tmp_path / "run" / ".checkpoint.safetensors.1.part"
    left.write_bytes(b"half")
    run.train()
    assert not left.exists()


def test_whole_numbers_mean_the_same_as_fractions(task, tmp_path):
    """Settings come back from config.json as floats, and must train alike."""
    agent = DQN(
        hidden=[8], num_envs=2, batch_size=8,  # type: ignore[arg-type]
        learning_starts=4, reward_scale=3, huber_delta=1,
    )  # fmt: skip
    create(task, agent, tmp_path / "run", episodes=8).train()
    create(task, agent, tmp_path / "again", episodes=4).train()
    Run.open(tmp_path / "again").train(Budget(8))
    assert_same(tmp_path / "run", tmp_path / "again", same_plan=False)


def test_the_policy_file_holds_the_weights_only(task, agent, tmp_path):
    run = create(task, agent, tmp_path / "run", seeds=2)
    policy = load_file(tmp_path / "run" / "policy.safetensors")
    assert {name: array.shape for name, array in policy.items()} == {
        "mlp/weights/0": (2, 3, 16), "mlp/weights/1": (2, 16, 11),
        "mlp/biases/0": (2, 16), "mlp/biases/1": (2, 11),
    }  # fmt: skip
    np.testing.assert_array_equal(policy["mlp/weights/0"][0], run.first_weights().mlp.weights[0])


def test_summary(task, agent, tmp_path):
    run = train(task, agent, episodes=4, seeds=2, seed=5, out=tmp_path / "run")
    summary = run.summary()
    assert json.loads((tmp_path / "run" / "summary.json").read_text()) == summary
    assert {
        "task", "agent", "preset", "seeds", "episodes", "env_steps", "seconds_compile",
        "seconds_train", "steps_per_second", "return_mean", "return_ci95", "return_per_seed",
        "optimum", "regret_per_seed", "overestimation_per_seed",
    } <= summary.keys()  # fmt: skip
    assert (summary["seeds"], summary["episodes"], summary["env_steps"]) == (2, 4, 100)
    np.testing.assert_allclose(summary["return_mean"], np.mean(summary["return_per_seed"]))
    shortfall = summary["optimum"] - np.array(summary["return_per_seed"])
    np.testing.assert_allclose(summary["regret_per_seed"], shortfall / abs(summary["optimum"]))
    assert run.config.seed == 5


def test_there_is_no_share_of_an_optimum_of_zero(tmp_path):
    """Of a bet that loses on average nothing is staked, and the best growth is 0."""
    task, agent = Kelly(probability=0.4, horizon=10), Pathwise(rollout_length=10, num_envs=8)
    summary = train(task, agent, episodes=8, seeds=2, out=tmp_path / "run").summary()
    assert (summary["optimum"], summary["regret_per_seed"]) == (0.0, None)
    assert json.loads((tmp_path / "run" / "summary.json").read_text()) == summary


class Solved(OneState):
    """Its optimum is what a test says."""

    solution: Any = static(None)

    def optimum(self):
        return self.solution


class Returns:
    """An optimum."""

    def __init__(self, returns):
        self.returns = returns


@pytest.mark.parametrize(
    ("solution", "says"),
    [
        (3.0, r"^Solved.optimum\(\) is 3.0; it must be None, or an object with a method returns."),
        (Returns(lambda keys: np.zeros(3)), r"returns gives float64\[3\]; it must give a finite n"),
        (Returns(lambda keys: 3.0), r"returns gives float64\[\]; it must give a finite number for"),
        (Returns(lambda keys: ["a"] * len(keys)), r"returns gives <U1\[.*\]; it must give a fini"),
        (Returns(lambda keys: np.full(len(keys), np.nan)), "gives numbers that are not finite; it"),
    ],
)  # fmt: skip
def test_an_optimum_that_gives_no_returns_is_refused(solution, says):
    run = Run.create(Solved(solution=solution), DQN(hidden=(4,)), episodes=1)
    with pytest.raises(QfolioError, match=says):
        curve_optimum(run.population)  # which commands ask for before they train
    with pytest.raises(QfolioError, match=says):
        run.grade()


def test_an_optimum_of_ones_own_is_that_of_the_grade():
    task = Solved(solution=Returns(lambda keys: [0.5] * len(keys)))
    grade = Run.create(task, DQN(hidden=(4,)), episodes=1).grade()
    assert grade["optimum"] == 0.5


def test_the_optimum_of_a_curve_is_that_of_its_starts():
    """The first 64 of 1,024, which earn 0, 1, 2, …"""
    task = Solved(solution=Returns(lambda keys: np.arange(len(keys))))
    run = Run.create(task, DQN(hidden=(4,)), episodes=1)
    assert curve_optimum(run.population) == 31.5
    assert run.grade()["optimum"] == 511.5


def spoil_checkpoint(folder, how):
    path = folder / "checkpoint.safetensors"
    if how == "missing":
        path.unlink()
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[:-100])
    elif how == "pickle":
        path.write_bytes(b"\x80\x04cos\nsystem\n(S'touch /tmp/owned'\ntR.")
    elif how == "foreign":
        write_arrays(path, {"a": np.zeros(3)})
    elif how == "other shapes":
        arrays = load_file(path)
        arrays["training/steps"] = np.zeros((5,), np.int32)
        write_arrays(path, arrays)


@pytest.mark.parametrize("how", ["missing", "truncated", "pickle", "foreign", "other shapes"])
def test_refuses_checkpoints_that_do_not_fit(task, agent, tmp_path, how):
    create(task, agent, tmp_path / "run")
    spoil_checkpoint(tmp_path / "run", how)
    with pytest.raises(QfolioError, match=r"checkpoint\.safetensors"):
        Run.open(tmp_path / "run")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 0, "version": "0.0.1"}, "written by qfolio 0.0.1"),
        ({"task": "os:system"}, "no task 'os:system'"),
        ({"agent": "dqm"}, "did you mean dqn"),
        ({"seeds": "many"}, "damaged"),
        ({"seeds": -1}, "damaged"),
        ({"seed": 2**32 - 1, "seeds": 2}, "damaged"),
        ({"preset": ["x"]}, "damaged"),
        ({"device": None}, "damaged"),
        ({"task_settings": {"horizon": 3e9}}, "horizon"),
        ({"agent_settings": {"hidden": [0]}}, "hidden"),
        ({"agent_settings": {"hidden": [10**9, 10**9]}}, "memory|checkpoint"),
    ],
)
def test_refuses_configurations_that_make_no_sense(task, agent, tmp_path, change, message):
    create(task, agent, tmp_path / "run")
    path = tmp_path / "run" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(QfolioError, match=message):
        Run.open(tmp_path / "run")


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00", "[" * 100_000, "1" * 5000])
def test_refuses_damaged_configurations(task, agent, tmp_path, text):
    create(task, agent, tmp_path / "run")
    (tmp_path / "run" / "config.json").write_text(text)
    with pytest.raises(QfolioError, match="damaged"):
        Run.open(tmp_path / "run")


def test_refuses_a_folder_that_is_no_run(tmp_path):
    with pytest.raises(QfolioError, match="no run"):
        Run.open(tmp_path)


def test_never_overwrites_a_folder(task, agent, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(QfolioError, match="not empty"):
        create(task, agent, tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        {"episodes": 0}, {"seeds": 0}, {"seed": -1}, {"seed": 2**32},
        {"steps": 9}, {"episodes": None}, {"steps": 0, "episodes": None},
    ],
)  # fmt: skip
def test_refuses_counts_that_make_no_sense(task, agent, options):
    with pytest.raises(QfolioError, match=next(iter(options))):
        Run.create(task, agent, **{"episodes": 1, **options})


def test_training_without_a_folder_writes_nothing(task, agent, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = train(task, agent, episodes=2)
    assert run.episodes == 2
    assert list(tmp_path.iterdir()) == []
    assert jax.tree.leaves(run.first_weights())
