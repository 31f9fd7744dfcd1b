"""What a whole backtest shows, and how much of it may be luck: numbers, intervals and sentences.

``measures.py``, ``bootstrap.py`` and ``sharpe.py`` say what each number is. In JSON, infinite and
undefined numbers are null.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.errors import QfolioError
from qfolio.core.statistics import mean_interval
from qfolio.portfolio.backtest.bootstrap import (
    LEVEL,
    block_length,
    bootstrap_measures,
    percentile_interval,
)
from qfolio.portfolio.backtest.measures import (
    MEASURES,
    Floats,
    Range,
    checked_dates,
    checked_track,
    log_growth,
    measures,
    paired_difference,
)
from qfolio.portfolio.backtest.sharpe import (
    deflated_sharpe,
    expected_maximum_sharpe,
    minimum_track_record,
    probabilistic_sharpe,
    skewness_and_kurtosis,
)

MARGIN = 1e-6
"""Of growth a year: less than this is rounding, and no evidence of anything."""

_THIN_SPACE = "\N{NARROW NO-BREAK SPACE}"


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
    days = checked_dates(dates, periods)
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
        scale = log_growth if key == "growth" else np.asarray
        observed = [np.asarray(_mean(scale(each.observed[key]))) for each in (ours, theirs)]
        drawn = [
            np.take_along_axis(scale(each.drawn[key]), each.picks, axis=1).mean(axis=1)
            for each in (ours, theirs)
        ]
        return float(paired_difference(*observed)), _range(paired_difference(*drawn))

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
    moments = skewness_and_kurtosis(returns)
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


def _tracks(
    strategies: Mapping[str, tuple[str, ArrayLike, ArrayLike, ArrayLike]],
) -> dict[str, Floats]:
    """Every strategy as an array (returns, turnover and cost; seeds; periods)."""
    tracks = {}
    for name, (kind, *series) in strategies.items():
        if kind not in ("agent", "baseline"):
            raise QfolioError(f"{name} is of kind {kind!r}; it must be 'agent' or 'baseline'.")
        track = tracks[name] = checked_track(series[0], series[1], series[2], name)
        if track.ndim != 3:
            raise QfolioError(
                f"The returns of {name} have the shape {track.shape[1:]}; "
                f"one row per seed and one column per period is needed."
            )
    if len({track.shape[-1] for track in tracks.values()}) > 1:
        lengths = ", ".join(f"{name} {track.shape[-1]}" for name, track in tracks.items())
        raise QfolioError(f"All strategies must cover the same periods; these are {lengths}.")
    return tracks
