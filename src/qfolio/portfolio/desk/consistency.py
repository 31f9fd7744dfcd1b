"""Whether live returns are still those that a backtest promised, tested at every row.

The test bets against live returns x, clipped to a range that holds nearly all of the backtest's and
divided by its width. Its capital is K = mean over bets b of Π (1 + b (m − x)), where m is a lower
confidence limit of the backtest's mean. As long as the expectation of x given the past is at least
m, K is a nonnegative supermartingale, whatever the variance. By Ville's inequality, K ever reaches
2/α with a probability of at most α/2; m is too high with a probability of α/2. So an alarm is false
with a probability of at most α, however often one looks (I. Waudby-Smith and A. Ramdas, "Estimating
means of bounded random variables by betting", 2024). Both bounds hold for returns whose expectation
does not depend on the past; where it does, they are approximate.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.bootstrap import (
    block_length,
    stationary_bootstrap_indices,
)
from qfolio.portfolio.market import RUIN

ALPHA = 0.05
"""Probability of a false alarm, over all time."""

ALARM = 2 / ALPHA
"""The evidence at which the alarm is given."""

TAIL = 0.005
"""Share of the backtest's returns that is clipped at each end."""

BETS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Shares of the largest bet that keeps the capital positive."""

RESAMPLES = 2000


@dataclass(frozen=True)
class Promise:
    """What a backtest's returns promise of live ones.

    low, high: the range to which returns are clipped. least: lower confidence limit of the mean of
    clipped returns.
    """

    low: float
    high: float
    least: float

    @staticmethod
    def of(
        tested: ArrayLike, rng: np.random.Generator, promises: int = 1, resamples: int = RESAMPLES
    ) -> "Promise":
        """The promise of a backtest's net returns, shape (T,); its limit is bootstrapped.

        promises: how many are tested together, of which none may be wrong.
        """
        returns = np.asarray(tested, dtype=float)
        low, high = np.quantile(returns, (TAIL, 1 - TAIL))
        cut = np.clip(returns, low, high)
        block = block_length(cut)
        days = stationary_bootstrap_indices(len(cut), block, resamples, rng)
        least = np.quantile(cut[days].mean(1), ALPHA / 2 / promises)
        return Promise(float(low), float(high), float(least))


def evidence(promise: Promise, live: ArrayLike) -> Floats:
    """Evidence against the promise after each live return, shape (n,); 1 is none. See ``ALARM``."""
    width = promise.high - promise.low
    if width <= 0:
        return np.ones(np.shape(live))
    lost = (promise.least - np.clip(live, promise.low, promise.high)) / width
    largest = width / max(promise.high - promise.least, 1e-12 * width)
    bets = largest * np.array(BETS)[:, None]
    return np.asarray(np.cumprod(1 + bets * lost, axis=1).mean(0))


def together(parts: list[Floats]) -> Floats:
    """The evidence of several tests: their mean, which is evidence itself (Vovk & Wang 2021)."""
    return np.asarray(np.mean(parts, axis=0))


def band(tested: ArrayLike, rows: int, rng: np.random.Generator) -> Floats:
    """Growth of wealth over the rows to come, if their returns are like the backtest's.

    Returns:
        Growth factors of shape (3, rows): the 2.5%, 50% and 97.5% quantiles over histories drawn by
        the stationary bootstrap.
    """
    returns = np.asarray(tested, dtype=float)
    block = block_length(returns)
    draws = -(-rows // len(returns))
    days = [stationary_bootstrap_indices(len(returns), block, RESAMPLES, rng) for _ in range(draws)]
    logs = np.log(np.where(returns == -1, RUIN, 1 + returns))
    paths = np.cumsum(logs[np.concatenate(days, 1)[:, :rows]], axis=1)
    return np.asarray(np.exp(np.quantile(paths, (0.025, 0.5, 0.975), axis=0)))
