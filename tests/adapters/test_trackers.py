"""Trackers: TensorBoard itself, and stand-ins for the two that have init, log and finish."""

import json
import os
import sys
import types
from pathlib import Path

import pytest

from qfolio.adapters.trackers import trackers
from qfolio.core.errors import QfolioError
from qfolio.experiments.events import read
from qfolio.experiments.log import Log, Tracker, tracked

from shell import TINY, qfolio


@pytest.fixture
def heard(monkeypatch):
    """What stand-ins for wandb and trackio are told."""
    told: list[tuple[str, object]] = []
    for name in ("wandb", "trackio"):
        module = types.ModuleType(name)
        module.init = lambda **given: told.append(("init", given))  # type: ignore[attr-defined]
        module.log = lambda values: told.append(("log", values))  # type: ignore[attr-defined]
        module.finish = lambda: told.append(("finish", None))  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, name, module)
    return told


def train(folder):
    folder.mkdir(exist_ok=True)
    with Log(folder).opened(kind="run", agents=["dqn"]) as log:
        log.job().record(10, {"loss": [1.0, 3.0]})
        log.job("a").record(20, {"loss": [5.0, None]})


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_init_log_and_finish(heard, tmp_path, monkeypatch, name):
    monkeypatch.delenv("WANDB_MODE", raising=False)
    with tracked(*trackers([name, name])):
        train(tmp_path / "mine")
    about = {"kind": "run", "agents": ["dqn"]}
    assert heard == [
        ("init", {"project": "qfolio", "name": "mine", "config": about}),
        ("log", {"loss": 2.0, "steps": 10}),
        ("log", {"a/loss": 5.0, "steps": 20}),
        ("finish", None),
    ]
    assert os.environ["WANDB_MODE"] == "offline"


def test_a_user_decides_whether_wandb_is_online(heard, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "online")
    trackers(["wandb"])
    assert os.environ["WANDB_MODE"] == "online"


def test_keys_stay_out_of_the_folder(heard, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_API_KEY", "very-secret")
    with tracked(*trackers(["wandb"])):
        train(tmp_path / "mine")
    written = b"".join(path.read_bytes() for path in (tmp_path / "mine").rglob("*.*"))
    assert b"mine" not in written
    assert b"very-secret" not in written
    assert "very-secret" not in str(heard)


def test_tensorboard_gets_every_record(tmp_path):
    from tensorboardX.proto.event_pb2 import Event

    with tracked(*trackers(["tensorboard"])):
        train(tmp_path / "mine")
    (file,) = (tmp_path / "mine" / "tensorboard").iterdir()
    content, scalars = file.read_bytes(), []
    while content:  # length, its checksum, the event, its checksum
        length = int.from_bytes(content[:8], "little")
        event = Event.FromString(content[12 : 12 + length])
        scalars += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
        content = content[16 + length :]
    assert scalars == [("loss", 10, 2.0), ("a/loss", 20, 5.0)]


def test_tensorboard_is_up_to_date_after_each_job(monkeypatch, tmp_path):
    """Ctrl-C may end what follows."""
    told: list[str] = []

    class Writer:
        def __init__(self, folder):
            told.append(folder)

        def flush(self):
            told.append("flush")

        def close(self):
            told.append("close")

    module = types.SimpleNamespace(SummaryWriter=Writer)
    monkeypatch.setitem(sys.modules, "tensorboardX", module)
    with tracked(*trackers(["tensorboard"])), Log(tmp_path).opened(kind="run") as log:
        log.write("running", job="a")
        for event in ("done", "stopped", "failed"):
            log.write(event, job="a", error="")
    assert told == [str(tmp_path / "tensorboard"), "flush", "flush", "flush", "close"]


def test_tensorboard_needs_a_folder():
    with (
        pytest.raises(QfolioError, match="set one with out"),
        tracked(*trackers(["tensorboard"])),
        Log(None).opened(kind="run"),
    ):
        pass


@pytest.mark.parametrize(
    ("name", "module", "package"),
    [("tensorboard", "tensorboardX", "qfolio[track]"), ("wandb", "wandb", "wandb"),
     ("trackio", "trackio", "trackio")],
)  # fmt: skip
def test_a_missing_package_is_named(monkeypatch, name, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(QfolioError) as raised:
        trackers([name])
    assert f'pip install "{package}"' in str(raised.value)


class Failing(Tracker):
    """Breaks at the second record."""

    def start(self, folder, about):
        self.logged = 0

    def log(self, values, step):
        self.logged += 1
        if self.logged == 2:
            raise ConnectionError("no network")


def test_a_tracker_that_fails_is_left_out(tmp_path):
    failing = Failing()
    with tracked(failing), Log(tmp_path).opened() as log:
        log.job().record(1, {"loss": [1.0]})
        with pytest.warns(UserWarning, match=r"The tracker Failing is left out: .*no network"):
            log.job().record(2, {"loss": [1.0]})
        log.job().record(3, {"loss": [1.0]})
    assert failing.logged == 2
    assert [event["event"] for event in read(tmp_path / "events.jsonl")[0]].count("record") == 3


class Broken(Tracker):
    """Breaks at the start or at the end."""

    def __init__(self, place):
        self.place, self.heard = place, []

    def start(self, folder, about):
        self.call("start")

    def log(self, values, step):
        self.call("log")

    def finish(self):
        self.call("finish")

    def call(self, place):
        self.heard.append(place)
        if place == self.place:
            raise OSError("No space left on device")


@pytest.mark.parametrize(
    ("place", "heard"), [("start", ["start"]), ("finish", ["start", "log", "finish"])]
)
def test_a_tracker_that_fails_at_either_end_stops_nothing(tmp_path, place, heard):
    broken, other = Broken(place), Broken("nowhere")
    with (
        pytest.warns(UserWarning, match=r"The tracker Broken is left out: .*No space left"),
        tracked(broken, other),
        Log(tmp_path).opened() as log,
    ):
        log.job().record(1, {"loss": [1.0]})
    assert (broken.heard, other.heard) == (heard, ["start", "log", "finish"])
    assert read(tmp_path / "events.jsonl")[0][-1]["state"] == "done"


class Unmade(Tracker):
    def __init__(self):
        raise RuntimeError("no key")


def test_a_tracker_that_cannot_be_made_is_named():
    with pytest.raises(QfolioError, match=r"Unmade cannot be made without arguments: .*no key"):
        trackers([f"{__name__}:Unmade"])


OWN = """
from pathlib import Path
import qfolio

class Mine(qfolio.Tracker):
    def start(self, folder, about):
        self.file = (Path(folder) / "mine.txt").open("a")
        print(about["task"], *about["agents"], file=self.file)

    def log(self, values, step):
        print(step, sorted(values), file=self.file)

    def finish(self):
        self.file.close()

class Needy(qfolio.Tracker):
    def __init__(self, key):
        pass
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "tracking.py").write_text(OWN)
    yield
    sys.modules.pop("tracking", None)


@pytest.mark.slow
def test_a_tracker_of_ones_own_on_the_command_line(own, monkeypatch, tmp_path):
    words = ["train", "--episodes", 8, "--no-compare", "--out", "run", *TINY]
    assert qfolio(monkeypatch, *words, "--track", "tracking:Mine") == 0
    first, *rest = Path("run/mine.txt").read_text().splitlines()
    assert first == "pendulum dqn"
    assert any("'return'" in line for line in rest)
    assert any("'greedy return'" in line for line in rest)


@pytest.mark.slow
def test_a_tracker_that_prints_does_not_break_the_document(own, monkeypatch, capsys):
    Path("talking.py").write_text(
        "import qfolio\nclass Loud(qfolio.Tracker):\n    def finish(self):\n        print('bye')\n"
    )
    words = ["train", "--episodes", 8, "--no-compare", "--out", "run", *TINY, "--json"]
    assert qfolio(monkeypatch, *words, "--track", "talking:Loud") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["agent"] == "dqn"
    assert "bye" in err
    events, _ = read(Path("run/events.jsonl"))
    assert [event["event"] for event in events[-2:]] == ["result", "end"]


@pytest.mark.parametrize(
    ("name", "message"),
    [("tracking:Needy", "cannot be made without arguments"), ("nothing", "there is no tracker"),
     ("tracking:Path", "no class Path that inherits"), ("tensorbord", "tensorboard")],
)  # fmt: skip
def test_a_name_of_no_tracker_is_refused_before_anything_is_written(
    own, monkeypatch, capsys, tmp_path, name, message
):
    assert qfolio(monkeypatch, "train", "--out", "run", "--track", name) == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
    assert not Path("run").exists()
