"""Verdicts of a backtest in sentences: which references an agent beats, and whether by luck."""

import math
from collections.abc import Sequence

import numpy as np

from qfolio.core.text import figure, listed
from qfolio.portfolio.backtest.statistics.assessment import JUDGED, Assessment, StrategyAssessment
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL
from qfolio.portfolio.backtest.statistics.differences import Contrast, Difference, Finding
from qfolio.portfolio.backtest.statistics.estimates import Measured
from qfolio.portfolio.backtest.statistics.measures import STEADY
from qfolio.portfolio.backtest.statistics.sharpe import SharpeTest

_MEASURES: dict[Measured, str] = {
    "growth": "growth",
    "sharpe": "Sharpe ratio",
    "volatility": "volatility",
}

_MOVES = {"better": "less", "worse": "more"}
"""Volatility in words, by finding."""

ENDLESS = 1000.0
"""From this ratio of volatilities on, an interval is shown without an end: its digits, of which
there may be hundreds, would say nothing."""


def verdicts(assessment: Assessment) -> dict[str, list[str]]:
    """The verdicts on every agent and ensemble, by name; the first is against the reference."""
    return {
        name: [
            f"{': '.join(filter(None, (claim, evidence(difference, assessment))))}."
            for claim, difference in claims(name, assessment)
        ]
        for name, strategy in assessment.strategies.items()
        if strategy.kind in JUDGED
    }


def claims(name: str, assessment: Assessment) -> list[tuple[str, Difference]]:
    """What was found about an agent, without numbers, and the difference of each claim.

    Claims against the reference come first, and of these, one that says the agent grew less. If the
    agent beats the reference as it is, but not at every speed of rebalancing, one claim says so of
    all speeds, and another of which speed it holds. After a total loss there is only one claim,
    which says so.
    """
    entry, reference = assessment.strategies[name], assessment.reference
    alone, rebalanced = entry.to_reference, entry.to_rebalanced
    assert alone is not None  # only the reference itself has none
    if rebalanced is None:
        main, at_any, at_best = alone, reference, reference
    else:
        main, at_any, at_best = rebalanced, at_any_speed(reference), at_best_speed(reference)
    if wiped_out(entry) or main.growth.value == math.inf:
        return [(_ruin(name, entry, main), main)]
    claim = _claim(name, main, at_any, at_best)
    if claim and not main.found("better"):
        claim += ", and beats it in nothing"
    at_every = f"{reference} at every speed of rebalancing" if _gains(alone) else reference
    said = [(claim or _nothing(name, main, at_every), main)]
    if rebalanced is not None and not _alike(alone, rebalanced):
        here = reference
        if set(_gains(alone)) > set(_gains(main)):
            dear = main.reference != reference  # a slower one grew more
            here += " where it is rebalanced in full with every order"
            here += ", which pays costs for nothing," if dear else ","
        said.append((_claim(name, alone, here, reference), alone))
    said.sort(key=lambda each: each[1].growth.finding != "worse")
    for each in (entry.to_best_baseline, entry.to_best_sharpe):
        if each is not None:
            said.append((_claim(name, each, each.reference, each.reference), each))
    return [(claim, difference) for claim, difference in said if claim]


def at_any_speed(reference: str) -> str:
    """The reference and all of its rebalancings, in words."""
    return f"{reference}, however it is rebalanced,"


def at_best_speed(reference: str) -> str:
    """The rebalancing of the reference that grew most, in words."""
    return f"the best rebalancing of {reference}"


def seeds_lost(drawdowns: Sequence[float]) -> int:
    """With how many of its seeds a strategy lost everything, by the deepest drawdown of each.

    Growth does not tell: it is also −1 a year, to the last digit, where a short test of intraday
    rows would lose all but 1e-16 in a year.
    """
    return drawdowns.count(1)


def wiped_out(strategy: StrategyAssessment) -> bool:
    """Whether a strategy lost everything, with any of its seeds."""
    return seeds_lost(strategy.measures["drawdown"].per_seed) > 0


def _ruin(name: str, strategy: StrategyAssessment, difference: Difference) -> str:
    """That a strategy, or the one it is compared with, lost everything."""
    if not wiped_out(strategy):
        return f"{difference.reference} was wiped out, and {name} was not"
    deepest = strategy.measures["drawdown"].per_seed
    return lost_everything(name, seeds_lost(deepest), len(deepest))


def lost_everything(name: str, lost: int, seeds: int) -> str:
    """That a strategy lost everything, with how many of its seeds."""
    some = "" if lost == seeds else f" with {lost} of {seeds} seeds"
    return f"{name} was wiped out{some}: it lost everything"


def _alike(one: Difference, other: Difference) -> bool:
    """Whether two differences are from the same strategy, with the same findings."""
    both = [[each.finding for each in d.contrasts().values()] for d in (one, other)]
    return one.reference == other.reference and both[0] == both[1]


def _claim(name: str, difference: Difference, better: str, worse: str) -> str:
    """What a difference shows in growth or Sharpe ratio, and then in volatility; may be empty.

    Less volatility alone is no victory: cash has none.
    """
    parts = [
        f"{verb} {other} in {listed([_MEASURES[key] for key in found])}"
        for verb, other, found in (
            ("beats", better, _gains(difference)),
            ("falls short of", worse, _gains(difference, "worse")),
        )
        if found
    ]
    moves = (
        f", and fluctuates {move}"
        if (move := _MOVES.get(difference.volatility.finding or ""))
        else ""
    )
    return f"{name} {' and '.join(parts)} after costs{moves}" if parts else ""


def _nothing(name: str, difference: Difference, other: str) -> str:
    """That nothing was found; volatility is added if it differs."""
    move = _MOVES.get(difference.volatility.finding or "")
    measures = "growth or Sharpe ratio" if move else listed(list(_MEASURES.values()), "or")
    word = "but" if move == "less" else "and"
    moves = f", {word} it fluctuates {move}" if move else ""
    return f"No evidence that {name} beats {other} in {measures} after costs{moves}"


def _gains(difference: Difference, finding: Finding = "better") -> list[Measured]:
    """The measures other than volatility with this finding."""
    return [measure for measure in difference.found(finding) if measure != "volatility"]


def evidence(difference: Difference, assessment: Assessment) -> str:
    """The numbers of a verdict: each tested difference, its interval and the p-value that decides.

    Holm's correction over all comparisons of the backtest decides on a claim. Differences that are
    not ``comparable`` are left out; without any growth there are no numbers.
    """
    if not comparable("growth", difference.growth):
        return ""
    tested = {key: each for key, each in difference.contrasts().items() if each.p is not None}
    p = "corrected p" if assessment.comparisons > 1 else "p"
    texts: list[str] = []
    for key, each in (tested or {"growth": difference.growth}).items():
        if comparable(key, each):
            lead = f"in {_MEASURES[key]}"
            if not texts:
                what = "annual log growth" if key == "growth" else _MEASURES[key]
                lead = f"the difference in {what} from {difference.reference} is"
            texts.append(f"{lead} {_numbers(key, each, p, difference.reference)}")
    if not texts:
        return ""
    said = listed(texts)
    if tested and difference.among > 1:
        said += f"; p allows for the choice of the best of {difference.among}, intervals do not"
    steady = "volatility" in tested and difference.volatility.value > math.log(STEADY)
    return said + (f"; {difference.reference} hardly fluctuates" if steady else "")


def comparable(key: Measured, contrast: Contrast) -> bool:
    """Whether a difference says something as a number.

    It does not after a total loss, nor in volatility if the other strategy hardly fluctuates.
    """
    return math.isfinite(contrast.value) and not (
        key == "volatility" and contrast.value > math.log(STEADY)
    )


def shown(key: Measured, contrast: Contrast) -> tuple[float, float, float]:
    """A difference and its interval as readers see them: in volatility, the ratio minus 1."""
    values = (contrast.value, *contrast.interval)
    if key != "volatility":
        return values
    value, low, high = (
        math.expm1(value) if value < math.log(ENDLESS) else math.inf for value in values
    )
    return value, low, high


def telling(value: float, digits: int) -> int:
    """The number of decimals, at least ``digits``, that keeps a small number from rounding to 0.

    One that four decimals do not show is taken for rounding, such as that of a file.
    """
    if value == 0 or not math.isfinite(value):
        return digits
    return next((d for d in range(digits, 5) if round(value, d)), digits)


def _numbers(key: Measured, contrast: Contrast, p: str, other: str) -> str:
    """A difference from another strategy, with its interval and p-value in words."""
    percent, unit = key != "sharpe", "%" if key != "sharpe" else ""
    least = 1 if percent else 2
    scaled = [100 * value if percent else value for value in shown(key, contrast)]
    digits = max(telling(end, least) for end in scaled[1:])
    middle, left, right = (f"{_number(value, digits, sign=True)}{unit}" for value in scaled)
    base = f" of {other}'s" if key == "volatility" else ""
    text = f"{middle}{base} (95% interval {left} to {right}"
    return text + (")" if contrast.p_holm is None else f"; {p} {p_text(contrast.p_holm)})")


def p_text(p: float) -> str:
    """A p-value with its sign; rounded up, so that 0.0502 does not read as 0.05."""
    if p < 0.001:
        return "< 0.001"
    digits = 3 if p < 0.1 else 2
    return f"= {math.ceil(10**digits * p - 1e-9) / 10**digits:.{digits}f}"


def luck(name: str, assessment: Assessment) -> str:
    """The verdicts of the deflated Sharpe ratio and information ratio.

    The first tests whether there is a return for the risk at all, given the selection among trials;
    stocks usually have one. The second tests what an agent adds to the reference.
    """
    entry = assessment.strategies[name]
    sharpe, active = entry.sharpe_test, entry.active_test
    best = f", the expected best of {sharpe.trials} trials without skill," * (sharpe.trials > 1)
    said = [_luck(f"The annual Sharpe ratio of {name}", sharpe, best)]
    if active is not None:
        said.append(_luck(f"Its information ratio to {assessment.rebalanced}", active))
    return " ".join(said)


def _luck(subject: str, test: SharpeTest, best: str = "") -> str:
    bar = f"{test.threshold:.2f}{best}" if test.trials > 1 else "zero"
    # Rounded down: 94.96 must not read as 95.0.
    chance = float(np.floor(1000 * test.deflated) / 10)
    claim, shortfall = "is more than luck is likely to explain", ""
    if not test.deflated >= LEVEL:
        claim, shortfall = "may be luck", ", less than the usual 95%"
        if test.ratio <= 0:
            claim = "is no sign of skill"
    return (
        f"{subject}, {_number(test.ratio, 2)}, {claim}: the probability that the true one exceeds "
        f"{bar} is {_number(chance, 1)}%{shortfall}."
    )


def bound_sentence(assessment: Assessment) -> str:
    """A sentence on the growth that no constant weights exceeded; empty if it is not known."""
    if assessment.bound is None:
        return ""
    growth = f"{_number(100 * assessment.bound, 1)}%"
    return (
        f"A bound: even without costs, no constant weights grew by more than {growth} a year. "
        "The best ones are known only in hindsight, so nobody could have followed them."
    )


def _number(value: float, digits: int, sign: bool = False) -> str:
    return "undefined" if math.isnan(value) else figure(value, f"{'+' if sign else ''}.{digits}f")
