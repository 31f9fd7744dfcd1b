import pytest

from qfolio.core import settings
from qfolio.core.registry import find
from qfolio.experiments.presets import PRESETS
from qfolio.experiments.run import Run

MARKETS = [(task, agent) for task, agent in PRESETS if task.startswith("market/")]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "agent"), MARKETS)
def test_every_seed_is_within_a_percent_of_the_optimum(task, agent):
    preset = PRESETS[task, agent]["fast"]
    market = settings.build(find("task", task), preset.task)
    run = Run.create(market, preset.build(), episodes=preset.episodes, seeds=2, seed=100)
    run.train()
    result = run.grade()
    assert max(result["regret_per_seed"]) <= 0.01
    tolerance = {"market/no-trade": (0.03, 0.0), "market/garleanu-pedersen": (0.0, 0.03)}.get(task)
    if tolerance is not None:
        exact = result["rule"]["exact"]
        absolute, relative = tolerance
        for learned in result["rule"]["per_seed"]:
            assert learned == pytest.approx(exact, abs=absolute, rel=relative)
