"""The sentences of a backtest: they claim what Holm's correction allows, and no more."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics.assessment import Assessment
from qfolio.portfolio.backtest.statistics.differences import Contrast, Difference
from qfolio.portfolio.backtest.statistics.verdict import bound_sentence, luck, p_text, verdicts

from records import assessed, strategy
from tables import days


def text(sentence: str) -> str:
    return sentence.replace("\N{MINUS SIGN}", "-")


@pytest.fixture(scope="module")
def assessment() -> Assessment:
    rng = np.random.default_rng(1)
    baselines = {name: strategy(rng, "baseline", 1) for name in ("equal weight", "other")}
    return assessed({**baselines, "dqn": strategy(rng)}, days(300))


NOTHING = Contrast(0.0, (-0.1, 0.1), 0.5, 1.0, "none")


def about(reference: str = "it", **contrasts: Contrast) -> Difference:
    given: dict[str, Any] = dict.fromkeys(("growth", "sharpe", "volatility"), NOTHING)
    return Difference(reference, **{**given, **contrasts})


def contrast(finding: Any, value: float = 0.01, p: float = 0.02) -> Contrast:
    return Contrast(value, (value - 0.005, value + 0.005), p / 2, p, finding)


def said(
    assessment: Assessment,
    rebalanced: Difference | None,
    reference: Difference,
    best: Difference | None = None,
    calmest: Difference | None = None,
) -> list[str]:
    entry = dataclasses.replace(
        assessment.strategies["dqn"],
        to_reference=reference,
        to_rebalanced=rebalanced,
        to_best_baseline=best,
        to_best_sharpe=calmest,
    )
    strategies = {**assessment.strategies, "dqn": entry}
    changed = dataclasses.replace(assessment, strategies=strategies)
    return [text(sentence) for sentence in verdicts(changed)["dqn"]]


def claims_of(*arguments: Any) -> list[str]:
    return [sentence.partition(":")[0] for sentence in said(*arguments)]


def test_the_corrected_p_value_decides(assessment: Assessment) -> None:
    taken_away = about(growth=Contrast(0.008, (0.001, 0.034), 0.02, 0.0502, "none"))
    assert said(assessment, None, taken_away) == [
        "No evidence that dqn beats equal weight in growth, Sharpe ratio or volatility after "
        "costs: the difference in annual log growth from it is +0.8% (95% interval +0.1% to +3.4%; "
        "corrected p = 0.051), in Sharpe ratio 0.00 (95% interval -0.10 to +0.10; corrected "
        "p = 1.00) and in volatility 0.0% of it's (95% interval -9.5% to +10.5%; corrected "
        "p = 1.00)."
    ]
    single = dataclasses.replace(assessment, comparisons=1)
    assert "to +3.4%; p = 0.051)" in said(single, None, taken_away)[0]


def test_claims_are_plain(assessment: Assessment) -> None:
    better, worse, none = contrast("better"), contrast("worse", -0.01), about()
    both = about(growth=better, sharpe=better)
    assert claims_of(assessment, about("slow", growth=better, sharpe=better), both) == [
        "dqn beats equal weight, however it is rebalanced, in growth and Sharpe ratio after costs",
        "dqn beats equal weight in growth and Sharpe ratio after costs",
    ]
    at_every_speed = (
        "No evidence that dqn beats equal weight at every speed of rebalancing in growth, Sharpe "
        "ratio or volatility after costs"
    )
    assert claims_of(assessment, about("slow"), about(growth=better)) == [
        at_every_speed,
        "dqn beats equal weight where it is rebalanced in full with every order, which pays costs "
        "for nothing, in growth after costs",
    ]
    assert claims_of(assessment, about("equal weight"), about("equal weight", growth=better)) == [
        at_every_speed,  # although the fastest is the best: a slower one is not beaten
        "dqn beats equal weight where it is rebalanced in full with every order, in growth after "
        "costs",
    ]
    assert claims_of(assessment, about("slow", sharpe=better), both) == [
        "dqn beats equal weight, however it is rebalanced, in Sharpe ratio after costs",
        "dqn beats equal weight where it is rebalanced in full with every order, which pays costs "
        "for nothing, in growth and Sharpe ratio after costs",
    ]
    assert claims_of(assessment, none, none) == [
        "No evidence that dqn beats equal weight in growth, Sharpe ratio or volatility after costs"
    ]
    lost = about(growth=worse)
    assert claims_of(assessment, lost, none) == [
        "dqn falls short of the best rebalancing of equal weight in growth after costs, and beats "
        "it in nothing"
    ]
    mixed = about(sharpe=better, growth=worse, volatility=better)
    assert claims_of(assessment, mixed, none) == [
        "dqn beats equal weight, however it is rebalanced, in Sharpe ratio and falls short of the "
        "best rebalancing of equal weight in growth after costs, and fluctuates less"
    ]
    untested = Contrast(0.1, (0.0, 0.2))
    best = about("other", growth=better, sharpe=untested, volatility=untested)
    *_, last = said(assessment, none, none, best)
    assert last == (
        "dqn beats other in growth after costs: the difference in annual log growth from other is "
        "+1.0% (95% interval +0.5% to +1.5%; corrected p = 0.020)."
    )
    less = Contrast(-0.1, (-0.18, -0.02), 0.01, 0.02, "worse")
    calmest = about("calm", growth=untested, sharpe=less, volatility=untested)
    *_, last = said(assessment, none, none, None, calmest)
    assert last == (
        "dqn falls short of calm in Sharpe ratio after costs: the difference in Sharpe ratio from "
        "calm is -0.10 (95% interval -0.18 to -0.02; corrected p = 0.020)."
    )


def test_less_volatility_alone_is_no_victory(assessment: Assessment) -> None:
    calmer, wilder = contrast("better", -0.1), contrast("worse", 0.1)
    one = about(volatility=calmer)
    assert claims_of(assessment, one, one) == [
        "No evidence that dqn beats equal weight in growth or Sharpe ratio after costs, but it "
        "fluctuates less"
    ]
    assert claims_of(assessment, about(volatility=wilder), about())[0].endswith(
        "in growth or Sharpe ratio after costs, and it fluctuates more"
    )
    bold = about(growth=contrast("better"), volatility=wilder)
    assert claims_of(assessment, bold, about())[0] == (
        "dqn beats equal weight, however it is rebalanced, in growth after costs, and fluctuates "
        "more"
    )


def test_growing_less_is_said_first(assessment: Assessment) -> None:
    """``allocate`` repeats the first sentence when it refuses."""
    lost = about(growth=contrast("worse", -0.01))
    assert (
        claims_of(assessment, about(), lost)[0]
        == "dqn falls short of equal weight in growth after costs"
    )
    calmer = about(sharpe=contrast("better"))
    assert claims_of(assessment, calmer, lost)[0].startswith("dqn falls short of equal weight in")


def test_digits_tell_an_end_from_zero(assessment: Assessment) -> None:
    near = about(growth=Contrast(0.008, (0.00004, 0.02), 0.01, 0.01, "better"))
    assert "+0.800% (95% interval +0.004% to +2.000%;" in said(assessment, None, near)[0]
    rounding = Contrast(1e-17, (-1e-16, 3e-9), 1.0, 1.0, "none")
    (same,) = said(assessment, None, about(growth=rounding, sharpe=rounding, volatility=rounding))
    assert same.count("is 0.0% (95% interval 0.0% to 0.0%;") == 1
    assert "in Sharpe ratio 0.00 (95% interval 0.00 to 0.00;" in same
    assert "in volatility 0.0% of it's (95% interval 0.0% to 0.0%;" in same


UNKNOWN = Contrast(-math.inf, (-math.inf, math.inf), 1.0, 1.0, "none")


def test_an_interval_without_ends_is_said_as_such(assessment: Assessment) -> None:
    """As of a test with very few periods, or of one in which a ratio is all but unknown."""
    nowhere = Contrast(0.0, (-math.inf, math.inf), 1.0, 1.0, "none")
    far = dataclasses.replace(nowhere, interval=(-300.0, 300.0))
    for wide in (nowhere, far):
        (sentence,) = said(assessment, None, about(growth=nowhere, sharpe=nowhere, volatility=wide))
        assert "in annual log growth from it is 0.0% (95% interval -∞% to +∞%;" in sentence
        assert "in Sharpe ratio 0.00 (95% interval -∞ to +∞;" in sentence
        assert "in volatility 0.0% of it's (95% interval -100.0% to +∞%;" in sentence


def test_a_total_loss_is_said_without_numbers(assessment: Assessment) -> None:
    entry, lost = assessment.strategies["dqn"], about(growth=UNKNOWN)

    def said_of(*deepest: float) -> list[str]:
        measure = dataclasses.replace(entry.measures["drawdown"], per_seed=deepest)
        strategies = {
            **assessment.strategies,
            "dqn": dataclasses.replace(entry, measures={**entry.measures, "drawdown": measure}),
        }
        return said(dataclasses.replace(assessment, strategies=strategies), lost, lost)

    assert said_of(1.0) == ["dqn was wiped out: it lost everything."]
    assert said_of(0.1, 1.0, 1.0) == ["dqn was wiped out with 2 of 3 seeds: it lost everything."]
    other = about("equal weight", growth=dataclasses.replace(UNKNOWN, value=math.inf))
    assert said(assessment, None, other) == ["equal weight was wiped out, and dqn was not."]


def test_what_a_year_would_take_is_not_lost() -> None:
    """An agent that trades too much on minutes, and loses half of its money in three days."""
    market = 2e-4 * np.random.default_rng(0).standard_normal((1, 1200))
    zeros = np.zeros_like(market)
    minutes = np.datetime64("2024-01-02T09:31") + np.arange(1200, dtype="m8[m]")
    found = assessed(
        {
            "equal weight": ("baseline", market, zeros, zeros),
            "dqn": ("agent", market - 5e-4, zeros, zeros),
        },
        minutes,
        periods_per_year=252 * 390,
    )
    assert found.strategies["dqn"].measures["growth"].mean == -1  # to the last digit
    (sentence,) = verdicts(found)["dqn"]
    assert sentence.startswith("dqn falls short of equal weight in growth and Sharpe ratio after")


def test_nothing_is_times_as_volatile_as_cash(assessment: Assessment) -> None:
    wild = about("cash", growth=contrast("better"), volatility=contrast("worse", 5.4))
    (sentence,) = said(assessment, None, wild)
    assert sentence.startswith("dqn beats equal weight in growth after costs, and fluctuates more:")
    assert sentence.endswith(
        "and in Sharpe ratio 0.00 (95% interval -0.10 to +0.10; corrected p = 1.00); cash hardly "
        "fluctuates."
    )
    twice = about("cash", volatility=contrast("worse", math.log(2)))
    assert "in volatility +100.0% of cash's (95%" in said(assessment, None, twice)[0]


def test_one_reference_needs_one_sentence(assessment: Assessment) -> None:
    """As when the reference grows as much as its best rebalancing."""
    both = about(growth=contrast("better"))
    near = about(growth=contrast("better", p=0.01))
    assert claims_of(assessment, both, near) == [
        "dqn beats equal weight, however it is rebalanced, in growth after costs"
    ]


def test_the_bound_is_said_as_a_bound(assessment: Assessment) -> None:
    assert bound_sentence(assessment) == ""
    known = dataclasses.replace(assessment, bound=0.2603)
    assert text(bound_sentence(known)).startswith(
        "A bound: even without costs, no constant weights grew by more than 26.0% a year."
    )


@pytest.mark.parametrize(
    ("p", "said"),
    [(0.0009, "< 0.001"), (0.05, "= 0.050"), (0.0501, "= 0.051"), (0.412, "= 0.42"), (1, "= 1.00")],
)
def test_p_values_are_rounded_up(p: float, said: str) -> None:
    assert p_text(p) == said


def test_verdicts_are_on_agents_alone(assessment: Assessment) -> None:
    assert list(verdicts(assessment)) == ["dqn"]
    best = assessment.best_baseline, assessment.best_sharpe
    assert assessment.comparisons == 3 + best.count("other")


def test_luck_in_words(assessment: Assessment) -> None:
    entry = assessment.strategies["dqn"]
    active = None

    def said(sharpe: float, threshold: float, deflated: float, trials: int) -> str:
        test = dataclasses.replace(
            entry.sharpe_test, ratio=sharpe, threshold=threshold, deflated=deflated, trials=trials
        )
        changed = dataclasses.replace(entry, sharpe_test=test, active_test=active)
        strategies = {**assessment.strategies, "dqn": changed}
        return text(luck("dqn", dataclasses.replace(assessment, strategies=strategies)))

    assert said(0.9, 0.31, 0.8349, 10) == (
        "The annual Sharpe ratio of dqn, 0.90, may be luck: the probability that the true one "
        "exceeds 0.31, the expected best of 10 trials without skill, is 83.4%, "
        "less than the usual 95%."
    )
    assert said(-0.9, 0.0, 0.9499999, 1).endswith(
        "-0.90, is no sign of skill: the probability that the true one exceeds zero is 94.9%, "
        "less than the usual 95%."
    )
    assert "is more than luck is likely to explain" in said(0.9, 0.31, 0.95, 10)
    assert said(math.nan, 0.31, math.nan, 10).count("undefined") == 2
    active = dataclasses.replace(
        entry.sharpe_test, ratio=0.25, threshold=0.53, deflated=0.0664, trials=10
    )
    assert said(0.9, 0.31, 0.97, 10).endswith(
        "Its information ratio to equal weight, 0.25, may be luck: the probability that the true "
        "one exceeds 0.53 is 6.6%, less than the usual 95%."
    )
