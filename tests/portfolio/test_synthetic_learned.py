import pytest

from qfolio.core import settings
from qfolio.core.registry import find
from qfolio.experiments.presets import PRESETS
from qfolio.experiments.run import Run

MARKETS = [(task, agent) for task, agent in PRESETS if task.startswith("market/")]


TOLERANCE = {
    "market/no-trade": (0.02, 0.0),
    "market/garleanu-pedersen": (0.0, 0.03),
    "market/liquidation": (0.03, 0.0),
}
"""Of each number of a learned rule, absolute and relative."""


@pytest.mark.optimized
@pytest.mark.parametrize(("task", "agent"), MARKETS)
def test_each_preset_is_within_a_percent_of_the_optimum(task, agent):
    preset = PRESETS[task, agent]["fast"]
    market = settings.build(find("task", task), preset.task)
    run = Run.create(market, preset.build(), budget=preset.budget, seeds=1, seed=100)
    run.train()
    result = run.grade()
    assert result["regret_per_seed"][0] <= 0.01
    tolerance = TOLERANCE.get(task)
    if tolerance is not None:
        exact = result["rule"]["exact"]
        absolute, relative = tolerance
        (learned,) = result["rule"]["per_seed"]
        assert learned == pytest.approx(exact, abs=absolute, rel=relative)


@pytest.mark.optimized
@pytest.mark.parametrize(
    ("fraction", "cost", "steps", "cash_rate"),
    [
        (0.1, 0.0025, 252, 0.0),
        (0.9, 0.03, 52, 0.0),
        pytest.param(0.5, 0.01, 12, 0.03, marks=pytest.mark.long),
    ],
)
def test_the_no_trade_region_is_found_wherever_it_is(fraction, cost, steps, cash_rate):
    """The best weight without costs, the cost, steps a year, and what cash earns."""
    preset = PRESETS["market/no-trade", "pathwise"]["fast"]
    market = find("task", "market/no-trade")(
        rate=fraction * 0.2**2, cost=cost, dt=1 / steps, cash_rate=cash_rate
    )
    run = Run.create(market, preset.build(), episodes=preset.episodes, seeds=1, seed=100)
    run.train()
    result = run.grade()
    assert result["regret_per_seed"][0] <= 0.01
    (learned,) = result["rule"]["per_seed"]
    assert learned == pytest.approx(result["rule"]["exact"], abs=0.02)


@pytest.mark.optimized
@pytest.mark.parametrize("risk_aversion", [1.0, 4.0])
def test_borrowing_and_lending_are_found(risk_aversion):
    """Beside the preset's regime, without cash."""
    preset = PRESETS["market/leverage", "pathwise"]["fast"]
    market = find("task", "market/leverage")(risk_aversion=risk_aversion)
    run = Run.create(market, preset.build(), budget=preset.budget, seeds=1, seed=100)
    run.train()
    result = run.grade()
    assert result["regret_per_seed"][0] <= 0.01
    (learned,) = result["rule"]["per_seed"]
    assert learned["weight of cash"] * result["rule"]["exact"]["weight of cash"] > 0


@pytest.mark.optimized
@pytest.mark.parametrize("agent", ["pathwise", "dqn"])
@pytest.mark.parametrize(
    ("stay", "mean", "cost"),
    [
        ("0.9,0.98", "-0.004,0.001", 0.005),
        ("0.9,0.7", "-0.005,0.01", 0.0),
    ],
)
def test_other_regimes_are_found(agent, stay, mean, cost):
    preset = PRESETS["market/regime", agent]["fast"]
    task = {**preset.task, "stay": stay, "mean": mean, "cost": cost}
    market = settings.build(find("task", "market/regime"), task)
    run = Run.create(market, preset.build(), episodes=preset.episodes, seeds=1, seed=100)
    run.train()
    assert run.grade()["regret_per_seed"][0] <= 0.01
