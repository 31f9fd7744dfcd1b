"""The main promise, on the real task: every seed near the exact optimum."""

import numpy as np
import pytest

from qfolio.experiments.presets import preset
from qfolio.experiments.run import train
from qfolio.tasks.pendulum import Pendulum


@pytest.mark.optimized
def test_the_fast_preset_comes_near_the_optimum():
    chosen = preset("fast")
    run = train(Pendulum(), chosen.build(), episodes=chosen.episodes, seeds=4, seed=100)
    regrets = run.grade()["regret_per_seed"]
    assert max(regrets) <= 0.05, regrets
    assert min(regrets) > -0.005, "nothing beats the optimum"


@pytest.mark.optimized
def test_report_preset_learns_in_90_episodes():
    """Where the plain algorithm is at its best (docs/algorithms/dqn.md: until 600)."""
    run = train(Pendulum(), preset("report").build(), episodes=90, seeds=2, seed=100)
    assert np.mean(run.grade()["regret_per_seed"]) < 0.15
