"""What the bars of the commands show."""

from types import SimpleNamespace
from typing import Any

import pytest

from qfolio.commands.progress import JobsProgress
from qfolio.experiments.budget import Budget
from qfolio.experiments.fit import Training
from qfolio.experiments.records import Records


def test_a_resumed_experiment_shows_the_share_of_the_whole():
    """Half of it is finished, and of the next job, a quarter of the whole, 60%."""
    shown: list[dict[str, Any]] = []
    progress = JobsProgress(lambda **now: shown.append(now))
    job: Any = SimpleNamespace(name="dqn/1")
    (listener,) = progress(job, 0.5, 0.25)
    training = Training(None, Budget(9), begun=60, left=40)
    listener.on_start(training)
    progress.begun -= 10  # seconds, in which it does a twentieth of the whole
    training.done, training.left, training._learned = 20, 20, 20
    listener.on_chunk(training, Records())
    assert [now["completed"] for now in shown] == pytest.approx([0.65, 0.7])
    assert [now["description"] for now in shown] == ["dqn  – left", "dqn  0:01:00 left"]
