"""Types are checked in every test: shapes by jaxtyping, the rest by beartype."""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

os.environ.setdefault("QFOLIO_CACHE", str(Path(__file__).parents[1] / ".cache"))
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no window on anybody's screen

with install_import_hook("qfolio", "beartype.beartype"):
    from qfolio.agents.dqn import DQN
    from qfolio.core import devices
    from qfolio.tasks.pendulum import Pendulum

devices.configure()


@pytest.fixture
def task() -> Pendulum:
    return Pendulum(horizon=25)


@pytest.fixture
def agent() -> DQN:
    """Small enough that compiling it is most of its cost."""
    return DQN(
        hidden=(16,), num_envs=2, batch_size=8, replay_capacity=200, learning_starts=20,
        episode_steps=0, learning_rate_steps=200.0,
    )  # fmt: skip
