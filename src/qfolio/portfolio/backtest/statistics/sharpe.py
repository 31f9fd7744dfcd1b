"""Significance of Sharpe ratios: probabilistic, deflated, and the minimum track record."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL
from qfolio.portfolio.backtest.statistics.measures import deviations, ratio_or_zero
from qfolio.portfolio.backtest.statistics.sampled import mean_over_seeds


@dataclasses.dataclass(frozen=True)
class SharpeTest:
    """Tests of whether a Sharpe ratio is more than luck; moments are means over the seeds.

    That of active returns is an information ratio.
    """

    ratio: float  # annual, mean over the seeds
    skewness: float
    kurtosis: float  # 3 for a normal distribution
    probabilistic: float  # probability that the true Sharpe ratio exceeds zero
    minimum_years: float  # track record needed until that probability reaches 95%; may be inf
    threshold: float  # annual Sharpe ratio expected of the best trial if none has any skill
    deflated: float  # probability that the true Sharpe ratio exceeds the threshold
    trials: int  # number that the threshold counts; 1 for a baseline


def sharpe_tests(
    returns: Mapping[str, Floats],
    ratios: Mapping[str, Floats],
    judged: Sequence[str],
    trials: int,
    periods_per_year: float,
) -> dict[str, SharpeTest]:
    """The tests of annual Sharpe ratios, means over the seeds.

    Baselines were not selected among trials.

    Args:
        returns: Of shape (seeds, periods), by strategy.
        ratios: Their annual Sharpe ratios of shape (seeds,).
        judged: Which strategies are trials.
        trials: Number of trials.
        periods_per_year: For example 252 for trading days.
    """
    year = math.sqrt(periods_per_year)
    periods = next(iter(returns.values())).shape[1]
    variance = _trial_variance([ratios[name] for name in judged], periods, periods_per_year)

    def test(name: str) -> SharpeTest:
        annual, moments = mean_over_seeds(ratios[name]), skewness_and_kurtosis(returns[name])
        sharpe, count = annual / year, trials if name in judged else 1
        return SharpeTest(
            annual,
            *moments,
            probabilistic=probabilistic_sharpe(sharpe, periods, *moments),
            minimum_years=minimum_track_record(sharpe, *moments) / periods_per_year,
            threshold=year * expected_maximum_sharpe(count, variance),
            deflated=deflated_sharpe(sharpe, periods, *moments, count, variance),
            trials=count,
        )

    return {name: test(name) for name in returns}


# Every Sharpe ratio in these formulas is per period, not annual: an annual one would count each
# period as a whole year of evidence.


def probabilistic_sharpe(
    sharpe: float, periods: int, skewness: float, kurtosis: float, benchmark: float = 0.0
) -> float:
    """Return the probability that the true Sharpe ratio exceeds a benchmark.

    Bailey & López de Prado (2012), "The Sharpe ratio efficient frontier":
    Φ((SR − SR*) √(n − 1) / √(1 − γ₃ SR + (γ₄ − 1)/4 SR²)).

    Args:
        sharpe: Observed Sharpe ratio per period, not annual.
        periods: Number of returns that it was computed from.
        skewness: γ₃ of the returns, 0 for normal ones.
        kurtosis: γ₄ of the returns, 3 for normal ones.
        benchmark: SR*, per period.
    """
    from scipy.special import ndtr

    if math.isinf(sharpe):
        return float(sharpe > 0)
    error = math.sqrt(max(_sharpe_variance(sharpe, skewness, kurtosis), 0))
    return float(ndtr(ratio_or_zero((sharpe - benchmark) * math.sqrt(periods - 1), error)))


def minimum_track_record(
    sharpe: float, skewness: float, kurtosis: float, benchmark: float = 0.0, level: float = LEVEL
) -> float:
    """Return the number of periods until the probabilistic Sharpe ratio reaches a level.

    Bailey & López de Prado (2012): 1 + (1 − γ₃ SR + (γ₄ − 1)/4 SR²) (z / (SR − SR*))², infinite
    if the Sharpe ratio does not exceed the benchmark. Arguments as in ``probabilistic_sharpe``.
    """
    from scipy.special import ndtri

    if not sharpe > benchmark:
        return math.inf
    if math.isinf(sharpe):
        return 1.0
    variance = _sharpe_variance(sharpe, skewness, kurtosis)
    return float(1 + variance * (ndtri(level) / (sharpe - benchmark)) ** 2)


def expected_maximum_sharpe(trials: int, variance: float) -> float:
    """Return the Sharpe ratio expected of the best of several trials without any skill.

    Bailey & López de Prado (2014), "The deflated Sharpe ratio":
    √V ((1 − γ) Φ⁻¹(1 − 1/N) + γ Φ⁻¹(1 − 1/(N e))) with the Euler–Mascheroni constant γ; 0 for one
    trial, which involves no selection.

    Args:
        trials: N, every attempt whose result might have been reported.
        variance: V of the trials' Sharpe ratios, per period for a result per period.
    """
    from scipy.special import ndtri

    if trials < 2:
        return 0.0
    tail, further = ndtri(1 - 1 / trials), ndtri(1 - 1 / (trials * math.e))
    return float(math.sqrt(variance) * ((1 - np.euler_gamma) * tail + np.euler_gamma * further))


def deflated_sharpe(
    sharpe: float, periods: int, skewness: float, kurtosis: float, trials: int, variance: float
) -> float:
    """Return the probability that the true Sharpe ratio exceeds the best of N trials without skill.

    Bailey & López de Prado (2014): the probabilistic Sharpe ratio against the expected maximum.
    Arguments as in ``probabilistic_sharpe`` and ``expected_maximum_sharpe``, all per period.
    """
    benchmark = expected_maximum_sharpe(trials, variance)
    return probabilistic_sharpe(sharpe, periods, skewness, kurtosis, benchmark)


def _trial_variance(annual: Sequence[Floats], periods: int, periods_per_year: float) -> float:
    """The variance of the trials' Sharpe ratios per period; annual: those of each agent's seeds.

    At least that of an estimate from normal returns without skill: seeds of one agent are similar,
    and their spread understates what other trials could have found by luck. Differences between
    agents do not count: one that does badly for a reason is no sign that another was lucky.
    """
    known = [np.sort(each) for each in annual if np.isfinite(each).all()]  # in a canonical order
    freedom = sum(len(each) - 1 for each in known)
    luck = 1 / (periods - 1)
    if not freedom:
        return luck
    spread = sum(float(((each - each.mean()) ** 2).sum()) for each in known)
    return max(luck, spread / freedom / periods_per_year)


def _sharpe_variance(sharpe: float, skewness: float, kurtosis: float) -> float:
    """The variance of an estimated Sharpe ratio, times n − 1 (Mertens 2002)."""
    return 1 - skewness * sharpe + (kurtosis - 1) / 4 * sharpe**2


def skewness_and_kurtosis(returns: Floats) -> tuple[float, float]:
    """Skewness and kurtosis, averaged over the rows; 0 and 3 for constant rows."""
    centered = deviations(returns)
    spread = np.sqrt((centered**2).mean(axis=-1))
    still = spread == 0
    score = centered / np.where(still, 1, spread)[..., None]
    return (
        float((score**3).mean(axis=-1).mean()),
        float(np.where(still, 3, (score**4).mean(axis=-1)).mean()),
    )
