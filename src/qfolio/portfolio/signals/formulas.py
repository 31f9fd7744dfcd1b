"""The library of signals; docs/concepts/signals.md lists formulas and sources."""

from typing import Any

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.fields import static
from qfolio.portfolio.signals.base import ROUNDING, Signal, before


class Momentum(Signal):
    """Log return (Jegadeesh & Titman 1993)."""

    def measure(self, prices: Floats, rows: int) -> Floats:
        logs = np.log(prices)
        return logs - before(logs, rows)


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
        return (logs - before(logs, latest)) / np.where(usual > 0, usual, np.nan)


class Volatility(Signal):
    """Log standard deviation of log returns, of at least two (Ang, Hodrick, Xing & Zhang 2006)."""

    def measure(self, prices: Floats, rows: int) -> Floats:
        return _log(_deviation(_returns(prices), max(2, rows)))


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
        return _log(_deviation(_market(_returns(prices)), max(2, rows)))


def _returns(prices: Floats) -> Floats:
    """Log returns, NaN in the first row."""
    return np.log(prices) - before(np.log(prices), 1)


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
    """The standard deviation; 0 where all values are equal, up to rounding."""
    window = _rolling(values, rows)
    found, mean = np.array(window.std(ddof=0)), window.mean().to_numpy()
    # Its running sums leave a residue of earlier values, which extremes do not.
    if (few := (found < 1e-6 * abs(mean)).any(0)).any():
        some = _rolling(values[:, few], rows)
        spread = (some.max() - some.min()).to_numpy()
        found[:, few] = np.where(spread > ROUNDING * abs(mean[:, few]), found[:, few], 0 * spread)
    return found


def _slope(returns: Floats, market: Floats, rows: int) -> Floats:
    variance = _deviation(market, rows) ** 2
    return _covariance(returns, market, rows) / np.where(variance > 0, variance, np.nan)


def _log(values: Floats) -> Floats:
    """The logarithm; NaN for 0."""
    return np.log(np.where(values > 0, values, np.nan))
