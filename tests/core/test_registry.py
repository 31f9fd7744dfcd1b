"""Names become classes: qfolio's, those of installed packages, and a user's own."""

import sys
from pathlib import Path

import pytest

from qfolio.agents.dqn import DQN
from qfolio.core import registry
from qfolio.core.errors import QfolioError
from qfolio.tasks.catch import Catch

OWN = """
from qfolio.agents.dqn import DQN
from qfolio.core.mdp import Task
from qfolio.portfolio.rewards import Reward
from qfolio.tasks.catch import Catch

class Flat(Reward):
    def __call__(self, outcome): return 0.0, None
class Mine(Catch): pass
class Half(Task):
    def reset(self, key): ...
class Learner(DQN): pass
number = 7
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module in the current directory, forgotten at the end."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    (tmp_path / "own_parts.py").write_text(OWN)
    (tmp_path / "qfolio_parts.py").write_text(OWN)
    (tmp_path / "broken_parts.py").write_text("import math\n\nmath.nothing\n")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "__init__.py").write_text("1 / 0\n")
    yield "own_parts"
    for name in ("own_parts", "qfolio_parts", "broken_parts"):
        sys.modules.pop(name, None)


@pytest.fixture
def installed(own, tmp_path):
    """A package with entry points, beside the module that they name."""
    place = tmp_path / "parts-1.0.dist-info"
    place.mkdir()
    (place / "METADATA").write_text("Metadata-Version: 2.1\nName: parts\nVersion: 1.0\n")
    (place / "entry_points.txt").write_text(
        "[qfolio.tasks]\nmy-catch = own_parts:Mine\n[qfolio.agents]\nlearner = own_parts:Learner\n"
    )
    sys.path.append(str(tmp_path))


def test_a_class_in_the_current_directory(own):
    mine = registry.find("task", "own_parts:Mine")
    assert issubclass(mine, Catch)
    assert registry.name_of(mine()) == "own_parts:Mine"
    assert isinstance(registry.build("task", "own_parts:Mine", {"rows": 6}), mine)
    assert registry.own_modules(mine(), Catch(), DQN()) == ["own_parts"]
    assert registry.short("own_parts:Mine") == "Mine"
    assert sys.path[-1] == str(Path.cwd())  # behind the libraries


@pytest.mark.parametrize(
    ("entry", "agent", "preset", "entrant"),
    [
        ("dqn", "dqn", "", "dqn"),
        ("dqn:fast", "dqn", "fast", "dqn:fast"),
        ("own_parts:Learner", "own_parts:Learner", "", "Learner"),
        ("own_parts:Learner:fast", "own_parts:Learner", "fast", "Learner:fast"),
    ],
)
def test_an_entry_is_an_agent_and_perhaps_its_preset(entry, agent, preset, entrant):
    assert registry.parted(entry) == (agent, preset)
    assert registry.entrant(entry) == entrant


def test_an_environment_of_gymnasium_is_named_by_its_id():
    task = type("GymnasiumTask", (), {"__module__": "qfolio.tasks.gymnasium", "id": "CartPole-v1"})
    assert registry.name_of(task()) == "gym:CartPole-v1"
    assert registry.short("gym:own_parts:Hopper-v0") == "gym:own_parts:Hopper-v0"


def test_work_is_resumed_with_the_modules_and_the_place_that_it_needs(own):
    mine, run = registry.find("task", "own_parts:Mine")(), Path("run")
    command = "qfolio train --resume"
    assert registry.again(command, run, mine, DQN()) == f"{command} run --trust own_parts"
    assert registry.again(command, run, DQN(), on="gpu") == f"{command} run --on gpu"


@pytest.mark.parametrize(
    ("kind", "name", "says"),
    [
        ("task", "own_parts:Missing", "own_parts has no class Missing that inherits from .*Task"),
        ("task", "own_parts:number", "own_parts has no class number"),
        ("task", "own_parts:Learner", "own_parts has no class Learner that inherits from .*Task"),
        ("agent", "own_parts:Mine", "there is no agent 'own_parts:Mine'"),
        ("agent", "tilts:low-risk", "'tilts:low-risk'; set agent to tilts and preset to low-risk."),
        ("task", "own_parts:Half", "is not complete: it lacks actions, horizon, observe, step"),
        ("reward", "own_parts:Flat",
         "Flat.__call__ must be a method that takes self, state and outcome."),
        ("task", "own_parts:make.<locals>.Mine",
         r"a class within a function, .*, or pass the task, as in .*Run.open\(folder, task=…"),
        ("task", "elsewhere:Mine", "a module elsewhere is neither installed nor in this folder"),
        ("task", "broken_parts:Mine", r"broken_parts cannot be imported: AttributeError: .*"
                                      r"\(broken_parts.py, line 3\)"),
        ("task", "broken.parts:Mine",
         r"broken\.parts cannot be imported: ZeroDivisionError: division by zero"),
        ("task", "market/kely", r"did you mean market/kelly\?"),
        ("task", "markt/kelly", r"did you mean market/kelly\?"),
        ("task", "market/foo", "choose from market/kelly, .*, market/leverage, market/liquidation"),
        ("task", "finite/foo", "choose from finite/cliff, finite/frozen-lake, finite/random"),
        ("agent", "market/foo", "choose from dqn"),
        ("agent", "dqm", "did you mean dqn"),
        ("agent", "dqm:fast", "did you mean dqn"),
        ("agent", "nothing like it", "your own as module:Name"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(own, kind, name, says):
    with pytest.raises(QfolioError, match=says):
        registry.find(kind, name)


def test_a_folder_runs_no_code_that_nobody_else_names(own):
    for name in ("own_parts:Mine", "broken_parts:Mine"):
        with pytest.raises(QfolioError, match=f"add --trust {name.partition(':')[0]} "):
            registry.build("task", name, {})
    with pytest.raises(QfolioError, match="add --trust own_parts "):
        registry.build("task", "gym:own_parts:X-v0", {"id": "own_parts:X-v0"})
    assert not {"own_parts", "broken_parts"} & set(sys.modules)
    registry.trust(["own_parts"])
    assert isinstance(registry.build("task", "own_parts:Mine", {}), Catch)
    for name in ("os:system", "own_parts:number"):
        with pytest.raises(QfolioError, match=f"there is no task '{name}'"):
            registry.build("task", name, {})


def test_a_module_whose_name_only_begins_like_qfolios_is_not_trusted(own):
    with pytest.raises(QfolioError, match="add --trust qfolio_parts "):
        registry.build("task", "qfolio_parts:Mine", {})
    assert "qfolio_parts" not in sys.modules
    mine = registry.find("task", "qfolio_parts:Mine")()
    assert registry.own_modules(mine) == ["qfolio_parts"]


def test_installed_packages_need_no_trust(installed):
    assert isinstance(registry.build("task", "my-catch", {}), Catch)
    assert registry.name_of(registry.find("agent", "learner")()) == "learner"
    with pytest.raises(QfolioError, match="did you mean my-catch"):
        registry.find("task", "my-catsh")


def test_qfolios_own_names_stay_qfolios(installed, tmp_path):
    (tmp_path / "parts-1.0.dist-info" / "entry_points.txt").write_text(
        "[qfolio.agents]\ndqn = own_parts:Learner\n"
    )
    assert registry.find("agent", "dqn") is DQN
