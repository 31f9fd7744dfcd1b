"""How much a strategy differs from another in growth, Sharpe ratio and volatility, and how surely.

A difference is estimated from pairs of returns of the same days, so its error is a mean over days
to first order. The variance of that mean allows for autocorrelation: it is the mean square of the
first ν cosine transforms of the days' contributions, which are almost independent, and the
difference over its error has Student's t distribution with ν degrees of freedom (Lazarus, Lewis,
Stock & Watson 2018, "HAR Inference: Recommendations for Practice"). Volatility wanders for months,
and each strategy's own way, so that only slow transforms show how far (Müller & Watson 2008,
"Testing Models of Low-Frequency Variability"). Seeds add the variance of their mean.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL
from qfolio.portfolio.backtest.statistics.measures import (
    Range,
    deviations,
    log_growth,
    paired_difference,
    ratio_or_zero,
)

MEASURED: tuple["Measured", ...] = ("growth", "sharpe", "volatility")
Measured = Literal["growth", "sharpe", "volatility"]

MARGIN = 1e-6
"""Smaller differences are rounding errors: in annual log growth, Sharpe ratio, log volatility."""


SLOW = 0.8
"""Cosine transforms a year for a difference in volatility: they take two years and a half or more
for a period."""

FEWEST = 2
"""Cosine transforms of a test that is shorter than that: it shows little of volatility."""

SHORTEST = 5
"""Periods of a test: with two, the error of a Sharpe ratio is always 0, and with few more it is by
chance."""


def clear(difference: ArrayLike) -> Floats:
    """A difference, 0 where it is a rounding error, so that no ratio of it is one of noise."""
    return np.where(np.abs(difference) <= MARGIN, 0.0, difference)


class Tails(NamedTuple):
    """One-sided p-values of the claims that a strategy is better, and that it is worse."""

    better: float
    worse: float


class Estimate(NamedTuple):
    """A difference in one measure, its error, and what the errors of several have in common.

    value: the mean over seeds. loads: the first ν cosine transforms of the days' contributions to
    its error, of shape (ν,). seed_variance: of the mean over seeds. seeds: their number.
    """

    value: float
    loads: Floats
    seed_variance: float
    seeds: int

    @property
    def known(self) -> bool:
        """Whether the difference has an error: not if a strategy lost everything."""
        return math.isfinite(self.value) and bool(np.isfinite(self.loads).all())

    @property
    def error(self) -> float:
        """The standard error."""
        return math.sqrt(float((self.loads**2).mean()) + self.seed_variance)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the squared error (Welch 1947, Satterthwaite 1946)."""
        days, seeds = float((self.loads**2).mean()), self.seed_variance
        if seeds == 0:
            return float(len(self.loads))
        return (days + seeds) ** 2 / (days**2 / len(self.loads) + seeds**2 / (self.seeds - 1))

    def interval(self) -> Range:
        """The interval of level ``LEVEL``; unbounded if the error is not known."""
        from scipy.special import stdtrit

        if not self.known:
            return -math.inf, math.inf
        margin = float(stdtrit(self.freedom, (1 + LEVEL) / 2)) * self.error if self.error else 0.0
        return self.value - margin, self.value + margin

    def tails(self) -> Tails:
        """P-values of this difference alone, if more is better.

        They are 1 if the difference is a rounding error or its error is not known.
        """
        from scipy.special import stdtr

        if not self.known or abs(self.value) <= MARGIN:
            return Tails(1.0, 1.0)
        ratio = float(ratio_or_zero(self.value, self.error))
        return Tails(*(float(stdtr(self.freedom, side)) for side in (-ratio, ratio)))

    def negated(self) -> "Estimate":
        """The same difference with the opposite sign."""
        return self._replace(value=-self.value, loads=-self.loads)


def estimate(
    ours: Floats, theirs: Floats, periods_per_year: float, risk_free: Floats | None = None
) -> dict[Measured, Estimate]:
    """Estimate the differences of one strategy from another, all annual.

    Growth: the mean of the difference in log returns. Sharpe ratio: the delta method of Ledoit &
    Wolf (2008), "Robust performance hypothesis testing with the Sharpe ratio". Volatility: the log
    of the ratio, as Ledoit & Wolf (2011) do; its contributions have one scale for both strategies,
    which are equally volatile under the hypothesis (with a scale for each, the error would be too
    small when volatility clusters).

    Args:
        ours: Simple returns of shape (seeds, periods).
        theirs: Likewise, with the same periods; usually one seed.
        periods_per_year: For example 252 for trading days.
        risk_free: Returns of cash, shape (periods,), which Sharpe ratios subtract (default: 0).
    """
    year = math.sqrt(periods_per_year)
    logs = paired_difference(log_growth(ours), log_growth(theirs).mean(axis=0))
    mine, other = _moments(ours), _moments(theirs)
    over, their = mine, other
    if risk_free is not None:
        over, their = (_moments(np.maximum(x - risk_free, -1)) for x in (ours, theirs))
    scale = (mine.deviation**2 + (other.deviation**2).mean()) / 2
    squares = mine.centered**2 - (other.centered**2).mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "growth": _estimate(periods_per_year * logs.mean(axis=1), periods_per_year * logs),
            "sharpe": _estimate(
                year * (over.sharpe - their.sharpe.mean()),
                year * (over.sharpe_part() - their.sharpe_part().mean(axis=0)),
            ),
            "volatility": _estimate(
                np.log(mine.deviation) - np.log(other.deviation).mean(),
                squares / (2 * scale[:, None]),
                max(FEWEST, int(SLOW * ours.shape[1] / periods_per_year)),
            ),
        }


def luckiest(family: list[Estimate], draws: int, rng: np.random.Generator) -> Floats:
    """Draw the largest t-statistic of several estimates, all true differences being zero.

    Each error is in units of its own standard error. In a common unit, the wildest strategy would
    set how lucky the luckiest is expected to be, whatever it is compared with (Hansen 2005). Errors
    are jointly normal, with the correlations of their loads, over a common estimated scale.

    Args:
        family: Estimates on the same days and with the same seeds, with errors above zero.
        draws: Number of draws.
        rng: Source of randomness.

    Returns:
        Numbers of shape (draws,).
    """
    errors = np.array([each.error for each in family])
    loads = np.stack([each.loads for each in family], axis=1) / errors  # (ν, estimates)
    count = len(loads)
    days = rng.standard_normal((draws, count)) @ loads / math.sqrt(count)
    spread = np.sqrt([each.seed_variance for each in family]) / errors
    seeds = rng.standard_normal((draws, 1)) * spread
    freedom = min(each.freedom for each in family)
    scale = np.sqrt(rng.chisquare(freedom, (draws, 1)) / freedom)
    return np.asarray(((days + seeds) / scale).max(axis=1))


class _Moments(NamedTuple):
    """Moments of returns of shape (seeds, periods), by seed."""

    centered: Floats  # (seeds, periods)
    deviation: Floats  # (seeds,)
    sharpe: Floats  # (seeds,), per period

    def sharpe_part(self) -> Floats:
        """Each day's contribution to the Sharpe ratio's error, (seeds, periods)."""
        score = ratio_or_zero(self.centered, self.deviation[:, None])
        return np.asarray(score - self.sharpe[:, None] / 2 * (score**2 - 1))


def _moments(returns: Floats) -> _Moments:
    centered = deviations(returns)
    deviation = np.sqrt((centered**2).sum(axis=1) / max(returns.shape[1] - 1, 1))
    return _Moments(centered, deviation, ratio_or_zero(returns.mean(axis=1), deviation))


def _estimate(per_seed: Floats, contributions: Floats, most: float = math.inf) -> Estimate:
    """From values of shape (seeds,) and contributions of shape (seeds, periods) to their errors.

    most: the largest number of cosine transforms.
    """
    from scipy.fft import dct

    seeds, periods = contributions.shape
    values = np.sort(per_seed)
    count = int(max(1, min(0.41 * periods ** (2 / 3), most, periods - 1)))
    with np.errstate(invalid="ignore"):
        total = contributions.mean(axis=0)
        finite = bool(np.isfinite(total).all() and np.isfinite(values).all())
        finite = finite and periods >= SHORTEST
        loads = (
            dct(total)[1 : count + 1] / (math.sqrt(2) * periods) if finite else np.full(1, np.nan)
        )
        value = float(values.mean())
    spread = float(values.var(ddof=1)) / seeds if finite and seeds > 1 else 0.0
    return Estimate(value, loads, spread, seeds)
