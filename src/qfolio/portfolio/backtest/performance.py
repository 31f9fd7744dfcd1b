"""The measures of track records, their resampling, and Sharpe ratios against luck.

Everything here takes plain arrays of simple returns per period, net of costs, and knows nothing of
agents, prices or folds; ``assessment.py`` puts it together. Three kinds of doubt are kept apart:

- *time*: another stretch of the same market would have looked different. The stationary bootstrap
  (Politis & Romano 1994) draws the days again in blocks, whose mean length follows from the data
  (Politis & White 2004, corrected by Patton, Politis & White 2009). All strategies get the same
  days, so that differences between them are paired;
- *seeds*: another training run would have learned something else (Student's t, or seeds drawn
  again together with the days);
- *trials*: the best of many attempts looks good even where none is (the deflated Sharpe ratio of
  Bailey & López de Prado 2014).

A ratio whose denominator is zero is 0 where its numerator is zero, too (cash earns nothing for no
risk), and infinite otherwise. The volatility and the Sharpe ratio of a single period are not
defined, NaN.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.errors import QfolioError

Floats = NDArray[np.float64]
Range = tuple[float, float]

LEVEL = 0.95
"""Coverage of every interval here, and the level a probability must reach to count as evidence."""

MEASURES = (
    *("growth", "volatility", "sharpe", "sortino"),
    *("drawdown", "calmar", "turnover", "cost_drag"),
)

_CHUNK = 2_000_000  # resampled days held at a time: tens of megabytes, whatever the resamples


# Measures ------------------------------------------------------------------------------------


def measures(
    returns: ArrayLike, turnover: ArrayLike, cost: ArrayLike, periods_per_year: float
) -> dict[str, Floats]:
    """Describe track records by the usual measures, all of them per year.

    Args:
        returns: Simple returns net of costs, shape (..., periods), each at least −1.
        turnover: Value bought plus value sold as a share of the wealth, same shape.
        cost: Share of the wealth that a period's trade cost, at least 0 and below 1, same shape.
        periods_per_year: For example 252 for days of trading.

    Returns:
        One array of shape (...) for each name in ``MEASURES``:

        - growth: geometric mean, as a simple annual rate; a total loss gives −1;
        - volatility: standard deviation (n − 1) of the returns;
        - sharpe: mean over standard deviation, the risk-free rate taken as 0;
        - sortino: mean over the downside deviation, the root mean square of min(return, 0);
        - drawdown: the deepest fall below an earlier peak (or the start), between 0 and 1;
        - calmar: growth over drawdown;
        - turnover: mean times periods per year;
        - cost_drag: growth without costs minus growth with them, where a return without costs is
          (1 + return) / (1 − cost) − 1.

    Raises:
        QfolioError: The shapes differ, or a number is missing, infinite or out of range.
    """
    track = checked_track(returns, turnover, cost)
    deepest = drawdown(track[0]).max(axis=-1)
    centre = track[0].mean(axis=-1)
    moments = _features(track, centre).mean(axis=-1)
    return _measures(moments, deepest, centre, track[0].shape[-1], periods_per_year)


def drawdown(returns: ArrayLike) -> Floats:
    """Return how far the wealth lies below its peak so far, as a share of the peak.

    Args:
        returns: Simple returns of shape (..., periods).

    Returns:
        Numbers between 0 (at the peak) and 1 (all is lost), same shape; the start is a peak.

    Raises:
        QfolioError: A return is missing, infinite or below −1, or there are none.
    """
    wealth = np.cumsum(log_growth(_checked_series("returns", returns)), axis=-1)
    peak = np.maximum(np.maximum.accumulate(wealth, axis=-1), 0)
    return np.abs(np.expm1(wealth - peak))


def monthly(returns: ArrayLike, dates: ArrayLike) -> tuple[list[int], Floats]:
    """Compound returns by calendar month.

    Args:
        returns: Simple returns of shape (..., periods).
        dates: Days on which the returns were earned, shape (periods,), strictly increasing.

    Returns:
        The years from first to last, and a table of shape (..., years, 12), NaN where there is no
        return in a month.

    Raises:
        QfolioError: Returns and dates do not fit together, or are missing or out of range.
    """
    values = _checked_series("returns", returns)
    days = checked_dates(dates, values.shape[-1])
    months = days.astype("datetime64[M]").astype(int)  # since January 1970
    first = np.flatnonzero(np.diff(months, prepend=months[0] - 1))
    years = range(1970 + months[0] // 12, 1970 + months[-1] // 12 + 1)
    table = np.full((*values.shape[:-1], 12 * len(years)), np.nan)
    place = months[first] - 12 * (years[0] - 1970)
    table[..., place] = np.expm1(np.add.reduceat(log_growth(values), first, axis=-1))
    return list(years), table.reshape(*values.shape[:-1], len(years), 12)


def _features(track: Floats, centre: Floats) -> Floats:
    """What has to be averaged over time for every measure but the drawdown: (7, ..., periods)."""
    returns, turnover, cost = track
    deviation = returns - centre[..., None]  # centred, or the variance would lose its digits
    ruined = returns == -1
    log_net = np.log1p(np.where(ruined, 0, returns))
    log_free = log_net - np.log1p(-cost)
    downside = np.minimum(returns, 0) ** 2
    return np.stack([deviation, deviation**2, downside, log_net, log_free, ruined, turnover])


def _measures(
    moments: Floats, deepest: Floats, centre: Floats, periods: int, periods_per_year: float
) -> dict[str, Floats]:
    deviation, square, downside, log_net, log_free, ruined, turnover = moments
    mean = centre + deviation
    variance = square - deviation**2
    rounding = 1e-14 * square + 1e-24 * mean**2  # what remains of equal returns
    variance = np.where(variance > rounding, variance, 0)
    bessel = periods / (periods - 1) if periods > 1 else math.nan
    with np.errstate(over="ignore", invalid="ignore"):
        growth, free = (
            np.where(ruined > 0, -1, np.expm1(periods_per_year * log))
            for log in (log_net, log_free)
        )
        drag = free - growth
    annual = math.sqrt(periods_per_year)
    spread = np.sqrt(bessel * variance)
    return {
        "growth": growth,
        "volatility": annual * spread,
        "sharpe": annual * _ratio(mean, spread),
        "sortino": annual * _ratio(mean, np.sqrt(downside)),
        "drawdown": deepest,
        "calmar": _ratio(growth, deepest),
        "turnover": periods_per_year * turnover,
        "cost_drag": drag,
    }


def _ratio(above: ArrayLike, below: ArrayLike) -> Floats:
    above, below = np.broadcast_arrays(above, below)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((above == 0) & (below == 0), 0.0, np.divide(above, below))


def paired_difference(first: Floats, second: Floats) -> Floats:
    """First less second; 0 where both lost everything or rounding cannot tell them apart."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isclose(first, second, rtol=0, atol=1e-12), 0.0, first - second)


def _centred(values: Floats) -> Floats:
    """Deviations from the mean over the last axis, exactly 0 where all values are equal."""
    scale = np.abs(values).max(axis=-1, keepdims=True)
    deviation = values - values.mean(axis=-1, keepdims=True)
    return np.where(np.abs(deviation) > 1e-12 * scale, deviation, 0)


def log_growth(returns: Floats) -> Floats:
    """Of simple returns; −∞ for a total loss."""
    with np.errstate(divide="ignore"):
        return np.log1p(returns)


# Resampling time -----------------------------------------------------------------------------


def block_length(series: ArrayLike) -> float:
    """Choose the mean block length of the stationary bootstrap from a series' autocorrelation.

    Politis & White (2004), "Automatic block-length selection for the dependent bootstrap", with
    the correction of Patton, Politis & White (2009): b = (2 G² / D · n)^⅓ with D = 2 g(0)², where
    g(0) and G sum R(k) and |k| R(k) under a flat-top window. The window ends at twice the lag
    after which five autocorrelations in a row stay within ±2 √(log10 n / n).

    Args:
        series: Numbers of shape (n,).

    Returns:
        The length, from 1 (independent days) to min(3 √n, n / 3).
    """
    values = np.asarray(series, dtype=float)
    count = values.size
    longest = max(1.0, math.ceil(min(3 * math.sqrt(count), count / 3)))
    centred = _centred(values)
    if count < 3 or not centred.any():
        return 1.0
    run = max(5, math.ceil(math.sqrt(math.log10(count))))
    lags = min(math.ceil(math.sqrt(count)) + run, count - 1)
    covariance = np.array([centred[k:] @ centred[: count - k] for k in range(lags + 1)]) / count
    small = np.abs(covariance) < 2 * math.sqrt(math.log10(count) / count) * covariance[0]
    quiet = (m for m in range(lags - run + 1) if small[m + 1 : m + 1 + run].all())
    window = min(2 * max(next(quiet, lags), 1), lags)
    k = np.arange(1, window + 1)
    weights = 2 * np.minimum(1, 2 * (1 - k / window)) * covariance[1 : window + 1]
    spectrum = covariance[0] + weights.sum()  # g(0)
    slope = k @ weights  # G
    return float(np.clip((_ratio(slope, spectrum) ** 2 * count) ** (1 / 3), 1, longest))


def stationary_bootstrap_indices(
    periods: int, block: float, resamples: int, rng: np.random.Generator
) -> NDArray[np.int32]:
    """Draw the days of resampled histories: blocks of geometric length, in a circle.

    Politis & Romano (1994), "The stationary bootstrap": each day follows the one before with
    probability 1 − 1/block, and is any day otherwise; the first day follows the last.

    Args:
        periods: How many days there are.
        block: The mean length of a block, at least 1; at 1 the days are independent draws.
        resamples: How many histories to draw.
        rng: Source of randomness.

    Returns:
        Indices of shape (resamples, periods).
    """
    shape = (resamples, periods)
    day = np.arange(periods, dtype=np.int32)
    jump = rng.random(shape, dtype=np.float32) * np.float32(block) < 1
    begun = np.maximum.accumulate(
        np.where(jump, day, 0), axis=1
    )  # when the block began; the first at 0
    # Where a block began we draw its distance from the calendar; within the block it stays.
    shift = np.take_along_axis(rng.integers(periods, size=shape, dtype=np.int32), begun, axis=1)
    shift += day
    return np.where(shift >= periods, shift - np.int32(periods), shift)


def bootstrap_measures(
    returns: ArrayLike,
    turnover: ArrayLike,
    cost: ArrayLike,
    periods_per_year: float,
    block: float,
    resamples: int,
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """Compute ``measures`` on histories drawn again by the stationary bootstrap.

    The same days are drawn for all series. Averages over a resampled history need only how often
    each day was drawn, so they are one matrix product; the drawdown alone follows the order.

    Args:
        returns, turnover, cost: As in ``measures``, shape (series, periods), at least two periods.
        periods_per_year: As in ``measures``.
        block, resamples, rng: As in ``stationary_bootstrap_indices``.

    Returns:
        One array of shape (resamples, series) for each name in ``MEASURES``.
    """
    track = checked_track(returns, turnover, cost)
    series, periods = track[0].shape
    centre = track[0].mean(axis=-1)
    features = _features(track, centre).reshape(-1, periods).T
    steps = np.ascontiguousarray(log_growth(track[0]).T)
    chunk = max(1, _CHUNK // periods)
    parts = []
    for start in range(0, resamples, chunk):
        size = min(chunk, resamples - start)
        days = stationary_bootstrap_indices(periods, block, size, rng)
        cells = days + periods * np.arange(size)[:, None]
        counts = np.bincount(cells.ravel(), minlength=size * periods).reshape(size, periods)
        moments = (counts.astype(float) @ features / periods).reshape(size, -1, series)
        parts.append(
            _measures(
                moments.swapaxes(0, 1), _deepest(steps, days), centre, periods, periods_per_year
            )
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in MEASURES}


def percentile_interval(samples: Floats, level: float = LEVEL) -> tuple[Floats, Floats]:
    """Return the middle part of the samples along the first axis, bounded by two of them."""
    count = len(samples)
    tail = max(math.floor((count + 1) * (1 - level) / 2), 1)
    ordered = np.sort(samples, axis=0)  # no interpolation: an end may be infinite
    return ordered[tail - 1], ordered[count - tail]


def _deepest(steps: Floats, days: NDArray[np.int32]) -> Floats:
    """The maximum drawdown of every resampled history.

    Goes through time once, for all histories and series at a time, and keeps no history: below
    its peak, log wealth follows depth ← min(depth + log return, 0).

    Args:
        steps: Log returns of shape (periods, series).
        days: Of shape (resamples, periods).
    """
    depth = np.zeros((len(days), steps.shape[1]))
    deepest, step = np.zeros_like(depth), np.empty_like(depth)
    for today in np.ascontiguousarray(days.T):
        np.take(steps, today, axis=0, out=step, mode="clip")
        depth += step
        np.minimum(depth, 0, out=depth)
        np.minimum(deepest, depth, out=deepest)
    return np.abs(np.expm1(deepest))


# Sharpe ratios and luck ----------------------------------------------------------------------
#
# Every Sharpe ratio in these formulas is per period, never annual: an annual one would count each
# period as a whole year of evidence.


def probabilistic_sharpe(
    sharpe: float, periods: int, skewness: float, kurtosis: float, benchmark: float = 0.0
) -> float:
    """Return the probability that the true Sharpe ratio exceeds a benchmark.

    Bailey & López de Prado (2012), "The Sharpe ratio efficient frontier":
    Φ((SR − SR*) √(n − 1) / √(1 − γ₃ SR + (γ₄ − 1)/4 SR²)).

    Args:
        sharpe: Observed Sharpe ratio per period, not annual.
        periods: How many returns it was computed from.
        skewness: γ₃ of the returns, 0 for normal ones.
        kurtosis: γ₄ of the returns, 3 for normal ones.
        benchmark: SR*, per period.
    """
    from scipy.special import ndtr

    if math.isinf(sharpe):
        return float(sharpe > 0)
    error = math.sqrt(max(_sharpe_variance(sharpe, skewness, kurtosis), 0))
    return float(ndtr(_ratio((sharpe - benchmark) * math.sqrt(periods - 1), error)))


def minimum_track_record(
    sharpe: float, skewness: float, kurtosis: float, benchmark: float = 0.0, level: float = LEVEL
) -> float:
    """Return how many periods it takes until the probabilistic Sharpe ratio reaches a level.

    Bailey & López de Prado (2012): 1 + (1 − γ₃ SR + (γ₄ − 1)/4 SR²) (z / (SR − SR*))², infinite
    where the Sharpe ratio does not exceed the benchmark. Arguments as in ``probabilistic_sharpe``.
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
    trial, which nobody has picked.

    Args:
        trials: N, every attempt whose result might have been reported.
        variance: V of the trials' Sharpe ratios; per period if the result is to be so.
    """
    from scipy.special import ndtri

    if trials < 2:
        return 0.0
    tail, further = ndtri(1 - 1 / trials), ndtri(1 - 1 / (trials * math.e))
    return float(math.sqrt(variance) * ((1 - np.euler_gamma) * tail + np.euler_gamma * further))


def deflated_sharpe(
    sharpe: float, periods: int, skewness: float, kurtosis: float, trials: int, variance: float
) -> float:
    """Return the probability that a Sharpe ratio exceeds what the best of N trials owes to luck.

    Bailey & López de Prado (2014): the probabilistic Sharpe ratio against the expected maximum.
    Arguments as in ``probabilistic_sharpe`` and ``expected_maximum_sharpe``, all per period.
    """
    benchmark = expected_maximum_sharpe(trials, variance)
    return probabilistic_sharpe(sharpe, periods, skewness, kurtosis, benchmark)


def _sharpe_variance(sharpe: float, skewness: float, kurtosis: float) -> float:
    """Times n − 1: the variance of an estimated Sharpe ratio (Mertens 2002)."""
    return 1 - skewness * sharpe + (kurtosis - 1) / 4 * sharpe**2


def skewness_and_kurtosis(returns: Floats) -> tuple[float, float]:
    """Skewness and kurtosis, averaged over the rows; those of a normal where nothing varies."""
    centred = _centred(returns)
    spread = np.sqrt((centred**2).mean(axis=-1))
    still = spread == 0
    score = centred / np.where(still, 1, spread)[..., None]
    return (
        float((score**3).mean(axis=-1).mean()),
        float(np.where(still, 3, (score**4).mean(axis=-1)).mean()),
    )


# Checks --------------------------------------------------------------------------------------


def checked_track(
    returns: ArrayLike, turnover: ArrayLike, cost: ArrayLike, who: str = "the track record"
) -> Floats:
    """Returns, turnover and cost stacked: (3, ..., periods), or a QfolioError."""
    series = {"returns": returns, "turnover": turnover, "cost": cost}
    arrays = [_checked_series(name, values, who) for name, values in series.items()]
    if len({array.shape for array in arrays}) > 1:
        raise QfolioError(
            f"Returns, turnover and cost of {who} must have the same shape; "
            f"theirs are {', '.join(str(array.shape) for array in arrays)}."
        )
    return np.stack(arrays)


# The least and the greatest value; rounding may leave a turnover or a cost a hair below zero.
_BOUNDS = {"returns": (-1.0, 1e100), "turnover": (-1e-9, 1e100), "cost": (-1e-9, 1 - 1e-9)}


def _checked_series(name: str, values: ArrayLike, who: str = "the track record") -> Floats:
    """Numbers within their bounds, at least one along the last axis, or a QfolioError."""
    try:
        array = np.asarray(values, dtype=float)
    except (ValueError, TypeError):
        raise QfolioError(f"The {name} of {who} must be a table of numbers.") from None
    if array.ndim == 0 or array.size == 0:
        raise QfolioError(f"The {name} of {who} are empty; at least one period is needed.")
    if not np.isfinite(array).all():
        raise QfolioError(f"The {name} of {who} hold missing or infinite numbers; remove them.")
    low, high = _BOUNDS[name]
    if array.min() < low or array.max() > high:
        raise QfolioError(
            f"The {name} of {who} range from {array.min():g} to {array.max():g}; returns must be "
            f"at least −1, turnover at least 0, cost at least 0 and below 1."
        )
    return array


def checked_dates(dates: ArrayLike, periods: int) -> NDArray[np.datetime64]:
    try:
        days = np.asarray(dates, dtype="datetime64[s]")
    except (ValueError, TypeError):
        raise QfolioError("The dates must be days such as 2004-12-31.") from None
    if days.shape != (periods,) or periods == 0:
        raise QfolioError(
            f"There are {periods} returns and dates of shape {days.shape}; "
            f"each return needs its date."
        )
    if np.isnat(days).any() or (days[1:] <= days[:-1]).any():
        raise QfolioError("The dates must be given for every return and increase strictly.")
    return days
