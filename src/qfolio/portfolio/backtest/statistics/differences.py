"""Differences between strategies on the same days: intervals, p-values and corrected findings.

Agents, ensembles and the user's own strategies are tested in growth, Sharpe ratio and volatility
against the reference, which was chosen in advance, and against the reference at its best speed of
rebalancing, which is known only in hindsight; and in growth and in Sharpe ratio against the best
baseline (or strategy of the user's own), likewise. The tests account for such a choice: beating the
best means beating all that it was chosen from, so the largest of their p-values applies (an
intersection–union test, Berger 1982); falling short of the best has the p-value of a reality check
(White 2000) on t-statistics (Hansen 2005), which asks how far ahead the luckiest of them would be
if none were better. Earlier trials on the same prices make it likelier that something looks better
by luck: p-values of that claim are multiplied by their number plus one (Bonferroni). P-values with
Holm's correction for all of these comparisons decide on findings.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.statistics import holm
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL
from qfolio.portfolio.backtest.statistics.estimates import (
    MEASURED,
    Estimate,
    Measured,
    Tails,
    estimate,
    luckiest,
)
from qfolio.portfolio.backtest.statistics.measures import Range

DRAWS = 10_000
"""Number of draws of the luckiest rival."""

Finding = Literal["better", "worse", "none"]


@dataclasses.dataclass(frozen=True)
class Contrast:
    """A difference in one measure; without p-values if it is not tested.

    The interval is of this difference alone, with a level of 95%, over days and seeds.
    """

    value: float
    interval: Range
    p: float | None = None  # two-sided; accounts for a choice in hindsight and earlier trials
    p_holm: float | None = None  # corrected for all comparisons of the backtest; sets finding
    finding: Finding | None = None


@dataclasses.dataclass(frozen=True)
class Difference:
    """A strategy minus a reference on the same days.

    among: number of strategies that the reference is the best of, seen in hindsight; the p-values
    allow for that choice, the intervals do not.
    """

    reference: str
    growth: Contrast  # of annual log growth
    sharpe: Contrast  # of annual Sharpe ratios
    volatility: Contrast  # of the log of annual volatility; less is better
    among: int = 1

    def contrasts(self) -> dict[Measured, Contrast]:
        """The contrasts by measure."""
        return {measure: getattr(self, measure) for measure in MEASURED}

    def found(self, finding: Finding) -> list[Measured]:
        """The measures with this finding."""
        return [name for name, each in self.contrasts().items() if each.finding == finding]


@dataclasses.dataclass(frozen=True)
class Rival:
    """What strategies are compared with: the best of a family.

    name: the one that is shown. among: the family, itself included. tested: in which measures.
    """

    name: str
    among: tuple[str, ...]
    tested: tuple[Measured, ...] = MEASURED

    def without(self, name: str) -> tuple[str, ...]:
        """The family without one strategy, which may be the one that is compared."""
        return tuple(other for other in self.among if other != name)


def compare(
    returns: Mapping[str, Floats],
    rivals: Mapping[str, Rival],
    judged: Sequence[str],
    periods_per_year: float,
    seed: int = 0,
    risk_free: Floats | None = None,
    earlier_trials: int = 0,
) -> dict[str, dict[str, Difference]]:
    """Every strategy minus each of the rivals.

    Args:
        returns: Simple returns of shape (seeds, periods), by strategy.
        rivals: The rivals, by their role.
        judged: Which strategies are tested.
        periods_per_year: For example 252 for trading days.
        seed: Seed of the draws.
        risk_free: Returns of cash, shape (periods,), which Sharpe ratios subtract (default: 0).
        earlier_trials: Number of earlier trials on these days.

    Returns:
        Differences by role and strategy, without those of a rival to itself.
    """
    tails: dict[tuple[str, str, Measured], Tails] = {}
    differences: dict[str, dict[str, Difference]] = {role: {} for role in rivals}
    for name, ours in returns.items():
        others = {
            other: estimate(ours, returns[other], periods_per_year, risk_free)
            for rival in rivals.values()
            for other in (rival.without(name) if name in judged else (rival.name,))
        }
        for role, rival in rivals.items():
            if name == rival.name:
                continue
            shown = others[rival.name]
            contrasts = {key: Contrast(e.value, e.interval()) for key, e in shown.items()}
            differences[role][name] = Difference(
                rival.name, **contrasts, among=len(rival.without(name))
            )
            if name in judged:
                for key in rival.tested:
                    rng = np.random.default_rng(seed)
                    among = [others[other][key] for other in rival.without(name)]
                    better, worse = tails_to(shown[key], among, key != "volatility", rng)
                    better = min(1.0, better * (1 + earlier_trials))
                    tails[role, name, key] = Tails(better, worse)
    p_values = [min(1.0, 2 * min(each)) for each in tails.values()]
    for ((role, name, key), (better, worse)), p, p_holm in zip(
        tails.items(), p_values, holm(p_values).tolist(), strict=True
    ):
        side: Finding = "better" if better < worse else "worse"
        tested = dataclasses.replace(
            differences[role][name].contrasts()[key],
            p=p,
            p_holm=p_holm,
            finding=side if p_holm <= 1 - LEVEL else "none",
        )
        known: dict[str, Any] = {key: tested}
        differences[role][name] = dataclasses.replace(differences[role][name], **known)
    return differences


def tails_to(
    shown: Estimate, among: Sequence[Estimate], more: bool, rng: np.random.Generator
) -> Tails:
    """P-values of the claims that a strategy is better, and worse, than the best of several.

    Args:
        shown: Its difference from the one that is shown as the best.
        among: Its differences from all of them.
        more: Whether more is better.
        rng: Source of randomness.
    """
    if not more:
        shown, among = shown.negated(), [one.negated() for one in among]
    better, worse = max(one.tails().better for one in among), shown.tails().worse
    if len(among) > 1 and worse < better and shown.error > 0:
        lead = -shown.value / shown.error
        lucky = luckiest([one for one in among if one.known and one.error > 0], DRAWS, rng) >= lead
        # No claim that contradicts the interval; the observed history counts as one draw.
        worse = max(worse, float((1 + lucky.sum()) / (1 + DRAWS)))
    return Tails(better, worse)
