"""Signals: numbers for each asset and row, from prices up to that row.

A portfolio's setting ``signals="momentum:252-21,volatility:1m"`` names signals, each with the
number of rows that it looks back on and, after the hyphen, of latest rows that it skips; either may
be a length of time such as ``1y`` (``LENGTHS``). A user's own signal is ``module:Name``, with or
without rows, and ``feature:NAME`` is a column of the table.
Agents observe signals after the log return and the table's own features. By default each signal is
ranked across assets, from −1 to 1, so that nothing has to be fitted; a number that all assets share
is not scaled. docs/concepts/signals.md lists formulas and sources.
"""

import abc
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Bools, Floats, numbers
from qfolio.core.errors import QfolioError
from qfolio.core.fields import static
from qfolio.core.registry import SIGNALS, build
from qfolio.core.text import amount
from qfolio.portfolio.prices.frequency import TRADING_DAYS

COLUMN = "feature:"

LENGTHS = {"d": 1, "w": 5, "m": 21, "y": 252}
"""Rows in a day, a week, a month and a year of a daily table. A slower table has fewer, at least
one; in a faster one, whose prices move on another scale, they are the same numbers of rows."""

CUTS = 12
"""A user's own signal is computed again on a table cut after this many rows of each kind."""

ROUNDING = 1e-9
"""Differences between assets that are smaller than this share of the largest number are none."""

SCALES = ("rank", "z-score", "centered", "raw")
"""How signals are scaled across assets, row by row: ranks from −1 to 1; distances from the mean in
standard deviations, clipped at ±3; distances from the mean; or the numbers themselves."""


class Signal(eqx.Module):
    """A number for each asset and row, which depends on no later row.

    rows: number of rows that it looks back on. skip: number of latest rows that it leaves out.
    """

    shared: ClassVar[bool] = False
    """Whether all assets have the same number, which then has no rank."""
    scale: ClassVar[str | None] = None
    """The one of ``SCALES`` that the signal always uses; None for the portfolio's setting."""

    rows: int = static(21)
    skip: int = static(0)

    def __check_init__(self) -> None:
        if not 0 <= self.skip < self.rows <= 100_000:
            raise QfolioError(
                f"A signal looks back on {amount(self.rows, 'row')} and skips {self.skip}; it must "
                "look back on 1 to 100,000 and skip fewer."
            )

    def __call__(self, prices: Floats) -> Floats:
        """The signal, shape (row, asset), NaN where it is unknown.

        prices: of the same shape, NaN before an asset's first price.
        """
        return self.measure(_before(prices, self.skip), self.rows - self.skip)

    @abc.abstractmethod
    def measure(self, prices: Floats, rows: int) -> Floats:
        """The signal of each row, looking back on ``rows`` rows, with nothing left to skip.

        prices: as known ``skip`` rows before, shape (row, asset), NaN where unknown.
        """


class Momentum(Signal):
    """Log return (Jegadeesh & Titman 1993)."""

    def measure(self, prices: Floats, rows: int) -> Floats:
        logs = np.log(prices)
        return logs - _before(logs, rows)


class Reversal(Momentum):
    """Minus the log return (Jegadeesh 1990; Lehmann 1990)."""

    def measure(self, prices: Floats, rows: int) -> Floats:
        return -super().measure(prices, rows)


class Drift(Signal):
    """Log return over the latest ``skip`` rows, in standard deviations of such a return.

    The standard deviation is that of one-row returns over all ``rows``, times √skip. The signal is
    never ranked: large moves are rare and tell more (Moskowitz, Ooi & Pedersen 2012 scale returns
    in the same way).
    """

    scale = "centered"
    rows: int = static(252)
    skip: int = static(21)

    def __call__(self, prices: Floats) -> Floats:
        return self.measure(prices, self.rows)

    def measure(self, prices: Floats, rows: int) -> Floats:
        latest = max(1, self.skip)
        logs = np.log(prices)
        usual = _deviation(_returns(prices), rows) * np.sqrt(latest)
        return (logs - _before(logs, latest)) / np.where(usual > 0, usual, np.nan)


class Volatility(Signal):
    """Log standard deviation of log returns (Ang, Hodrick, Xing & Zhang 2006)."""

    def measure(self, prices: Floats, rows: int) -> Floats:
        return _log(_deviation(_returns(prices), rows))


class VolatilityRatio(Signal):
    """Log ratio of the volatility over the latest ``skip`` rows to that over all ``rows``."""

    rows: int = static(252)
    skip: int = static(21)

    def __call__(self, prices: Floats) -> Floats:
        return self.measure(prices, self.rows)

    def measure(self, prices: Floats, rows: int) -> Floats:
        returns = _returns(prices)
        return _log(_deviation(returns, max(2, self.skip))) - _log(_deviation(returns, rows))


class High(Signal):
    """Log of the price over its maximum (George & Hwang 2004)."""

    rows: int = static(252)

    def measure(self, prices: Floats, rows: int) -> Floats:
        return np.log(prices / _rolling(prices, rows).max().to_numpy())


class MovingAverage(Signal):
    """Log of the price over its mean (Brock, Lakonishok & LeBaron 1992)."""

    rows: int = static(200)

    def measure(self, prices: Floats, rows: int) -> Floats:
        return np.log(prices / _rolling(prices, rows).mean().to_numpy())


class Maximum(Signal):
    """Largest return of a row (Bali, Cakici & Whitelaw 2011)."""

    def measure(self, prices: Floats, rows: int) -> Floats:
        return _rolling(_returns(prices), rows).max().to_numpy()


class Beta(Signal):
    """Slope of an asset's log returns on the market's, the mean over assets (Sharpe 1964)."""

    rows: int = static(252)

    def measure(self, prices: Floats, rows: int) -> Floats:
        returns = _returns(prices)
        return _slope(returns, _market(returns), rows)


class ResidualVolatility(Signal):
    """Log standard deviation of the residuals of log returns on the market's (Ang et al. 2006)."""

    rows: int = static(252)

    def measure(self, prices: Floats, rows: int) -> Floats:
        returns = _returns(prices)
        market = _market(returns)
        slope = _slope(returns, market, rows)
        total = _deviation(returns, rows) ** 2
        rest = total - slope**2 * _deviation(market, rows) ** 2
        return _log(np.sqrt(np.where(rest > ROUNDING * total, rest, 0)))


class Correlation(Signal):
    """Correlation of an asset's log returns with the mean of the others'."""

    rows: int = static(252)

    def measure(self, prices: Floats, rows: int) -> Floats:
        returns = _returns(prices)
        known = ~np.isnan(returns)
        others = np.nansum(returns, 1, keepdims=True) - np.nan_to_num(returns)
        count = known.sum(1, keepdims=True) - known
        others = np.where(known & (count > 0), others / np.maximum(count, 1), np.nan)
        both = _covariance(returns, others, rows)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = both / (_deviation(returns, rows) * _deviation(others, rows))
        return np.where(np.isfinite(ratio), ratio, np.nan)


class MarketMomentum(Signal):
    """Log return of the market, whose log returns are the mean of the assets' (shared)."""

    shared = True
    rows: int = static(252)

    def measure(self, prices: Floats, rows: int) -> Floats:
        return rows * _rolling(_market(_returns(prices)), rows).mean().to_numpy()


class MarketVolatility(Signal):
    """Log standard deviation of the market's log returns (shared; Moreira & Muir 2017)."""

    shared = True

    def measure(self, prices: Floats, rows: int) -> Floats:
        return _log(_deviation(_market(_returns(prices)), rows))


class Column(Signal):
    """A column of the table, as it is known at each row."""

    name: str = static("")
    rows: int = static(1)

    def measure(self, prices: Floats, rows: int) -> Floats:
        raise AssertionError("compute reads columns from the table")


def parse(text: str, periods_per_year: float = TRADING_DAYS) -> list[Signal]:
    """The signals that a text names, on a table with some rows a year.

    Raises QfolioError if there is no such signal.
    """
    pace = min(1.0, periods_per_year / TRADING_DAYS)
    return [_named(part, pace) for part in labels(text)]


def names(text: str) -> list[str]:
    """The names in such a text, without rows and without columns of the table."""
    return [_split(part, 1.0)[0] for part in labels(text) if not part.startswith(COLUMN)]


def labels(text: str) -> list[str]:
    """The signals in such a text as they are written there, in order."""
    return [part.strip() for part in text.split(",") if part.strip()]


def lookback(signals: Sequence[Signal]) -> int:
    """Number of rows needed before the first one at which all signals are known."""
    return max((signal.rows for signal in signals), default=0)


def compute(
    signals: Sequence[Signal],
    prices: Floats,
    scale: str = "rank",
    columns: Mapping[str, Floats] | None = None,
    tradable: Bools | None = None,
) -> Floats:
    """Signals of shape (row, asset, signal), 0 where one is unknown or repeats an earlier one.

    prices, columns: of shape (row, asset), NaN where unknown. tradable: which assets are compared
    at each row, likewise (default: all); the others' signals are 0.

    Raises QfolioError if the scale or a column is unknown, or if a signal has the wrong shape or
    looks ahead.
    """
    if scale not in SCALES:
        raise QfolioError(f"signal_scale is {scale!r}; it must be one of {', '.join(SCALES)}.")
    values = [
        _column(signal.name, columns or {}) if isinstance(signal, Column)
        else _checked(signal, prices)
        for signal in signals
    ]  # fmt: skip
    shared = [_is_shared(signal, x) for signal, x in zip(signals, values, strict=True)]
    if tradable is not None:
        values = [np.where(tradable, x, np.nan) for x in values]
    found = [
        _scaled(x, same, s.scale or scale)
        for s, x, same in zip(signals, values, shared, strict=True)
    ]
    # On a monthly table, returns over a day, a week and a month are one signal, not three.
    for place, signal in enumerate(signals):
        if signal in signals[:place]:
            found[place] = np.zeros(prices.shape)
    return np.stack(found, -1) if found else np.zeros((*prices.shape, 0))


def _split(text: str, pace: float) -> tuple[str, dict[str, str]]:
    """A signal's name, and its rows and skip if given; pace: rows for each row of a daily table."""
    match = re.fullmatch(r"(.+?)(?::(\d+[dwmy]?)(?:-(\d+[dwmy]?))?)?", text)
    assert match is not None  # anything is a name
    name, *given = match.groups()
    own, _, length = name.partition(":")
    if own in SIGNALS and length[:1].isdigit():  # no class of a module has such a name
        raise QfolioError(
            f"The signal {text} has no length that can be read; write a number of rows or of d, w, "
            f"m or y, such as {own}:21 or {own}:1m, and rows to skip as in {own}:1y-1m."
        )
    rows = [_rows(length, pace) for length in given if length is not None]
    if len(rows) == 2 and given[0][-1] in LENGTHS and pace < 1:
        rows[0] = max(rows[0], rows[1] + 1)  # 1m-1w would be 1-1 on a monthly table
    return name, dict(zip(("rows", "skip"), map(str, rows), strict=False))


def _rows(length: str, pace: float) -> int:
    """The rows of a length such as 21 or 1m."""
    if length[-1] not in LENGTHS:
        return int(length)
    daily = int(length[:-1]) * LENGTHS[length[-1]]
    return max(min(1, daily), round(pace * daily))


def _is_shared(signal: Signal, values: Floats) -> bool:
    """Whether all assets have the same number, as in a column about the whole market."""
    own = isinstance(signal, Column) and np.array_equal(
        values, np.broadcast_to(values[:, :1], values.shape), equal_nan=True
    )
    return signal.shared or own


def _column(name: str, columns: Mapping[str, Floats]) -> Floats:
    if name not in columns:
        raise QfolioError(
            f"The signal {COLUMN}{name} names no column of the table; also list the column in "
            "--features."
        )
    return columns[name]


def _named(text: str, pace: float) -> Signal:
    if text.startswith(COLUMN):
        return Column(name=text.removeprefix(COLUMN))
    name, chosen = _split(text, pace)
    return build("signal", name, chosen)


def _checked(signal: Signal, prices: Floats) -> Floats:
    """The signal; a user's own is computed again without the latest rows."""
    name = type(signal).__name__
    found = numbers(f"The signal {name}", signal(prices))
    if found.shape != prices.shape:
        raise QfolioError(
            f"The signal {name} has the shape {found.shape}; it must be {prices.shape}, one number "
            "for each row and asset."
        )
    if f"{type(signal).__module__}:{name}" not in SIGNALS.values():
        known = np.isfinite(found)
        if len(prices) > signal.rows and not known.any():
            raise QfolioError(
                f"The signal {name} is unknown at each row and for each asset (NaN or infinite); "
                "it must be a number where prices are known."
            )
        for row in _telling(found, prices):
            with warnings.catch_warnings(action="ignore"):  # of what is not known yet
                then = numbers(f"The signal {name}", signal(prices[: row + 1]))
            same = then.shape == (row + 1, prices.shape[1]) and np.isclose(
                then, found[: row + 1], rtol=0, atol=_unit(then), equal_nan=True
            )
            if not np.all(same):
                raise QfolioError(
                    f"The signal {name} looks ahead: its value at row {row} or earlier changes "
                    "when later rows are taken away."
                )
    return found


def _telling(found: Floats, prices: Floats) -> NDArray[np.int64]:
    """Rows after which the table is cut: evenly spaced, and where looking ahead shows most.

    There the signal is largest or moves most, the next prices move most, or they begin or end.
    """
    if len(prices) < 2:
        return np.arange(0)

    def largest(values: Floats) -> NDArray[np.int64]:
        size = np.max(abs(values), 1, initial=0, where=np.isfinite(values))
        return np.argsort(-size[: len(prices) - 1], kind="stable")[:CUTS]

    with np.errstate(invalid="ignore"):
        moved, jumped = found - _before(found, 1), np.diff(np.log(prices), axis=0)
    ends = np.diff(np.isnan(prices), axis=0).astype(float)
    even = np.linspace(0, len(prices) - 2, CUTS).astype(int)
    each = [even, largest(found), largest(moved), largest(jumped), largest(ends)]
    return np.unique(np.concatenate(each))


def _scaled(values: Floats, shared: bool, scale: str) -> Floats:
    values = np.where(np.isfinite(values), values, np.nan)  # one alone would silence all
    if not shared and scale == "rank":
        import pandas as pd

        ranks = pd.DataFrame(np.round(values / _unit(values))).rank(axis=1).to_numpy()
        count = (~np.isnan(values)).sum(1, keepdims=True)
        values = np.where(count > 1, 2 * (ranks - 1) / np.maximum(count - 1, 1) - 1, 0)
    elif not shared and scale in ("z-score", "centered"):
        known, unit = ~np.isnan(values), _unit(values)
        count = np.maximum(known.sum(1, keepdims=True), 1)
        values = values - np.nansum(values, 1, keepdims=True) / count
        if scale == "z-score":
            spread = np.sqrt(np.nansum(values**2, 1, keepdims=True) / count)
            values = np.clip(values / np.where(spread > unit, spread, np.inf), -3, 3)
    return np.nan_to_num(values)


def _unit(values: Floats) -> Floats:
    """The least difference between the numbers of a row that is not rounding, shape (row, 1).

    Two assets, for example, always have the same correlation with each other.
    """
    largest = np.max(abs(values), 1, keepdims=True, initial=0, where=np.isfinite(values))
    return ROUNDING * np.where(largest > 0, largest, 1)


def _before(values: Floats, rows: int) -> Floats:
    """The values a given number of rows earlier; NaN in the first rows."""
    return np.concatenate([np.full((min(rows, len(values)), *values.shape[1:]), np.nan),
                           values[: max(0, len(values) - rows)]])  # fmt: skip


def _returns(prices: Floats) -> Floats:
    """Log returns, NaN in the first row."""
    return np.log(prices) - _before(np.log(prices), 1)


def _market(returns: Floats) -> Floats:
    """The mean over the assets with a known return, repeated for each asset."""
    known = ~np.isnan(returns)
    count = known.sum(1, keepdims=True)
    mean = np.nansum(returns, 1, keepdims=True) / np.maximum(count, 1)
    return np.broadcast_to(np.where(count > 0, mean, np.nan), returns.shape)


def _rolling(values: Floats, rows: int) -> Any:
    import pandas as pd

    return pd.DataFrame(values).rolling(rows, min_periods=rows)


def _covariance(x: Floats, y: Floats, rows: int) -> Floats:
    mean = lambda values: _rolling(values, rows).mean().to_numpy()  # noqa: E731
    unknown = np.where(np.isnan(x) | np.isnan(y), np.nan, 0)
    return mean(x * y) - mean(x + unknown) * mean(y + unknown)


def _deviation(values: Floats, rows: int) -> Floats:
    return _rolling(values, rows).std(ddof=0).to_numpy()


def _slope(returns: Floats, market: Floats, rows: int) -> Floats:
    variance = _deviation(market, rows) ** 2
    return _covariance(returns, market, rows) / np.where(variance > 0, variance, np.nan)


def _log(values: Floats) -> Floats:
    """The logarithm; NaN for 0."""
    return np.log(np.where(values > 0, values, np.nan))
