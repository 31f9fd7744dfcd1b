"""The statistics of a whole backtest: measures, intervals and tests.

``measures.py``, ``bootstrap.py``, ``estimates.py`` and ``sharpe.py`` define each number,
``verdict.py`` states the conclusions in words. In JSON, infinite and undefined numbers are null.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.core.text import finite
from qfolio.portfolio.backtest.statistics.bootstrap import (
    LEVEL,
    block_length,
    bootstrap_measures,
)
from qfolio.portfolio.backtest.statistics.differences import Difference, Rival, compare
from qfolio.portfolio.backtest.statistics.measures import (
    checked_dates,
    checked_risk_free,
    checked_track,
    measures,
)
from qfolio.portfolio.backtest.statistics.relative import (
    RELATIVE,
    active_share,
    bootstrap_relative,
    relative,
)
from qfolio.portfolio.backtest.statistics.sampled import Measure, Sampled, mean_over_seeds
from qfolio.portfolio.backtest.statistics.sharpe import SharpeTest, sharpe_tests

KINDS = ("agent", "ensemble", "strategy", "baseline", "rebalancing")
"""An ensemble is all seeds of an agent, traded as one. A strategy is of the user's own; as the
reference it is a baseline. A rebalancing is the reference at another speed of rebalancing."""

JUDGED = ("agent", "ensemble", "strategy")
"""The kinds that are tested."""

CLASSICAL = ("baseline", "strategy")
"""The kinds whose best are compared with."""


class Strategy(NamedTuple):
    """The track records of one strategy over the test days, one row per seed.

    A deterministic baseline has one row, and so does an ensemble.
    """

    kind: str  # one of KINDS
    returns: ArrayLike  # (seeds, periods), simple, net of costs
    turnover: ArrayLike | None  # (seeds, periods), bought plus sold over wealth; None if unknown
    cost: ArrayLike | None  # (seeds, periods), share of the wealth; None if unknown
    weights: Floats | None = None  # (seeds, periods, N + 1), cash first; None if unknown


@dataclasses.dataclass(frozen=True)
class StrategyAssessment:
    """The statistics of one strategy."""

    kind: str
    seeds: int
    measures: dict[str, Measure]  # by the names in MEASURES
    to_reference: Difference | None  # None for the reference itself
    to_rebalanced: Difference | None  # None for itself, or if only one speed was replayed
    to_best_baseline: Difference | None  # None for itself, or if the reference is the best
    to_best_sharpe: Difference | None  # None for itself, or if it is one of the others
    sharpe_test: SharpeTest
    active_test: SharpeTest | None  # of the returns less those of ``rebalanced``; None for itself
    relative: dict[str, Measure]  # to the reference, by the names in RELATIVE; empty for itself


@dataclasses.dataclass(frozen=True)
class Assessment:
    """The statistics of a whole backtest."""

    first_date: str  # of the first and the last return, year-month-day
    last_date: str
    periods: int
    periods_per_year: float
    level: float  # of all intervals
    resamples: int
    block_length: float  # mean, in periods
    trials: int  # every seed of every agent, ensembles, own strategies, and earlier trials
    earlier_trials: int
    comparisons: int  # number that Holm's correction counts
    reference: str
    rebalanced: str  # the reference or its rebalancing, whichever grew most over the same days
    best_baseline: str  # or a user's own strategy, whichever grew most over the same days
    best_sharpe: str  # likewise, whichever had the highest Sharpe ratio
    strategies: dict[str, StrategyAssessment]
    bound: float | None = None  # annual growth that no constant weights exceed, even without costs

    def to_json(self) -> dict[str, Any]:
        """The statistics as JSON values; numbers that are not finite become None."""
        plain: dict[str, Any] = finite(dataclasses.asdict(self))
        return plain


@np.errstate(invalid="ignore")  # the mean of opposite infinities is not defined
def assess(
    strategies: Mapping[str, Strategy | tuple[str, ArrayLike, ArrayLike, ArrayLike]],
    dates: ArrayLike,
    *,
    periods_per_year: float,
    reference: str,
    earlier_trials: int = 0,
    resamples: int = 2000,
    seed: int = 0,
    risk_free: ArrayLike | None = None,
) -> Assessment:
    """Compute every statistic of a backtest.

    Agents, ensembles and strategies of the user's own are compared with a reference, with the
    rebalancing of the reference that grew most over the days of the test, with the baseline or
    other strategy that grew most, and with the one that had the highest Sharpe ratio; see
    ``differences.py``.

    All strategies share the resampled days and so one block length: the longest that their returns
    (mean over seeds) or squared returns require. Squared returns are autocorrelated for months, and
    shorter blocks would make intervals of volatility and drawdown too narrow.

    Equal arguments give equal results, and the order of a strategy's seeds does not matter.

    Args:
        strategies: The strategies by name, with at least one baseline; all on the same days.
        dates: Days on which the returns were earned, shape (periods,), strictly increasing.
        periods_per_year: For example 252 for trading days.
        reference: The name of the baseline chosen in advance for comparison.
        earlier_trials: Number of earlier trials on these days, in addition to every seed of every
            agent, every ensemble and every strategy of the user's own.
        resamples: Number of histories that the bootstrap draws.
        seed: Seed of the bootstrap.
        risk_free: Returns of cash, shape (periods,), which Sharpe and Sortino ratios subtract
            (default: 0).

    Raises:
        QfolioError: Shapes do not fit, numbers are missing or out of range, there are fewer than
            two periods, or the reference is not a baseline.
    """
    known = {name: Strategy(*entry) for name, entry in strategies.items()}
    tracks = _tracks(known)
    baselines = [name for name, entry in known.items() if entry.kind == "baseline"]
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
            f"positive number of periods per year; they are {periods}, {resamples} and "
            f"{periods_per_year}."
        )
    free = checked_risk_free(risk_free, periods)
    returns = {name: _canonical(track)[0] for name, track in tracks.items()}
    block = _common_block([each.mean(axis=0) for each in returns.values()])
    sampled = _sampled(tracks, periods_per_year, free, block, resamples, seed)

    def mean(key: str, name: str) -> float:
        return mean_over_seeds(sampled[name].observed[key])

    growth, sharpe = partial(mean, "growth"), partial(mean, "sharpe")
    family = (reference, *(name for name, each in known.items() if each.kind == "rebalancing"))
    classical = tuple(name for name, each in known.items() if each.kind in CLASSICAL)
    rebalanced, best = max(family, key=growth), max(classical, key=growth)
    best_sharpe = max(classical, key=sharpe)
    judged = [name for name, each in known.items() if each.kind in JUDGED]
    trials = earlier_trials + sum(len(returns[name]) for name in judged)
    ratios = {name: each.observed["sharpe"] for name, each in sampled.items()}
    tests = sharpe_tests(_less(returns, free), ratios, judged, trials, periods_per_year)
    theirs = returns[rebalanced].mean(axis=0)
    ratios = {
        name: relative(each, theirs, periods_per_year)["information_ratio"]
        for name, each in returns.items()
    }
    active_tests = sharpe_tests(_less(returns, theirs), ratios, judged, trials, periods_per_year)
    compared = _relative(known, tracks, reference, periods_per_year, block, resamples, seed)
    rivals = _rivals(reference, rebalanced, family, best, best_sharpe, classical)
    differences = compare(returns, rivals, judged, periods_per_year, seed, free, earlier_trials)

    return Assessment(
        first_date=str(days[0].astype("datetime64[D]")),
        last_date=str(days[-1].astype("datetime64[D]")),
        periods=periods,
        periods_per_year=float(periods_per_year),
        level=LEVEL,
        resamples=resamples,
        block_length=block,
        trials=trials,
        earlier_trials=earlier_trials,
        comparisons=sum(
            contrast.p is not None
            for named in differences.values()
            for difference in named.values()
            for contrast in difference.contrasts().values()
        ),
        reference=reference,
        rebalanced=rebalanced,
        best_baseline=best,
        best_sharpe=best_sharpe,
        strategies={
            name: StrategyAssessment(
                kind=known[name].kind,
                seeds=len(returns[name]),
                measures=sampled[name].measures(unknown=known[name].turnover is None),
                to_reference=differences["reference"].get(name),
                to_rebalanced=differences.get("rebalanced", {}).get(name),
                to_best_baseline=differences.get("best", {}).get(name),
                to_best_sharpe=differences.get("best sharpe", {}).get(name),
                sharpe_test=tests[name],
                active_test=None if name == rebalanced else active_tests[name],
                relative=compared.get(name, {}),
            )
            for name in known
        },
    )


def _sampled(
    tracks: Mapping[str, Floats],
    periods_per_year: float,
    free: Floats | None,
    block: float,
    resamples: int,
    seed: int,
) -> dict[str, Sampled]:
    """The measures of all seeds of all strategies together, so that they share resampled days."""
    given = np.concatenate(list(tracks.values()), axis=1)
    ordered = np.concatenate([_canonical(track) for track in tracks.values()], axis=1)
    rng = np.random.default_rng(seed)
    drawn = bootstrap_measures(
        ordered[0], ordered[1], ordered[2], periods_per_year, block, resamples, rng, free
    )
    observed = measures(given[0], given[1], given[2], periods_per_year, free)
    return Sampled(observed, drawn).split({name: each.shape[1] for name, each in tracks.items()})


def _rivals(
    reference: str,
    rebalanced: str,
    family: tuple[str, ...],
    best: str,
    best_sharpe: str,
    classical: tuple[str, ...],
) -> dict[str, Rival]:
    """What strategies are compared with, by its role; one that has two roles is there once.

    family: the reference and its rebalancings. classical: what the best are chosen from.
    """
    rivals = {"reference": Rival(reference, (reference,))}
    if len(family) > 1:
        rivals["rebalanced"] = Rival(rebalanced, family)
    if best != reference:
        one = best == best_sharpe
        rivals["best"] = Rival(best, classical, ("growth", "sharpe") if one else ("growth",))
    if best_sharpe not in (reference, best):
        rivals["best sharpe"] = Rival(best_sharpe, classical, ("sharpe",))
    return rivals


def _less(returns: Mapping[str, Floats], other: Floats | None) -> dict[str, Floats]:
    """Returns less others on the same days, if there are any."""
    return {name: each if other is None else each - other for name, each in returns.items()}


def _relative(
    strategies: Mapping[str, Strategy],
    tracks: Mapping[str, Floats],
    reference: str,
    periods_per_year: float,
    block: float,
    resamples: int,
    seed: int,
) -> dict[str, dict[str, Measure]]:
    """Measures relative to the reference, by strategy; not for itself and its rebalancings."""
    names = [
        name
        for name, each in strategies.items()
        if name != reference and each.kind != "rebalancing"
    ]
    if not names:
        return {}
    theirs, held = tracks[reference][0].mean(axis=0), strategies[reference].weights
    returns = [tracks[name][0] for name in names]
    shares = [
        np.full_like(ours, np.nan)
        if weights is None or held is None
        else np.stack([active_share(each, held[0]) for each in weights])
        for ours, weights in ((tracks[name][0], strategies[name].weights) for name in names)
    ]
    observed = relative(np.concatenate(returns), theirs, periods_per_year, np.concatenate(shares))
    # With the seeds in their canonical order, as above.
    orders = [_seed_order(tracks[name]) for name in names]
    returns, shares = (
        [each[order] for each, order in zip(tables, orders, strict=True)]
        for tables in (returns, shares)
    )
    drawn = bootstrap_relative(
        np.concatenate(returns),
        theirs,
        periods_per_year,
        np.concatenate(shares),
        block,
        resamples,
        seed,
    )
    parts = Sampled(observed, drawn).split({name: tracks[name].shape[1] for name in names})
    return {
        name: {key: sampled.measure(key) for key in RELATIVE} for name, sampled in parts.items()
    }


def _common_block(series: list[Floats]) -> float:
    """The longest block that any of the series or its squared deviations requires."""
    return max(
        max(block_length(values), block_length((values - values.mean()) ** 2)) for values in series
    )


def _canonical(track: Floats) -> Floats:
    """A track with its seeds sorted by their values, shape (3, seeds, periods)."""
    return track[:, _seed_order(track)]


def _seed_order(track: Floats) -> list[int]:
    return sorted(range(track.shape[1]), key=lambda seed: track[:, seed].tobytes())


def _tracks(
    strategies: Mapping[str, Strategy],
) -> dict[str, Floats]:
    """Every strategy as an array (returns, turnover and cost; seeds; periods); 0 if not known."""
    tracks = {}
    for name, each in strategies.items():
        if each.kind not in KINDS:
            raise QfolioError(f"{name} is of kind {each.kind!r}; it must be {' or '.join(KINDS)}.")
        nothing = np.zeros_like(np.asarray(each.returns, float))
        turnover, cost = (nothing if x is None else x for x in (each.turnover, each.cost))
        track = tracks[name] = checked_track(each.returns, turnover, cost, name)
        if track.ndim != 3:
            raise QfolioError(
                f"The returns of {name} have the shape {track.shape[1:]}; "
                f"it must have one row per seed and one column per period."
            )
    if len({track.shape[-1] for track in tracks.values()}) > 1:
        lengths = ", ".join(f"{name} {track.shape[-1]}" for name, track in tracks.items())
        raise QfolioError(f"All strategies must cover the same periods; these are {lengths}.")
    return tracks
