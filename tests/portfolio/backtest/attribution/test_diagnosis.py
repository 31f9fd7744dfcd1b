"""Agents that do nothing are told from those that do something."""

import numpy as np
import pytest

from qfolio.portfolio.backtest.attribution.diagnosis import diagnose, idle
from qfolio.portfolio.backtest.replay import Entry
from qfolio.portfolio.backtest.simulation import simulate

from tables import random_walk

DAYS = 200
FOLDS = [slice(0, 100), slice(100, DAYS)]


def entry(*seeds):
    prices, decisions = random_walk(DAYS + 2), np.array(seeds, float)
    return Entry("agent", decisions, simulate(prices, decisions, first=0, cost=0.001))


def always(*weights):
    return np.tile(weights, (DAYS, 1))


LIVELY = np.random.default_rng(1).dirichlet(np.ones(4), DAYS)
BY_FOLD = np.repeat([[0, 0.6, 0.4, 0], [0, 0.2, 0.2, 0.6]], 100, 0)


@pytest.mark.parametrize(
    ("seeds", "expected"),
    [
        ([LIVELY, LIVELY[::-1]], []),
        ([always(1, 0, 0, 0)], ["dqn never traded and stayed in cash."]),
        ([always(0, 0, 1, 0)], ["dqn traded once and never again."]),
        ([always(0, 0.001, 0.999, 0)], ["dqn always held B alone."]),
        ([always(0, 0.3, 0.3, 0.4)], ["dqn ordered the same weights at every row."]),
        ([BY_FOLD], ["dqn ordered the same weights at every row of a fold, in each of the folds."]),
        (
            [always(1, 0, 0, 0), LIVELY, always(1, 0, 0, 0)],
            ["2 of 3 seeds of dqn never traded and stayed in cash."],
        ),
    ],
)
def test_the_sentence(seeds, expected):
    assert diagnose("dqn", entry(*seeds), FOLDS, "ABC", ignored=False) == expected


def test_an_agent_that_ignores_what_it_observes():
    (sentence,) = diagnose("dqn", entry(LIVELY), FOLDS, "ABC", ignored=True)
    assert sentence.startswith("dqn ignored what it observed: its targets did not change")
    (sentence,) = diagnose("tilts", entry(LIVELY), FOLDS, "ABC", ignored=True, anchor="momentum")
    assert sentence.startswith("tilts found no reason to leave momentum: its targets did not")
    dead = entry(always(1, 0, 0, 0))
    never, sentence = diagnose("dqn", dead, FOLDS, "ABC", ignored=True, anchor="momentum")
    assert never == "dqn never traded and stayed in cash."
    assert sentence.startswith("dqn ignored what it observed")


def test_a_reference_with_idle_cash():
    whole, half = entry(always(0, 0.3, 0.3, 0.4)), entry(always(0.5, 0.2, 0.2, 0.1))
    (sentence,) = idle("dqn", whole, "equal-weight", half)
    assert sentence.startswith("equal-weight held 50% of its wealth in cash on average, and dqn 0%")
    assert idle("dqn", half, "equal-weight", whole) == []  # the agent's own choice
    assert idle("dqn", whole, "equal-weight", whole) == []
