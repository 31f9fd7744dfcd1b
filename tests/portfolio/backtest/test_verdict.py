"""The sentences of a backtest: they claim what Holm's correction allows, and no more."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from qfolio.portfolio.backtest.assessment import Assessment, assess
from qfolio.portfolio.backtest.differences import Difference
from qfolio.portfolio.backtest.verdict import luck, p_value, verdict, verdicts

from records import days, strategy


def text(sentence: str) -> str:
    return sentence.replace("\N{NARROW NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-")


@pytest.fixture(scope="module")
def assessment() -> Assessment:
    rng = np.random.default_rng(1)
    baselines = {name: strategy(rng, "baseline", 1) for name in ("equal weight", "other")}
    return assess({**baselines, "dqn": strategy(rng)}, days(300), periods_per_year=252)


def difference(finding: Any, growth: float, low: float, high: float, p: float) -> Difference:
    return Difference("it", growth, (low, high), 0.0, (0.0, 0.0), p / 2, p, finding)


def test_the_corrected_p_value_decides(assessment: Assessment) -> None:
    taken_away = difference("none", 0.008, 0.001, 0.034, 0.0502)
    assert text(verdict("dqn", taken_away, assessment)) == (
        "No evidence that dqn beats it after costs: the difference in annual growth is +0.8 % "
        "(95 % interval +0.1 % to +3.4 %; p = 0.051 after Holm’s correction)."
    )
    better = difference("better", 0.008, 0.001, 0.034, 0.02)
    assert verdict("dqn", better, assessment).startswith("dqn beats it after costs: ")
    worse = difference("worse", -0.008, -0.034, -0.001, 0.02)
    assert verdict("dqn", worse, assessment).startswith("dqn falls short of it after costs: ")
    single = dataclasses.replace(assessment, comparisons=1)
    assert text(verdict("dqn", better, single)).endswith("to +3.4 %; p = 0.020).")


def test_digits_tell_an_end_from_zero(assessment: Assessment) -> None:
    sentence = text(verdict("dqn", difference("better", 0.008, 0.00004, 0.02, 0.01), assessment))
    assert "+0.800 % (95 % interval +0.004 % to +2.000 %;" in sentence
    ruin = difference("none", -math.inf, -math.inf, 0.02, 1.0)
    assert "-∞ % (95 % interval -∞ % to +2.0 %;" in text(verdict("dqn", ruin, assessment))


@pytest.mark.parametrize(
    ("p", "said"),
    [(0.0009, "< 0.001"), (0.05, "= 0.050"), (0.0501, "= 0.051"), (0.412, "= 0.42"), (1, "= 1.00")],
)
def test_p_values_are_rounded_up(p: float, said: str) -> None:
    assert p_value(p) == said


def test_verdicts_are_on_agents_alone(assessment: Assessment) -> None:
    said = verdicts(assessment)
    assert list(said) == ["dqn"]
    assert len(said["dqn"]) == assessment.comparisons == 1 + (assessment.best_baseline == "other")


def test_luck_in_words(assessment: Assessment) -> None:
    entry = assessment.strategies["dqn"]

    def said(sharpe: float, threshold: float, deflated: float, trials: int) -> str:
        measures = {"sharpe": dataclasses.replace(entry.measures["sharpe"], mean=sharpe)}
        test = dataclasses.replace(
            entry.sharpe_test, threshold=threshold, deflated=deflated, trials=trials
        )
        return text(luck("dqn", dataclasses.replace(entry, measures=measures, sharpe_test=test)))

    assert said(0.9, 0.31, 0.8349, 10) == (
        "The annual Sharpe ratio of dqn, 0.90, may be luck: the probability that the true one "
        "exceeds 0.31, the expected best of 10 trials without skill, is 83.4 %, "
        "less than the usual 95 %."
    )
    assert said(-0.9, 0.0, 0.9499999, 1).endswith(
        "-0.90, may be luck: the probability that the true one exceeds zero is 94.9 %, "
        "less than the usual 95 %."
    )
    assert "is more than luck is likely to explain" in said(0.9, 0.31, 0.95, 10)
    assert said(math.nan, 0.31, math.nan, 10).count("undefined") == 2
