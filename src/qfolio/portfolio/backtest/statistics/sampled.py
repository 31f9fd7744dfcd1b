"""Measures with their intervals, from observed and resampled track records."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.statistics import mean_interval
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL, percentile_interval
from qfolio.portfolio.backtest.statistics.measures import MEASURES, Range


@dataclass(frozen=True)
class Measure:
    """One measure of one strategy, with both of its 95% intervals."""

    mean: float  # over seeds
    per_seed: tuple[float, ...]
    over_time: Range  # stationary bootstrap of the mean over seeds
    over_seeds: Range | None  # Student's t of the mean; none below FEWEST_SEEDS


class Sampled(NamedTuple):
    """The measures of one strategy, or of several, by seed, observed and resampled."""

    observed: dict[str, Floats]  # (seeds,)
    drawn: dict[str, Floats]  # (resamples, seeds): the same days for all

    def split(self, seeds: Mapping[str, int]) -> dict[str, "Sampled"]:
        """The parts of strategies whose seeds are here one after the other.

        seeds: number of seeds of each strategy.
        """
        parts, end = {}, 0
        for name, count in seeds.items():
            start, end = end, end + count
            parts[name] = Sampled(
                {key: values[start:end] for key, values in self.observed.items()},
                {key: values[:, start:end] for key, values in self.drawn.items()},
            )
        return parts

    def measures(self, unknown: bool) -> dict[str, Measure]:
        """All in ``MEASURES``; unknown: whether there is neither turnover nor cost."""
        seeds = len(self.observed["growth"])
        nothing = Measure(math.nan, (math.nan,) * seeds, (math.nan, math.nan), None)
        return {
            key: nothing if unknown and key in ("turnover", "cost_drag") else self.measure(key)
            for key in MEASURES
        }

    def measure(self, key: str) -> Measure:
        """One of the measures, by its name."""
        values = self.observed[key]
        low, high = percentile_interval(self.drawn[key].mean(axis=1))
        return Measure(
            mean=_known(mean_over_seeds(values)),
            per_seed=tuple(map(_known, values.tolist())),
            over_time=(_known(low), _known(high)),
            over_seeds=mean_interval(np.sort(values), LEVEL) if np.isfinite(values).all() else None,
        )


def _known(value: float) -> float:
    """A number; NaN is always the same object, so that equal measures are equal."""
    return math.nan if math.isnan(value) else float(value)


def mean_over_seeds(values: Floats) -> float:
    """The mean, to the last digit the same for any order of the seeds."""
    return float(np.sort(values).mean())
