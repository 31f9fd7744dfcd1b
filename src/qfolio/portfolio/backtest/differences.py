"""Differences of strategies on the same days: intervals, p-values and corrected findings.

Intervals and p-values come from the same resampled histories. A history draws the days and,
independently for each strategy, its seeds: S − 1 of S with replacement, since S of S would
understate the variance of the mean by the factor (S − 1)/S (McCarthy & Snowden 1985).

Agents and ensembles are tested in growth against the reference, which was chosen in advance, and
against the best baseline, which is known only in hindsight. The tests account for that choice:
beating the best means beating every baseline, so the largest of their p-values applies (an
intersection–union test, Berger 1982); falling short of the best has the p-value of White's reality
check (2000), which selects the best in each resample. Holm's correction for all of these
comparisons decides.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qfolio.core.statistics import holm
from qfolio.portfolio.backtest.bootstrap import LEVEL, percentile_interval
from qfolio.portfolio.backtest.measures import Floats, Range, log_growth, paired_difference

MARGIN = 1e-6
"""Smaller differences in annual growth are rounding errors."""

Pair = tuple[str, str]
"""The names of a strategy and of its comparison."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """A strategy minus a reference on the same days.

    Each interval is of this difference alone, with a level of 95 %, over days and seeds. The
    p-values and the finding concern the difference in growth; baselines are not tested and have
    none.
    """

    reference: str
    growth: float  # of annual log growth
    growth_interval: Range
    sharpe: float  # of annual Sharpe ratios
    sharpe_interval: Range
    p: float | None = None  # two-sided; accounts for the choice of the best baseline
    p_holm: float | None = None  # corrected for all comparisons of the backtest; decides
    finding: Literal["better", "worse", "none"] | None = None


class Sampled(NamedTuple):
    """The measures of one strategy by seed, observed and resampled."""

    observed: dict[str, Floats]  # (seeds,)
    drawn: dict[str, Floats]  # (resamples, seeds): the same days for all
    picks: NDArray[np.int64]  # (resamples, seeds drawn): the resampled seeds


def compare(
    sampled: Mapping[str, Sampled], baselines: Sequence[str], reference: str, best: str
) -> dict[Pair, Difference]:
    """Every strategy minus the reference and minus the best baseline.

    Args:
        sampled: By strategy.
        baselines: Which of them are baselines.
        reference: The baseline that was chosen in advance.
        best: The baseline that grew most.
    """
    differences = {
        (name, other): Difference(
            other,
            _observed(sampled[name], sampled[other], "growth"),
            as_range(_drawn(sampled[name], sampled[other], "growth")),
            _observed(sampled[name], sampled[other], "sharpe"),
            as_range(_drawn(sampled[name], sampled[other], "sharpe")),
        )
        for name in sampled
        for other in dict.fromkeys((reference, best))
        if name != other
    }
    rivals = [sampled[name] for name in baselines]
    tails = {
        (name, other): tails_to(sampled[name], sampled[other])
        if other == reference
        else tails_to_best(sampled[name], rivals)
        for name, other in differences
        if name not in baselines
    }
    return {**differences, **_corrected(differences, tails)}


class Tails(NamedTuple):
    """One-sided p-values of a difference in growth."""

    better: float
    worse: float


def tails_to(ours: Sampled, theirs: Sampled) -> Tails:
    """P-values against a strategy chosen in advance.

    They invert the interval: one is at most 2.5 % exactly if the 95 % interval lies on its side of
    zero.
    """
    drawn = _drawn(ours, theirs, "growth")
    return Tails(_share(~(drawn > MARGIN)), _share(~(drawn < -MARGIN)))  # NaN counts for neither


def tails_to_best(ours: Sampled, rivals: Sequence[Sampled]) -> Tails:
    """P-values against the best of the rivals, chosen in hindsight."""
    each = [tails_to(ours, rival) for rival in rivals]
    observed = np.array([_observed(ours, rival, "growth") for rival in rivals])
    drawn = np.stack([_drawn(ours, rival, "growth") for rival in rivals])
    # The lead of the luckiest rival if none is truly better.
    ahead = (observed[:, None] - drawn).max(axis=0)
    reality_check = _share(~(ahead < -observed.min()))
    alone = each[int(observed.argmin())]
    return Tails(
        better=max(tails.better for tails in each),
        worse=max(reality_check, alone.worse),  # no claim that contradicts the interval
    )


def _corrected(
    differences: Mapping[Pair, Difference], tails: Mapping[Pair, Tails]
) -> dict[Pair, Difference]:
    """The tested differences with their p-values and findings."""
    p_values = [min(1.0, 2 * min(each)) for each in tails.values()]
    found = {}
    rows = zip(tails.items(), p_values, holm(p_values).tolist(), strict=True)
    for (pair, (better, worse)), p, p_holm in rows:
        side: Literal["better", "worse"] = "better" if better < worse else "worse"
        found[pair] = dataclasses.replace(
            differences[pair],
            p=p,
            p_holm=p_holm,
            finding=side if p_holm <= 1 - LEVEL else "none",
        )
    return found


def mean_over_seeds(values: Floats) -> float:
    return float(np.sort(values).mean())


def as_range(samples: Floats) -> Range:
    low, high = percentile_interval(samples)
    return float(low), float(high)


def _observed(ours: Sampled, theirs: Sampled, key: str) -> float:
    scale = log_growth if key == "growth" else np.asarray
    means = [np.asarray(mean_over_seeds(scale(each.observed[key]))) for each in (ours, theirs)]
    return float(paired_difference(*means))


def _drawn(ours: Sampled, theirs: Sampled, key: str) -> Floats:
    """The difference in each resampled history, of shape (resamples,)."""
    scale = log_growth if key == "growth" else np.asarray
    means = [
        np.take_along_axis(scale(each.drawn[key]), each.picks, axis=1).mean(axis=1)
        for each in (ours, theirs)
    ]
    return paired_difference(*means)


def _share(hits: NDArray[np.bool_]) -> float:
    """The share of hits, counting the observed history as one resample."""
    return float((1 + hits.sum()) / (1 + hits.size))
