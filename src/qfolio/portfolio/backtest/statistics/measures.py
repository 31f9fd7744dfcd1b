"""The measures of track records: growth, volatility, ratios, drawdown, turnover, cost drag."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError

Range = tuple[float, float]

MEASURES = (
    *("growth", "volatility", "sharpe", "sortino"),
    *("drawdown", "calmar", "turnover", "cost_drag"),
)


STEADY = 10.0
"""A strategy this many times as volatile as another is not compared with it: as with cash, whose
interest alone fluctuates, a ratio to it would say nothing."""


# Measures ------------------------------------------------------------------------------------


def measures(
    returns: ArrayLike,
    turnover: ArrayLike,
    cost: ArrayLike,
    periods_per_year: float,
    risk_free: ArrayLike | None = None,
) -> dict[str, Floats]:
    """Compute the usual measures of track records, annualized.

    Args:
        returns: Simple returns net of costs, shape (..., periods), each at least −1.
        turnover: Value bought plus value sold, over wealth, same shape.
        cost: Share of wealth that a period's trade cost, at least 0 and below 1, same shape.
        periods_per_year: For example 252 for trading days.
        risk_free: Returns of cash, shape (periods,) (default: 0).

    Returns:
        One array of shape (...) for each name in ``MEASURES``:

        - growth: geometric mean, as a simple annual rate; a total loss gives −1;
        - volatility: standard deviation (n − 1) of the returns;
        - sharpe: mean over standard deviation, of returns in excess of cash;
        - sortino: mean over the downside deviation, the root mean square of min(return, 0), of
          returns in excess of cash;
        - drawdown: the maximum drawdown from an earlier peak (or the start), between 0 and 1;
        - calmar: growth over drawdown;
        - turnover: mean times periods per year;
        - cost_drag: growth without costs minus growth with them, where a return without costs is
          (1 + return) / (1 − cost) − 1.

    Raises:
        QfolioError: The shapes differ, or a number is missing, infinite or out of range.
    """
    track = checked_track(returns, turnover, cost)
    free = checked_risk_free(risk_free, track[0].shape[-1])
    deepest = drawdown(track[0]).max(axis=-1)
    center = track[0].mean(axis=-1)
    moments = per_period(track, center, free).mean(axis=-1)
    return from_moments(moments, deepest, center, free, track[0].shape[-1], periods_per_year)


def drawdown(returns: ArrayLike) -> Floats:
    """Return the drawdown: how far wealth is below its running peak, as a share of the peak.

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


def per_period(track: Floats, center: Floats, free: Floats | None) -> Floats:
    """Quantities whose means over time give all measures but the drawdown: (7, ..., periods).

    With returns of cash there are 9, and the downside is that of returns in excess of cash.
    """
    returns, turnover, cost = track
    deviation = returns - center[..., None]  # centered, or the variance would lose precision
    ruined = returns == -1
    log_net = np.log1p(np.where(ruined, 0, returns))
    log_free = log_net - np.log1p(-cost)
    downside = np.minimum(returns if free is None else returns - free, 0) ** 2
    found = [deviation, deviation**2, downside, log_net, log_free, ruined, turnover]
    if free is not None:
        over = deviation - (free - free.mean())
        found += [over, over**2]
    return np.stack(found)


def from_moments(
    moments: Floats,
    deepest: Floats,
    center: Floats,
    free: Floats | None,
    periods: int,
    periods_per_year: float,
) -> dict[str, Floats]:
    """The measures from the means of ``per_period`` and the maximum drawdowns."""
    deviation, square, downside, log_net, log_free, ruined, turnover, *of_excess = moments
    bessel = periods / (periods - 1) if periods > 1 else math.nan
    spread = np.sqrt(bessel * _variance(square, deviation, center))
    excess, excess_spread = center + deviation, spread
    if free is not None:
        over, over_square = of_excess
        excess = center - free.mean() + over
        excess = np.where(np.abs(excess) > 1e-12 * np.abs(center), excess, 0)  # cash itself
        excess_spread = np.sqrt(bessel * _variance(over_square, over, center))
    with np.errstate(over="ignore", invalid="ignore"):
        growth, uncharged = (
            np.where(ruined > 0, -1, np.expm1(periods_per_year * log))
            for log in (log_net, log_free)
        )
        drag = uncharged - growth
    annual = math.sqrt(periods_per_year)
    return {
        "growth": growth,
        "volatility": annual * spread,
        "sharpe": annual * ratio_or_zero(excess, excess_spread),
        "sortino": annual * ratio_or_zero(excess, np.sqrt(downside)),
        "drawdown": deepest,
        "calmar": ratio_or_zero(growth, deepest),
        "turnover": periods_per_year * turnover,
        "cost_drag": drag,
    }


def before_costs(returns: ArrayLike, cost: ArrayLike) -> Floats:
    """Simple returns without the costs of the trades before them, which are shares of the wealth.

    Net returns stay as they are where the cost is not known (NaN).
    """
    return np.asarray((1 + np.asarray(returns)) / (1 - np.nan_to_num(cost)) - 1)


def _variance(square: Floats, deviation: Floats, center: Floats) -> Floats:
    """The mean of squared deviations, exactly 0 where only rounding is left of equal returns."""
    variance = square - deviation**2
    rounding = 1e-14 * square + 1e-24 * (center + deviation) ** 2
    return np.where(variance > rounding, variance, 0)


def ratio_or_zero(above: ArrayLike, below: ArrayLike) -> Floats:
    """A ratio, which is 0 for 0/0 and infinite for other divisions by 0."""
    above, below = np.broadcast_arrays(above, below)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((above == 0) & (below == 0), 0.0, np.divide(above, below))


def paired_difference(first: Floats, second: Floats) -> Floats:
    """First minus second; 0 if both lost everything or differ by rounding only."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isclose(first, second, rtol=0, atol=1e-12), 0.0, first - second)


def deviations(values: Floats) -> Floats:
    """Deviations from the mean over the last axis, exactly 0 where all values are equal."""
    scale = np.abs(values).max(axis=-1, keepdims=True)
    deviation = values - values.mean(axis=-1, keepdims=True)
    return np.where(np.abs(deviation) > 1e-12 * scale, deviation, 0)


def log_growth(returns: Floats) -> Floats:
    """Log growth of simple returns; −∞ for a total loss."""
    with np.errstate(divide="ignore"):
        return np.log1p(returns)


def growth_at(multiple: float, returns: Floats, cost: Floats, periods_per_year: float) -> float:
    """Annual growth of the same orders if every cost had been a multiple of what it was.

    It is exact up to the square of a cost, because orders are shares of the wealth.

    Args:
        multiple: 1 gives the growth after costs, 0 that without costs.
        returns: Simple returns net of costs, of shape (seeds, periods).
        cost: Costs as shares of the wealth, of the same shape.
        periods_per_year: For example 252 for trading days.

    Returns:
        The mean over the seeds.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        paid = np.log1p(-np.minimum(multiple * cost, 1.0)) - np.log1p(-cost)
    logs = np.where(returns == -1, -np.inf, log_growth(returns) + paid)
    return float(np.expm1(periods_per_year * logs.mean(axis=-1)).mean())


def deepest_drawdown(steps: Floats, days: NDArray[np.int32]) -> Floats:
    """The maximum drawdown of every resampled history.

    It goes through time once, for all histories and series together, and stores no path: relative
    to its peak, log wealth follows depth ← min(depth + log return, 0).

    Args:
        steps: Log returns of shape (periods, series).
        days: Drawn days, of shape (resamples, periods).
    """
    depth = np.zeros((len(days), steps.shape[1]))
    deepest, step = np.zeros_like(depth), np.empty_like(depth)
    for today in np.ascontiguousarray(days.T):
        np.take(steps, today, axis=0, out=step, mode="clip")
        depth += step
        np.minimum(depth, 0, out=depth)
        np.minimum(deepest, depth, out=deepest)
    return np.abs(np.expm1(deepest))


# Checks --------------------------------------------------------------------------------------


def checked_track(
    returns: ArrayLike, turnover: ArrayLike, cost: ArrayLike, who: str = "the track record"
) -> Floats:
    """Returns, turnover and cost, stacked to shape (3, ..., periods).

    Raises QfolioError if the shapes differ, or a number is missing or out of range."""
    series = {"returns": returns, "turnover": turnover, "cost": cost}
    arrays = [_checked_series(name, values, who) for name, values in series.items()]
    if len({array.shape for array in arrays}) > 1:
        raise QfolioError(
            f"Returns, turnover and cost of {who} must have the same shape; "
            f"theirs are {', '.join(str(array.shape) for array in arrays)}."
        )
    return np.stack(arrays)


def checked_risk_free(risk_free: ArrayLike | None, periods: int) -> Floats | None:
    """The returns of cash, of shape (periods,); None if there are none."""
    if risk_free is None:
        return None
    free = _checked_series("returns", risk_free, "cash")
    if free.shape != (periods,):
        raise QfolioError(
            f"There are {periods} returns and risk-free returns of shape {free.shape}; each return "
            "needs one."
        )
    return free if free.any() else None


# Smallest and largest values; rounding may leave a turnover or a cost slightly below zero.
_BOUNDS = {"returns": (-1.0, 1e100), "turnover": (-1e-9, 1e100), "cost": (-1e-9, 1 - 1e-9)}


def _checked_series(name: str, values: ArrayLike, who: str = "the track record") -> Floats:
    """Checked numbers; raises QfolioError if there are none, or one is missing or out of range."""
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
    """Dates of shape (periods,); raises QfolioError unless they increase strictly."""
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
