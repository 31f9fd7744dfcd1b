"""What a backtest shows, and how much of it may be luck.

Everything here takes plain arrays of simple returns per period, net of costs, and knows nothing of
agents, prices or folds. Three kinds of doubt are kept apart:

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
defined, NaN. In JSON, infinite and undefined numbers are null.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.errors import QfolioError
from qfolio.statistics import mean_interval

Floats = NDArray[np.float64]
Range = tuple[float, float]

LEVEL = 0.95

MARGIN = 1e-6
"""Of growth a year: less than this is rounding, and no evidence of anything."""

"""Coverage of every interval here, and the level a probability must reach to count as evidence."""

MEASURES = (
    *("growth", "volatility", "sharpe", "sortino"),
    *("drawdown", "calmar", "turnover", "cost_drag"),
)

_CHUNK = 2_000_000  # resampled days held at a time: tens of megabytes, whatever the resamples
_THIN_SPACE = "\N{NARROW NO-BREAK SPACE}"


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
    track = _checked(returns, turnover, cost)
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
    wealth = np.cumsum(_log(_checked_series("returns", returns)), axis=-1)
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
    days = _checked_dates(dates, values.shape[-1])
    months = days.astype("datetime64[M]").astype(int)  # since January 1970
    first = np.flatnonzero(np.diff(months, prepend=months[0] - 1))
    years = range(1970 + months[0] // 12, 1970 + months[-1] // 12 + 1)
    table = np.full((*values.shape[:-1], 12 * len(years)), np.nan)
    place = months[first] - 12 * (years[0] - 1970)
    table[..., place] = np.expm1(np.add.reduceat(_log(values), first, axis=-1))
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


def _difference(first: Floats, second: Floats) -> Floats:
    """Exactly 0 where both lost everything, or where rounding cannot tell them apart."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isclose(first, second, rtol=0, atol=1e-12), 0.0, first - second)


def _centred(values: Floats) -> Floats:
    """Deviations from the mean over the last axis, exactly 0 where all values are equal."""
    scale = np.abs(values).max(axis=-1, keepdims=True)
    deviation = values - values.mean(axis=-1, keepdims=True)
    return np.where(np.abs(deviation) > 1e-12 * scale, deviation, 0)


def _log(returns: Floats) -> Floats:
    with np.errstate(divide="ignore"):  # a total loss: −∞
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
    track = _checked(returns, turnover, cost)
    series, periods = track[0].shape
    centre = track[0].mean(axis=-1)
    features = _features(track, centre).reshape(-1, periods).T
    steps = np.ascontiguousarray(_log(track[0]).T)
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


def _shape(returns: Floats) -> tuple[float, float]:
    """Skewness and kurtosis, averaged over the rows; those of a normal where nothing varies."""
    centred = _centred(returns)
    spread = np.sqrt((centred**2).mean(axis=-1))
    still = spread == 0
    score = centred / np.where(still, 1, spread)[..., None]
    return (
        float((score**3).mean(axis=-1).mean()),
        float(np.where(still, 3, (score**4).mean(axis=-1)).mean()),
    )


# Sentences -----------------------------------------------------------------------------------


def verdict(agent: str, reference: str, difference: float, low: float, high: float) -> str:
    """Say in words what an interval of the difference in annual log growth shows.

    Only an interval that lies wholly on one side of zero, by more than ``MARGIN``, is evidence; one
    that touches it is none.

    Args:
        agent: Whose growth it is.
        reference: What it is compared to.
        difference: Growth of the agent minus that of the reference, as a fraction.
        low: Lower end of the 95 % interval.
        high: Upper end.
    """
    if low > MARGIN:
        finding = f"{agent} beats {reference} after costs"
    elif high < -MARGIN:
        finding = f"{agent} falls short of {reference} after costs"
    else:
        finding = f"No evidence that {agent} beats {reference} after costs"
    # As many digits as it takes to tell an end from zero, since the sentence hangs on its sign.
    ends = [abs(100 * end) for end in (low, high) if end and math.isfinite(end)]
    digits = next((d for d in range(1, 7) if all(round(end, d) for end in ends)), 7)
    middle, left, right = (
        f"{_number(100 * value, digits, sign=True)}{_THIN_SPACE}%"
        for value in (difference, low, high)
    )
    return (
        f"{finding}: the difference in annual growth is {middle} "
        f"(95{_THIN_SPACE}% interval {left} to {right})."
    )


def luck(agent: str, sharpe: float, threshold: float, deflated: float, trials: int) -> str:
    """Say in words what a deflated Sharpe ratio shows.

    It answers whether there is a return for the risk at all, after picking among trials. Whether
    an agent is better than a baseline is another question, which ``verdict`` answers.

    Args:
        agent: Whose Sharpe ratio it is.
        sharpe: The annual Sharpe ratio.
        threshold: The annual Sharpe ratio expected of the best of the trials without skill.
        deflated: The probability that the true Sharpe ratio exceeds the threshold.
        trials: How many trials were counted.
    """
    bar = "zero"
    if trials > 1:
        bar = f"{threshold:.2f}, what the best of {trials} trials without skill shows on average,"
    chance = float(np.floor(1000 * deflated) / 10)  # rounded down: 94.96 must not read as 95.0
    finding = "is more than luck is likely to explain"
    shortfall = ""
    if not deflated >= LEVEL:
        finding, shortfall = "may be luck", f", less than the usual 95{_THIN_SPACE}%"
    return (
        f"The Sharpe ratio of {agent}, {_number(sharpe, 2)} a year, {finding}: the probability "
        f"that the true one exceeds {bar} is {_number(chance, 1)}{_THIN_SPACE}%{shortfall}."
    )


def _number(value: float, digits: int, sign: bool = False) -> str:
    if math.isnan(value):
        return "undefined"
    text = "∞" if math.isinf(value) else f"{abs(value):.{digits}f}"
    if not text.strip("0."):
        return text
    return ("\N{MINUS SIGN}" if value < 0 else "+" if sign else "") + text


# The whole -----------------------------------------------------------------------------------


class Strategy(NamedTuple):
    """The track records of one strategy over the test days, one row per seed.

    A baseline that draws nothing at random has one row.
    """

    kind: str  # "agent" or "baseline"
    returns: ArrayLike  # (seeds, periods), simple, net of costs
    turnover: ArrayLike  # (seeds, periods), bought plus sold over wealth
    cost: ArrayLike  # (seeds, periods), share of the wealth


@dataclasses.dataclass(frozen=True)
class Measure:
    """One measure of one strategy, with both of its 95 % intervals."""

    mean: float  # over seeds
    per_seed: tuple[float, ...]
    over_time: Range  # stationary bootstrap of the mean over seeds
    over_seeds: Range | None  # Student's t of the mean; none for one seed


@dataclasses.dataclass(frozen=True)
class Difference:
    """A strategy minus a reference on the same days, with 95 % intervals over days and seeds."""

    reference: str
    growth: float  # of annual log growth
    growth_interval: Range
    sharpe: float  # of annual Sharpe ratios
    sharpe_interval: Range
    verdict: str


@dataclasses.dataclass(frozen=True)
class SharpeTest:
    """How likely a Sharpe ratio is to be more than luck; moments are means over the seeds."""

    skewness: float
    kurtosis: float  # 3 for a normal distribution
    probabilistic: float  # probability that the true Sharpe ratio exceeds zero
    minimum_years: float  # track record needed until that probability reaches 95 %; may be inf
    threshold: float  # annual Sharpe ratio expected of the best trial if none has any skill
    deflated: float  # probability that the true Sharpe ratio exceeds the threshold
    sentence: str


@dataclasses.dataclass(frozen=True)
class StrategyAssessment:
    """All that is known of one strategy."""

    kind: str
    seeds: int
    measures: dict[str, Measure]  # by the names in MEASURES
    to_reference: Difference | None  # none for the reference itself
    to_best_baseline: Difference | None  # none for the best baseline itself
    sharpe_test: SharpeTest


@dataclasses.dataclass(frozen=True)
class Assessment:
    """The statistics of a whole backtest, in plain numbers."""

    first_date: str  # of the first and the last return, year-month-day
    last_date: str
    periods: int
    periods_per_year: float
    level: float  # of all intervals
    resamples: int
    block_length: float  # mean, in periods
    trials: int  # agents times seeds, and those that were reported beside
    reference: str
    best_baseline: str  # by its Sharpe ratio over the same days
    strategies: dict[str, StrategyAssessment]

    def to_json(self) -> dict[str, Any]:
        """Return dictionaries, lists, texts and finite numbers; other numbers become None."""
        plain: dict[str, Any] = _plain(dataclasses.asdict(self))
        return plain


@np.errstate(invalid="ignore")  # the mean of opposite infinities is not defined
def assess(
    strategies: Mapping[str, Strategy | tuple[str, ArrayLike, ArrayLike, ArrayLike]],
    dates: ArrayLike,
    *,
    periods_per_year: float,
    reference: str = "equal weight",
    other_trials: int = 0,
    resamples: int = 2000,
    seed: int = 0,
) -> Assessment:
    """Compute every statistic of a backtest.

    Differences are to a reference and to the best baseline, the one with the highest Sharpe ratio
    over the very days of the test. Nobody could have chosen it beforehand, so that comparison
    favours the baseline and is conservative for an agent. Their intervals come from drawing days
    and, independently for each strategy, its seeds: S − 1 of S with replacement, since S of S would
    understate the variance of the mean by the factor (S − 1)/S (McCarthy & Snowden 1985).

    One block length serves all strategies, since they share the resampled days: the longest that
    their returns (mean over seeds) or squared returns ask for. Squares persist for months, and
    shorter blocks would make volatility and drawdown look more certain than they are.

    Equal arguments give equal results, and the order of a strategy's seeds does not matter.

    Args:
        strategies: A name for each, at least one baseline among them; all on the same days.
        dates: Days on which the returns were earned, shape (periods,), strictly increasing.
        periods_per_year: For example 252 for days of trading.
        reference: The name of the baseline to compare with in the first place.
        other_trials: How many more trials there were on these days. Every seed of every agent is
            counted already.
        resamples: How many histories the bootstrap draws.
        seed: Seed of the drawing.

    Raises:
        QfolioError: Shapes do not fit, numbers are missing or out of range, there are fewer than
            two periods, or the reference is no baseline.
    """
    tracks = _tracks(strategies)
    baselines = [name for name, entry in strategies.items() if entry[0] == "baseline"]
    if reference not in baselines:
        raise QfolioError(
            f"{reference!r} is not among the baselines, so nothing can be compared with it; "
            f"there are: {', '.join(baselines) or 'none'}."
        )
    periods = tracks[reference].shape[-1]
    days = _checked_dates(dates, periods)
    if periods < 2 or resamples < 1 or not periods_per_year > 0:
        raise QfolioError(
            f"The statistics of a backtest need at least two periods and one resample, and a "
            f"positive number of periods per year; these are {periods}, {resamples} and "
            f"{periods_per_year}."
        )
    # All seeds of all strategies side by side, so that they get the same days.
    rng = np.random.default_rng(seed)
    table = np.concatenate([_canonical(track) for track in tracks.values()], axis=1)
    block = _common_block([_canonical(track)[0].mean(axis=0) for track in tracks.values()])
    drawn = bootstrap_measures(
        table[0], table[1], table[2], periods_per_year, block, resamples, rng
    )
    sampled, end = {}, 0
    for name, track in tracks.items():
        seeds = track.shape[1]
        start, end = end, end + seeds
        sampled[name] = _Sampled(
            measures(track[0], track[1], track[2], periods_per_year),
            {key: values[:, start:end] for key, values in drawn.items()},
            rng.integers(seeds, size=(resamples, max(seeds - 1, 1))),
        )

    best = max(baselines, key=lambda name: _mean(sampled[name].observed["sharpe"]))
    agents = [name for name in tracks if name not in baselines]
    trials = other_trials + sum(tracks[name].shape[1] for name in agents)
    known = [sharpe for name in agents for sharpe in sampled[name].observed["sharpe"]]
    variance = _trial_variance(known, periods, periods_per_year)

    def compare(name: str, other: str) -> Difference | None:
        return None if name == other else _compare(name, sampled[name], other, sampled[other])

    return Assessment(
        first_date=str(days[0].astype("datetime64[D]")),
        last_date=str(days[-1].astype("datetime64[D]")),
        periods=periods,
        periods_per_year=float(periods_per_year),
        level=LEVEL,
        resamples=resamples,
        block_length=block,
        trials=trials,
        reference=reference,
        best_baseline=best,
        strategies={
            name: StrategyAssessment(
                kind=strategies[name][0],
                seeds=track.shape[1],
                measures={key: _measure(sampled[name], key) for key in MEASURES},
                to_reference=compare(name, reference),
                to_best_baseline=compare(name, best),
                sharpe_test=_sharpe_test(
                    name,
                    _canonical(track)[0],
                    _mean(sampled[name].observed["sharpe"]),
                    trials if name in agents else 1,  # nobody searched among baselines' seeds
                    variance,
                    periods_per_year,
                ),
            )
            for name, track in tracks.items()
        },
    )


class _Sampled(NamedTuple):
    """The measures of one strategy by seed, as observed and as drawn again."""

    observed: dict[str, Floats]  # (seeds,)
    drawn: dict[str, Floats]  # (resamples, seeds): the same days for all
    picks: NDArray[np.int64]  # (resamples, seeds drawn): which seeds, if they are drawn, too


def _measure(strategy: _Sampled, key: str) -> Measure:
    values = strategy.observed[key]
    several = values.size > 1 and bool(np.isfinite(values).all())
    return Measure(
        mean=_mean(values),
        per_seed=tuple(values.tolist()),
        over_time=_range(strategy.drawn[key].mean(axis=1)),
        over_seeds=mean_interval(np.sort(values), LEVEL) if several else None,
    )


def _compare(name: str, ours: _Sampled, other: str, theirs: _Sampled) -> Difference:
    def difference(key: str) -> tuple[float, Range]:
        scale = _log if key == "growth" else np.asarray
        observed = [np.asarray(_mean(scale(each.observed[key]))) for each in (ours, theirs)]
        drawn = [
            np.take_along_axis(scale(each.drawn[key]), each.picks, axis=1).mean(axis=1)
            for each in (ours, theirs)
        ]
        return float(_difference(*observed)), _range(_difference(*drawn))

    growth, growth_interval = difference("growth")
    sharpe, sharpe_interval = difference("sharpe")
    sentence = verdict(name, other, growth, *growth_interval)
    return Difference(other, growth, growth_interval, sharpe, sharpe_interval, sentence)


def _sharpe_test(
    name: str,
    returns: Floats,
    sharpe: float,
    trials: int,
    variance: float,
    periods_per_year: float,
) -> SharpeTest:
    """For returns of shape (seeds, periods) and their mean annual Sharpe ratio."""
    year = math.sqrt(periods_per_year)
    periods = returns.shape[1]
    moments = _shape(returns)
    threshold = year * expected_maximum_sharpe(trials, variance)
    deflated = deflated_sharpe(sharpe / year, periods, *moments, trials, variance)
    return SharpeTest(
        *moments,
        probabilistic=probabilistic_sharpe(sharpe / year, periods, *moments),
        minimum_years=minimum_track_record(sharpe / year, *moments) / periods_per_year,
        threshold=threshold,
        deflated=deflated,
        sentence=luck(name, sharpe, threshold, deflated, trials),
    )


def _trial_variance(annual: list[float], periods: int, periods_per_year: float) -> float:
    """The variance of the trials' Sharpe ratios per period.

    At least that of an estimate from normal returns without skill: seeds of one agent are alike,
    and their spread says too little of what other trials could have found by luck.
    """
    known = np.sort(annual)  # so that the order of the seeds cannot move the last digit
    luck = 1 / (periods - 1)
    if len(known) < 2 or not np.isfinite(known).all():
        return luck
    return max(luck, float(np.var(known, ddof=1) / periods_per_year))


def _common_block(series: list[Floats]) -> float:
    """The longest block that any of the series or its squared deviations asks for."""
    return max(
        max(block_length(values), block_length((values - values.mean()) ** 2)) for values in series
    )


def _canonical(track: Floats) -> Floats:
    """Seeds in an order that follows from their numbers alone: (3, seeds, periods)."""
    return track[:, sorted(range(track.shape[1]), key=lambda seed: track[:, seed].tobytes())]


def _mean(values: Floats) -> float:
    return float(np.sort(values).mean())


def _range(samples: Floats) -> Range:
    low, high = percentile_interval(samples)
    return float(low), float(high)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# Checks --------------------------------------------------------------------------------------


def _tracks(
    strategies: Mapping[str, tuple[str, ArrayLike, ArrayLike, ArrayLike]],
) -> dict[str, Floats]:
    """Every strategy as an array (returns, turnover and cost; seeds; periods)."""
    tracks = {}
    for name, (kind, *series) in strategies.items():
        if kind not in ("agent", "baseline"):
            raise QfolioError(f"{name} is of kind {kind!r}; it must be 'agent' or 'baseline'.")
        track = tracks[name] = _checked(series[0], series[1], series[2], name)
        if track.ndim != 3:
            raise QfolioError(
                f"The returns of {name} have the shape {track.shape[1:]}; "
                f"one row per seed and one column per period is needed."
            )
    if len({track.shape[-1] for track in tracks.values()}) > 1:
        lengths = ", ".join(f"{name} {track.shape[-1]}" for name, track in tracks.items())
        raise QfolioError(f"All strategies must cover the same periods; these are {lengths}.")
    return tracks


def _checked(
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


def _checked_dates(dates: ArrayLike, periods: int) -> NDArray[np.datetime64]:
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
