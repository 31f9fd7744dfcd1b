"""Verdicts of a backtest in sentences: which baselines an agent beats, and whether by luck."""

import math

import numpy as np

from qfolio.portfolio.backtest.assessment import Assessment, StrategyAssessment
from qfolio.portfolio.backtest.bootstrap import LEVEL
from qfolio.portfolio.backtest.differences import Difference

_THIN_SPACE = "\N{NARROW NO-BREAK SPACE}"

_FINDINGS = {
    "better": "{} beats {} after costs",
    "worse": "{} falls short of {} after costs",
    "none": "No evidence that {} beats {} after costs",
}


def verdicts(assessment: Assessment) -> dict[str, list[str]]:
    """The verdicts on every agent and ensemble, by name."""
    return {
        name: [verdict(name, each, assessment) for each in tested(strategy)]
        for name, strategy in assessment.strategies.items()
        if strategy.kind != "baseline"
    }


def tested(strategy: StrategyAssessment) -> list[Difference]:
    """The differences to the reference, and to the best baseline if that is another."""
    pair = (strategy.to_reference, strategy.to_best_baseline)
    return [each for each in pair if each is not None and each.finding is not None]


def verdict(name: str, difference: Difference, assessment: Assessment) -> str:
    """The verdict of a comparison in growth.

    Holm's correction over all comparisons of the backtest decides on the claim.
    """
    found, numbers = finding(name, difference), evidence(difference, assessment)
    return f"{found}: the difference in annual growth is {numbers}."


def finding(name: str, difference: Difference) -> str:
    """The claim of a verdict, without its numbers."""
    return _FINDINGS[difference.finding or "none"].format(name, difference.reference)


def evidence(difference: Difference, assessment: Assessment) -> str:
    """The numbers of a verdict: the difference, its interval and the p-value that decides."""
    low, high = difference.growth_interval
    # Enough digits to tell an end from zero.
    ends = [abs(100 * end) for end in (low, high) if end and math.isfinite(end)]
    digits = next((d for d in range(1, 7) if all(round(end, d) for end in ends)), 7)
    middle, left, right = (
        f"{_number(100 * value, digits, sign=True)}{_THIN_SPACE}%"
        for value in (difference.growth, low, high)
    )
    text = f"{middle} (95{_THIN_SPACE}% interval {left} to {right}"
    if difference.p_holm is not None:
        text += f"; p {p_value(difference.p_holm)}"
        if assessment.comparisons > 1:
            text += " after Holm’s correction"
    return text + ")"


def p_value(p: float) -> str:
    """A p-value with its sign; rounded up, so that 0.0502 does not read as 0.05."""
    if p < 0.001:
        return "< 0.001"
    digits = 3 if p < 0.1 else 2
    return f"= {math.ceil(10**digits * p - 1e-9) / 10**digits:.{digits}f}"


def luck(name: str, strategy: StrategyAssessment) -> str:
    """The verdict of a deflated Sharpe ratio.

    It tests whether there is a return for the risk at all, given the selection among trials.
    ``verdict`` tests whether an agent is better than a baseline.
    """
    test, sharpe = strategy.sharpe_test, strategy.measures["sharpe"].mean
    bar = "zero"
    if test.trials > 1:
        bar = f"{test.threshold:.2f}, the expected best of {test.trials} trials without skill,"
    # Rounded down: 94.96 must not read as 95.0.
    chance = float(np.floor(1000 * test.deflated) / 10)
    claim, shortfall = "is more than luck is likely to explain", ""
    if not test.deflated >= LEVEL:
        claim, shortfall = "may be luck", f", less than the usual 95{_THIN_SPACE}%"
    return (
        f"The annual Sharpe ratio of {name}, {_number(sharpe, 2)}, {claim}: the probability that "
        f"the true one exceeds {bar} is {_number(chance, 1)}{_THIN_SPACE}%{shortfall}."
    )


def _number(value: float, digits: int, sign: bool = False) -> str:
    if math.isnan(value):
        return "undefined"
    text = "∞" if math.isinf(value) else f"{abs(value):.{digits}f}"
    if not text.strip("0."):
        return text
    return ("\N{MINUS SIGN}" if value < 0 else "+" if sign else "") + text
