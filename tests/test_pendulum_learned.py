"""The main promise, on the real task: every seed near the exact optimum."""

import numpy as np
import pytest

from qfolio.presets import preset
from qfolio.runs import train
from qfolio.tasks.pendulum import Pendulum


@pytest.mark.slow
def test_fast_preset_comes_within_5_percent_of_the_optimum():
    fast = preset("fast")
    run = train(Pendulum(), fast.build(), episodes=fast.episodes, seeds=4, seed=100)
    regrets = run.grade()["regret_per_seed"]
    assert max(regrets) <= 0.05, regrets
    assert min(regrets) > -0.005, "nothing beats the optimum"


@pytest.mark.slow
def test_report_preset_learns_in_90_episodes():
    """Where the plain algorithm is at its best; docs/dqn.md says what happens until 600."""
    run = train(Pendulum(), preset("report").build(), episodes=90, seeds=4, seed=100)
    assert np.mean(run.grade()["regret_per_seed"]) < 0.15
