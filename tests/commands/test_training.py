import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from qfolio.commands.training import _train
from qfolio.core.files import locked
from qfolio.experiments.budget import Budget
from qfolio.experiments.executor import Here
from qfolio.experiments.machines import rays
from qfolio.experiments.run import Run

from jobs import Elsewhere
from listeners import Interrupt
from shell import TINY, qfolio


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run folder, made by the command as a user types it."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    command = [sys.executable, "-m", "qfolio", "train", "pendulum", "--episodes", "8",
               "--seeds", "2", "--out", str(folder), *TINY]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_help_does_not_import_what_is_slow():
    code = (
        "import sys; sys.argv = ['qfolio', '--help']\n"
        "from qfolio.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "slow = {'jax', 'matplotlib', 'gymnasium', 'equinox', 'PIL'} & sys.modules.keys()\n"
        "assert not slow, slow"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_train_writes_the_whole_folder(run):
    folder, printed = run
    assert {path.name for path in folder.iterdir()} == {
        "config.json", "metrics.csv", "evaluation.csv", "checkpoint.safetensors",
        "policy.safetensors", "summary.json", "learning_curve.png", "value.png", "episode.gif",
        "report.html", "contrast", "events.jsonl",
    }  # fmt: skip
    header, *rows = (folder / "metrics.csv").read_text().splitlines()
    assert header == "seed,episode,return,epsilon,loss,max_q"
    assert len(rows) == 16
    assert str(folder / "report.html") in printed
    assert "An interval over seeds needs a run with 5 seeds or more; 2 are too few." in printed


def test_evaluate_prints_json(run, monkeypatch, capsys):
    folder, _ = run
    assert qfolio(monkeypatch, "evaluate", folder, "--episodes", "32", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["starts"] == 32
    assert len(result["return_per_seed"]) == 2
    assert result["return_ci95"] is None  # of two seeds
    assert result["return_mean"] <= result["optimum"] < 0


def test_evaluate_agrees_with_the_summary(run, monkeypatch, capsys):
    folder, _ = run
    assert qfolio(monkeypatch, "evaluate", folder, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    summary = json.loads((folder / "summary.json").read_text())
    np.testing.assert_allclose(result["return_per_seed"], summary["return_per_seed"], rtol=1e-6)


def test_resume_goes_on(run, monkeypatch, capsys):
    folder, _ = run
    assert qfolio(monkeypatch, "train", "--resume", folder, "--episodes", "12") == 0
    assert json.loads((folder / "summary.json").read_text())["episodes"] == 12
    assert len((folder / "metrics.csv").read_text().splitlines()) == 1 + 24
    assert "Nothing is left" not in capsys.readouterr().out
    assert qfolio(monkeypatch, "train", "--resume", folder) == 0
    out = capsys.readouterr().out
    assert "Nothing is left to train: each seed has had 12 episodes already" in out
    assert f"Report: {folder}" in out
    assert qfolio(monkeypatch, "train", "--resume", folder, "--steps", "1") == 0
    out = capsys.readouterr().out
    assert "Nothing is left to train" in out
    assert "become" not in out
    assert qfolio(monkeypatch, "train", "--resume", folder, "--steps", "481") == 0
    assert re.search(r"481 steps become 48\d: DQN takes 1 step in each of", capsys.readouterr().out)


def test_watch_without_a_display_writes_a_gif(run, monkeypatch, capsys):
    folder, _ = run
    (folder / "episode.gif").unlink()
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert qfolio(monkeypatch, "watch", folder) == 0
    assert (folder / "episode.gif").read_bytes()[:3] == b"GIF"


def test_watch_opens_a_window(run):
    """In SDL's dummy driver, which draws everything and shows nothing."""
    folder, _ = run
    done = subprocess.run(
        [sys.executable, "-m", "qfolio", "watch", str(folder), "--episodes", "1"],
        capture_output=True, text=True, env={**os.environ, "SDL_VIDEODRIVER": "dummy"},
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
def test_live_shows_episodes_while_training(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "qfolio", "train", "--live", "--no-compare", "--episodes", "4",
         "--seeds", "1", "--out", str(tmp_path / "run"), *TINY],
        capture_output=True, text=True, env={**os.environ, "SDL_VIDEODRIVER": "dummy"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "run" / "contrast").exists()


def test_live_shows_no_other_task_that_is_resumed(monkeypatch, capsys, tmp_path):
    options = ["--episodes", "4", "--seeds", "1", "--no-compare", "--out", tmp_path / "run"]
    assert qfolio(monkeypatch, "train", "finite/cliff", *options) == 0
    monkeypatch.setattr("qfolio.commands.training._window", lambda live: nullcontext(print))
    assert qfolio(monkeypatch, "train", "--resume", tmp_path / "run", "--live") == 2
    assert "there is nothing to see of finite/cliff" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "tune", "compare", "backtest", "study"])
def test_no_cluster_is_asked_for_workers_if_the_results_have_no_place(
    command, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(os, "access", lambda place, mode: place != tmp_path)
    monkeypatch.setattr(rays, "Ray", None)
    assert qfolio(monkeypatch, command, "--on", "ray", "--out", tmp_path / "run") == 2
    assert capsys.readouterr().err == (
        f"qfolio: Nothing can be written to {tmp_path}; name a folder elsewhere with --out.\n"
    )


@pytest.mark.parametrize("begun", [True, False])
def test_progress_here_is_that_of_groups_of_seeds_where_a_run_has_some(begun):
    listeners: dict[str, Any] = {}
    run: Any = SimpleNamespace(
        groups=SimpleNamespace(begun=begun),
        task=SimpleNamespace(optimum=lambda: None),
        train=lambda budget, these=(), **others: listeners.update(others, these=these),
    )
    _train(run, Budget(4), Here())
    assert ("listen" in listeners) == begun
    assert bool(listeners["these"]) != begun


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "pendulom"], "did you mean pendulum"),
        (["train", "--preset", "fats"], "no preset 'fats'"),
        (["train", "--agent", "dqm"], "did you mean dqn"),
        (["train", "--set", "learning_rat=1"], "did you mean learning_rate"),
        (["train", "--set", "discount=2"], "between 0 and 1"),
        (["train", "--set", "discount"], "name=value"),
        (["train", "--set", "torques=1"], "from 2 to 1001"),
        (["train", "--set", "replay_capacity=99999999999"], "replay_capacity|memory"),
        (["train", "--set", "hidden=100000,100000"], "GiB of memory"),
        (["train", "--episodes", "0"], "episodes is 0"),
        (["train", "--seeds", "-1"], "seeds is -1"),
        (["train", "--seeds", "9999999999"], "seeds is 9999999999"),
        (["train", "--set", "horizon=3e9"], "horizon is 3000000000"),
        (["train", "--set", "learning_rate=inf"], "learning_rate is inf"),
        (["train", "--resume", "nowhere"], "nowhere is no run"),
        (["evaluate", "nowhere"], "nowhere is no run"),
        (["evaluate", "nowhere", "--episodes", "0"], "must be from 1 to"),
        (["watch", "nowhere"], "nowhere is no run"),
        (["watch", "nowhere", "--episodes", "0"], "must be from 1 to"),
    ],
)
def test_wrong_input_gets_one_sentence_and_code_2(
    monkeypatch, capsys, tmp_path, arguments, message
):
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert error.count("\n") == 1
    assert list(Path().iterdir()) == []


def test_without_arguments_it_shows_the_help(monkeypatch, capsys):
    assert qfolio(monkeypatch) == 0
    assert "backtest" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["trian"], ["train", "--episodes", "many"]])
def test_what_the_parser_refuses_is_code_2_too(monkeypatch, capsys, arguments):
    assert qfolio(monkeypatch, *arguments) == 2


@pytest.mark.parametrize(
    "ignored", [["--set", "discount=0.5"], ["--seed", "7"], ["--preset", "best"], ["pendulum"]]
)
def test_resume_refuses_what_it_would_ignore(run, monkeypatch, capsys, ignored):
    folder, _ = run
    assert qfolio(monkeypatch, "train", *ignored, "--resume", folder) == 2
    assert "--resume keeps" in capsys.readouterr().err


@pytest.mark.parametrize("episodes", [0, -3])
def test_resume_refuses_no_episodes_and_leaves_the_run_alone(run, monkeypatch, capsys, episodes):
    folder, _ = run
    before = (folder / "config.json").read_text()
    assert qfolio(monkeypatch, "train", "--resume", folder, "--episodes", episodes) == 2
    assert (folder / "config.json").read_text() == before


def test_resume_finishes_a_contrast_that_was_interrupted(run, monkeypatch, capsys):
    folder, _ = run
    shutil.rmtree(folder / "contrast")
    (folder / "report.html").unlink()
    assert qfolio(monkeypatch, "train", "--resume", folder) == 0
    assert (folder / "contrast" / "checkpoint.safetensors").exists()
    assert (folder / "report.html").exists()
    assert not (folder / "contrast" / "contrast").exists()


def test_a_contrast_that_cannot_be_trained_costs_nothing_but_itself(
    run, monkeypatch, capsys, tmp_path
):
    folder = shutil.copytree(run[0], tmp_path / "run")
    steps = json.loads((folder / "summary.json").read_text())["env_steps"] + 40
    with locked(folder / "contrast"):
        assert qfolio(monkeypatch, "train", "--resume", folder, "--steps", steps) == 0
    printed = capsys.readouterr().out
    assert re.search(r"contrast is left out\. .*contrast is in use by process", printed)
    assert f"Report: {folder}" in printed
    assert json.loads((folder / "summary.json").read_text())["env_steps"] == steps
    before = (folder / "report.html").read_bytes()
    assert qfolio(monkeypatch, "report", folder) == 0
    assert (folder / "report.html").read_bytes() == before


def test_a_contrast_that_was_stopped_in_groups_goes_on_to_the_new_budget(
    run, monkeypatch, capsys, tmp_path
):
    """It was refused the new budget until somebody finished the earlier one by hand."""
    folder = shutil.copytree(run[0], tmp_path / "run")
    contrast = Run.open(folder / "contrast")
    steps = contrast.done("steps") + 40
    contrast.train(
        Budget(steps=steps), executor=Elsewhere(), listen=lambda job, done, share: [Interrupt()]
    )
    assert contrast.groups.begun  # the first seed is trained
    assert qfolio(monkeypatch, "train", "--resume", folder, "--steps", steps + 40) == 0
    assert "left out" not in capsys.readouterr().out
    done = [Run.open(place).done("steps") for place in (folder, folder / "contrast")]
    assert done == [steps + 40] * 2


OWN = """
import jax.numpy as jnp
from qfolio.core.mdp import Step
from qfolio.tasks.catch import Catch

class Failing(Catch):
    def step(self, state, action, key):
        return {}["price"]

class Short(Catch):
    def step(self, state, action, key):
        return Step(state._replace(row=1.0), 1.0, False)
"""


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Failing", "qfolio: step failed: KeyError: 'price' (failing_parts.py, line 8)."),
        ("Short", "qfolio: Short.step returns float32[] as state at .row; it must be int32[], "),
    ],
)
def test_faults_of_own_code_are_one_sentence(name, says, tmp_path, monkeypatch, capsys):
    """With the place in the user's file; nothing is left behind."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "failing_parts.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert (
        qfolio(monkeypatch, "train", f"failing_parts:{name}", "--agent", "dqn", "--out", "x") == 2
    )
    assert says in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "x").exists()
    sys.modules.pop("failing_parts", None)


PRICED = """
from qfolio.core.fields import static
from qfolio.core.mdp import Task
from qfolio.tasks.finite import Cliff

class Priced(Task):
    price: float
    horizon: int = static(9)
    cliff = Cliff()
    states, actions = cliff.states, cliff.actions

    def reset(self, key):
        return self.cliff.reset(key)

    def observe(self, state):
        return self.cliff.observe(state)

    def step(self, state, action, key):
        after = self.cliff.step(state, action, key)
        return after._replace(reward=self.price * after.reward)
"""


def test_a_setting_without_a_default_is_in_the_commands_that_repeat_the_training(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "priced_parts.py").write_text(PRICED)
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["priced_parts:Priced", "--agent", "q-learning", "--steps", 90, "--set", "price=2"]
    assert qfolio(monkeypatch, "train", *words, "--seeds", 1, "--out", "run") == 0
    assert "--set price=2.0\n" in (tmp_path / "run" / "report.html").read_text()
    assert capsys.readouterr().out.startswith("Q-learning on priced_parts:Priced · preset fast · ")
    assert qfolio(monkeypatch, "tune", *words, "--search", "discount=0.5|0.9", "--trials", 2,
                  "--seeds", 1, "--out", "search") == 0  # fmt: skip
    printed = capsys.readouterr().out
    assert printed.startswith("Q-learning on priced_parts:Priced · preset fast · 2 trials × 1 seed")
    assert re.search(r"^qfolio train .* --set .*price=2\.0$", printed, re.MULTILINE)
    assert qfolio(monkeypatch, "train", *words[:-2], "--out", "x") == 2
    assert "Priced needs price; give price a default" in capsys.readouterr().err
    sys.modules.pop("priced_parts", None)
