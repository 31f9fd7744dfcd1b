"""An estimate of the memory that a backtest's arrays need, before any of them is made.

Training has a check of its own, ``devices.require_memory``.
"""

from collections.abc import Sequence

from qfolio.core import devices, settings
from qfolio.core.errors import QfolioError
from qfolio.core.text import amount
from qfolio.portfolio.backtest.attribution.replays import AT_ONCE
from qfolio.portfolio.backtest.baselines.equal_weight import SPEEDS
from qfolio.portfolio.backtest.folder import BacktestConfig
from qfolio.portfolio.backtest.folds import walk_forward
from qfolio.portfolio.backtest.statistics.bootstrap import CHUNK, TOGETHER
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

MENTIONED = 2**30
"""Number of bytes from which a user is told beforehand."""


def needed(prices: Prices, config: BacktestConfig) -> int:
    """About how many bytes a backtest has in memory at once, besides those that training takes."""
    folds = walk_forward(prices.dates, config.train, config.test, config.lag, config.expanding)
    days = sum(fold.days for fold in folds)
    channels = [
        Portfolio.blank(
            len(prices.assets),
            len(prices.feature_names),
            **settings.convert(Portfolio, dict(entry.task)),
        ).center.size
        for entry in config.agents.values()
    ]
    others = len(config.baselines) + len(config.strategies) + len(SPEEDS)
    return total(len(prices), days, len(prices.assets), channels, config.seeds, others)


def total(
    rows: int, days: int, assets: int, channels: Sequence[int], seeds: int, others: int
) -> int:
    """The number of bytes, from the sizes of everything.

    Args:
        rows: Rows of the price table.
        days: Days of the test.
        assets: Assets in the table.
        channels: Number of channels of an asset that an agent observes, an entry for each agent.
        seeds: Number of agents of each kind.
        others: Number of strategies that are not trained.
    """
    table, path = rows * assets, days * (assets + 1)
    values = 3 * 8 * table  # prices as read, as relatives, and as baselines see them
    observed = 4 * table * sum(channels)  # float32, on the device
    made = 3 * 8 * table * max(channels)  # float64, while signals are computed
    followed = len(channels) * (seeds + (seeds > 1)) + others
    replayed = 2 * 8 * path * (followed + len(channels))  # decisions, weights, and their means
    explained = 2 * 4 * 2 * path * AT_ONCE  # targets and holdings of replays, and joined ones
    judged = 2 * 8 * 13 * days * followed  # what statistics average over days, and a copy
    judged += 40 * max(TOGETHER * days, CHUNK)  # resampled days: numbers, draws and counts
    return values + observed + max(made, replayed + max(explained, judged))


def require(prices: Prices, config: BacktestConfig) -> None:
    """Raises QfolioError if the machine has less memory than the backtest needs."""
    there, wanted = devices.host_memory(), needed(prices, config)
    if there is not None and wanted > there:
        raise QfolioError(
            f"A backtest of {len(prices.assets):,} assets on {len(prices):,} rows with "
            f"{amount(config.seeds, 'seed')} needs about {wanted / 2**30:,.1f} GiB of "
            f"memory, but only {there / 2**30:,.1f} are there; give fewer assets, rows, "
            "agents, signals, baselines or seeds."
        )
