"""The statistics of a whole backtest, from made-up track records."""

import dataclasses
import json
import math

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.statistics.assessment import Strategy
from qfolio.portfolio.backtest.statistics.bootstrap import block_length
from qfolio.portfolio.backtest.statistics.measures import MEASURES, measures
from qfolio.portfolio.backtest.statistics.sharpe import (
    expected_maximum_sharpe,
    minimum_track_record,
    probabilistic_sharpe,
)

from records import assessed, record, strategy
from tables import days


def test_assess_by_hand_on_one_block() -> None:
    rng = np.random.default_rng(9)
    weak, strong, agent = (
        strategy(rng, "baseline", 1), strategy(rng, "baseline", 1), strategy(rng, seeds=5),
    )  # fmt: skip
    strong = strong._replace(returns=np.asarray(strong.returns) + 0.01)
    everything = {"equal weight": weak, "strong": strong, "dqn": agent}
    dates = days(300, "2001-01-01")
    result = assessed(everything, dates, earlier_trials=2)
    table = measures(*record(agent), 252)
    dqn = result.strategies["dqn"]
    assert result.best_baseline == "strong"
    assert (result.first_date, result.last_date) == ("2001-01-01", "2001-10-27")
    assert result.trials == 5 + 2
    assert result.earlier_trials == 2
    for name in MEASURES:
        measure = dqn.measures[name]
        assert measure.per_seed == tuple(table[name])
        assert measure.mean == pytest.approx(table[name].mean())
        assert measure.over_seeds is not None
        margin = 2.776445 * table[name].std(ddof=1) / math.sqrt(5)  # t of 4 degrees of freedom
        assert measure.over_seeds[1] - measure.mean == pytest.approx(margin, rel=1e-5)
        assert result.strategies["strong"].measures[name].over_seeds is None
        assert measure.over_time[0] < measure.over_time[1]

    baseline = measures(*record(weak), 252)
    difference = dqn.to_reference
    assert difference is not None
    assert difference.growth.value == pytest.approx(
        np.log1p(table["growth"]).mean() - np.log1p(baseline["growth"][0])
    )
    assert difference.sharpe.value == pytest.approx(table["sharpe"].mean() - baseline["sharpe"][0])
    assert difference.volatility.value == pytest.approx(
        np.log(table["volatility"]).mean() - np.log(baseline["volatility"][0])
    )
    for contrast in difference.contrasts().values():
        assert contrast.interval[0] < contrast.value < contrast.interval[1]
        assert contrast.finding == "none"
    best = dqn.to_best_baseline
    assert best is not None
    assert best.growth.finding == "worse"
    assert result.strategies["strong"].to_best_baseline is None
    assert result.strategies["equal weight"].to_reference is None

    variance = max(float(np.var(table["sharpe"], ddof=1)) / 252, 1 / 299)
    test = dqn.sharpe_test
    needed = minimum_track_record(test.ratio / np.sqrt(252), test.skewness, test.kurtosis)
    assert test.minimum_years == pytest.approx(needed / 252)
    threshold = expected_maximum_sharpe(7, variance)
    assert test.threshold == pytest.approx(threshold * math.sqrt(252))
    sharpe = table["sharpe"].mean() / math.sqrt(252)
    assert test.deflated == pytest.approx(
        probabilistic_sharpe(sharpe, 300, test.skewness, test.kurtosis, threshold)
    )
    assert test.deflated < test.probabilistic
    alone = result.strategies["equal weight"].sharpe_test
    assert alone.deflated == alone.probabilistic  # nobody picked it from anything


def test_a_market_that_rose_is_no_skill() -> None:
    """An agent that holds the reference, give or take noise, has its Sharpe ratio, and adds 0."""
    rng = np.random.default_rng(2)
    base = strategy(rng, "baseline", 1)
    returns = np.asarray(base.returns)
    returns = 0.002 + 0.01 * (returns - returns.mean()) / returns.std()
    noise = rng.standard_normal((3, 300))
    noise -= noise.mean(axis=1, keepdims=True)
    entries = {
        "equal weight": base._replace(returns=returns),
        "dqn": strategy(rng)._replace(returns=returns + 0.001 * noise),
    }
    result = assessed(entries, days(300), resamples=10, earlier_trials=10)
    test, active = result.strategies["dqn"].sharpe_test, result.strategies["dqn"].active_test
    assert active is not None
    assert result.strategies["equal weight"].active_test is None
    assert test.ratio == pytest.approx(result.strategies["dqn"].measures["sharpe"].mean)
    assert test.deflated > 0.9
    assert active.ratio == pytest.approx(0, abs=1e-9)
    assert active.probabilistic == pytest.approx(0.5)
    assert active.deflated < 0.1
    assert active.trials == test.trials == 13


def test_skewness_and_kurtosis_by_hand() -> None:
    # One day of +3 among three of −1: variance 3, third moment 6, fourth 21.
    returns = np.tile([[0.03, -0.01, -0.01, -0.01]], 5)
    zeros = np.zeros((1, 20))
    result = assessed({"equal weight": ("baseline", returns, zeros, zeros)}, days(20), resamples=10)
    test = result.strategies["equal weight"].sharpe_test
    assert test.skewness == pytest.approx(6 / 3**1.5)
    assert test.kurtosis == pytest.approx(21 / 9)


def test_sharpe_ratios_and_their_moments_leave_out_what_cash_earns() -> None:
    """Of returns over cash: one day of +3 among three of −1, and the same with a day of +4."""
    free = np.repeat([0.0, 0.01, 0.03, 0.002], 5)
    one, other = (np.tile([[best, -0.01, -0.01, -0.01]], 5) for best in (0.03, 0.04))
    zeros = np.zeros((1, 20))
    entries = {
        "equal weight": ("baseline", one + free, zeros, zeros),
        "mine": ("strategy", other + free, zeros, zeros),
    }
    result = assessed(entries, days(20), resamples=10, risk_free=free)
    base, mine = result.strategies["equal weight"], result.strategies["mine"]
    assert base.sharpe_test.skewness == pytest.approx(6 / 3**1.5)
    assert base.sharpe_test.kurtosis == pytest.approx(21 / 9)
    assert base.sharpe_test.ratio == pytest.approx(0, abs=1e-9)
    # A mean of 0.25 over deviations of 3.75 and three of −1.25: a variance of 93.75 / 19.
    assert mine.to_reference is not None
    assert mine.to_reference.sharpe.value == pytest.approx(0.25 / (93.75 / 19) ** 0.5 * 252**0.5)


def test_interest_on_everything_changes_neither_a_ratio_nor_its_interval() -> None:
    rng = np.random.default_rng(15)
    entries = {"equal weight": strategy(rng, "baseline", 1), "dqn": strategy(rng)}
    more = {n: e._replace(returns=np.asarray(e.returns) + 0.001) for n, e in entries.items()}
    plain = assessed(entries, days(300), resamples=50).strategies["dqn"].measures
    found = assessed(more, days(300), resamples=50, risk_free=np.full(300, 0.001))
    for name in ("sharpe", "sortino"):
        measure = found.strategies["dqn"].measures[name]
        assert measure.mean == pytest.approx(plain[name].mean)
        assert measure.over_time == pytest.approx(plain[name].over_time)


def test_an_information_ratio_is_to_the_best_rebalancing() -> None:
    rng = np.random.default_rng(14)
    base, slow = strategy(rng, "baseline", 1), strategy(rng, "rebalancing", 1)
    slow = slow._replace(returns=np.asarray(base.returns) + 0.002 * rng.random(300))
    agent = strategy(rng, seeds=1)
    entries = {"equal weight": base, "equal weight at 0.1": slow, "dqn": agent}
    result = assessed(entries, days(300), resamples=10)
    active = np.asarray(agent.returns) - slow.returns
    test = result.strategies["dqn"].active_test
    assert result.rebalanced == "equal weight at 0.1"
    assert test is not None
    assert test.ratio == pytest.approx(math.sqrt(252) * active.mean() / active.std(ddof=1))
    assert test.kurtosis == pytest.approx(
        ((active - active.mean()) ** 4).mean() / active.var() ** 2
    )
    assert result.strategies["equal weight at 0.1"].active_test is None


def test_order_of_seeds_changes_nothing() -> None:
    rng = np.random.default_rng(10)
    base, agent = (
        strategy(rng, kind, seeds)._replace(weights=rng.dirichlet(np.ones(3), (seeds, 300)))
        for kind, seeds in (("baseline", 1), ("agent", 5))
    )
    order = [3, 0, 4, 2, 1]
    shuffled = Strategy("agent", *(np.asarray(values)[order] for values in agent[1:]))
    first, second = (
        assessed({"equal weight": base, "dqn": entry}, days(300)) for entry in (agent, shuffled)
    )
    one, two = ({**x.measures, **x.relative} for x in
                (first.strategies["dqn"], second.strategies["dqn"]))  # fmt: skip
    for name, measure in one.items():
        other = two[name]
        assert [measure.per_seed[seed] for seed in order] == list(other.per_seed)
        assert measure == dataclasses.replace(other, per_seed=measure.per_seed)
    for field in ("to_reference", "to_best_baseline", "sharpe_test"):
        assert getattr(first.strategies["dqn"], field) == getattr(second.strategies["dqn"], field)


def test_block_length_listens_to_the_size_of_moves() -> None:
    # Calm and wild months in turn: no return tells the next, but its size does.
    rng = np.random.default_rng(14)
    size = np.repeat(np.exp(rng.normal(0, 1, 60)), 20)
    returns = 0.01 * (size * rng.choice([-1, 1], 1200))[None]
    zeros = np.zeros_like(returns)
    entry = ("baseline", returns, zeros, zeros)
    result = assessed({"equal weight": entry}, days(1200), resamples=10)
    assert result.block_length > 15 > 2 * block_length(returns[0])


def test_many_trials_raise_the_threshold_however_alike_the_seeds_are() -> None:
    """Seeds of one agent hardly differ; a thousand other trials could still be lucky."""
    rng = np.random.default_rng(3)
    one = strategy(rng, seeds=1)
    alike = one._replace(
        returns=np.asarray(one.returns) + rng.normal(0, 1e-6, (5, 300)),
        turnover=np.repeat(record(one)[1], 5, 0),
        cost=np.repeat(record(one)[2], 5, 0),
    )
    strategies = {"equal weight": strategy(rng, "baseline", 1), "dqn": alike}
    result = assessed(strategies, days(300), earlier_trials=1000)
    threshold = result.strategies["dqn"].sharpe_test.threshold
    assert threshold == pytest.approx(math.sqrt(252) * expected_maximum_sharpe(1005, 1 / 299))
    assert threshold > 2


def test_trials_without_a_known_spread() -> None:
    rng = np.random.default_rng(15)
    strategies = {"equal weight": strategy(rng, "baseline", 1), "dqn": strategy(rng, seeds=1)}
    result = assessed(strategies, days(300), earlier_trials=9)
    threshold = result.strategies["dqn"].sharpe_test.threshold
    assert threshold == pytest.approx(math.sqrt(252) * expected_maximum_sharpe(10, 1 / 299))
    result = assessed(strategies, days(300))
    assert result.trials == 1
    assert result.strategies["dqn"].sharpe_test.threshold == 0


def test_json_of_the_worst() -> None:
    # A total loss, cash, and gains without any risk: nothing infinite reaches the file.
    zeros, gains = np.zeros((2, 30)), np.full((2, 30), 0.01)
    ruin = np.full((2, 30), 0.01)
    ruin[:, 3] = -1
    mixed = np.stack([gains[0], -gains[0]])
    strategies = {
        "equal weight": ("baseline", ruin[:1], zeros[:1], zeros[:1]),
        "cash": ("baseline", zeros[:1], zeros[:1], zeros[:1]),
        "ruin": ("agent", ruin, zeros, zeros),
        "gains": ("agent", gains, zeros, zeros),
        "mixed": ("agent", mixed, zeros, zeros),
    }
    result = assessed(strategies, days(30))
    content = json.loads(json.dumps(result.to_json(), allow_nan=False))
    ruined = content["strategies"]["ruin"]
    assert ruined["measures"]["growth"]["mean"] == -1
    assert content["strategies"]["gains"]["measures"]["sharpe"]["mean"] is None
    assert content["strategies"]["mixed"]["measures"]["sharpe"]["mean"] is None
    assert content["strategies"]["cash"]["measures"]["sharpe"]["over_time"] == [0, 0]
    assert content["best_baseline"] == "cash"
    assert ruined["to_best_baseline"]["growth"]["value"] is None  # −∞
    assert result.strategies["ruin"].to_best_baseline is not None
    assert result.strategies["ruin"].to_reference is not None
    assert ruined["to_reference"]["growth"]["value"] == 0  # both lost everything
    assert ruined["to_reference"]["growth"]["interval"] == [0, 0]  # on whichever days, together
    assert ruined["to_best_baseline"]["growth"]["interval"] == [None, None]
    assert ruined["to_best_baseline"]["growth"]["finding"] == "none"


def test_assess_is_repeatable_and_its_seed_counts() -> None:
    rng = np.random.default_rng(16)
    strategies = {"equal weight": strategy(rng, "baseline", 1), "dqn": strategy(rng)}
    first, second, third = (
        assessed(strategies, days(300), resamples=200, seed=seed) for seed in (0, 0, 1)
    )
    assert first.to_json() == second.to_json() != third.to_json()
    assert first.to_json()["strategies"]["dqn"]["seeds"] == 3


def test_few_seeds_have_no_interval() -> None:
    """Student's interval of three seeds says nothing: it spans more than their whole range."""
    rng = np.random.default_rng(9)
    base = strategy(rng, "baseline", 1)
    entries = {"equal weight": base, "four": strategy(rng, seeds=4), "five": strategy(rng, seeds=5)}
    result = assessed(entries, days(300), resamples=10)
    assert result.strategies["four"].measures["growth"].over_seeds is None
    assert len(result.strategies["four"].measures["growth"].per_seed) == 4
    assert result.strategies["five"].measures["growth"].over_seeds is not None


def refusals() -> list[tuple[dict[str, object], dict[str, object], str]]:
    good = ("baseline", np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 4)))
    flat = ("agent", np.zeros(4), np.zeros(4), np.zeros(4))
    long = ("agent", np.zeros((1, 5)), np.zeros((1, 5)), np.zeros((1, 5)))
    short = ("baseline", np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    holes = ("agent", np.full((1, 4), np.nan), np.zeros((1, 4)), np.zeros((1, 4)))
    return [
        ({}, {}, "there are: none"),
        ({"hold": good}, {}, "'equal weight' is not among the baselines.*there are: hold"),
        ({"equal weight": ("agent", *good[1:])}, {}, "not among the baselines"),
        (
            {"equal weight": good, "dqn": ("robot", *good[1:])},
            {},
            "dqn is of kind 'robot'; it must be agent or ensemble or strategy or baseline or",
        ),
        ({"equal weight": good, "dqn": flat}, {}, r"dqn have the shape \(4,\)"),
        ({"equal weight": good, "dqn": long}, {}, "same periods.*equal weight 4, dqn 5"),
        ({"equal weight": good, "dqn": holes}, {}, "returns of dqn hold missing"),
        ({"equal weight": good}, {"dates": days(3)}, "4 returns and dates of shape"),
        ({"equal weight": good}, {"dates": days(4)[::-1]}, "increase"),
        ({"equal weight": good}, {"resamples": 0}, "one resample"),
        ({"equal weight": good}, {"periods_per_year": 0.0}, "positive number of periods"),
        ({"equal weight": short}, {"dates": days(1)}, "two periods"),
    ]


@pytest.mark.parametrize(("strategies", "options", "message"), refusals())
def test_assess_refuses(
    strategies: dict[str, object], options: dict[str, object], message: str
) -> None:
    with pytest.raises(QfolioError, match=message):
        assessed(strategies, **{"dates": days(4)} | options)  # type: ignore[arg-type]
