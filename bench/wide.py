"""What surrounds training, on tables of 20 to 1,000 assets: reading, baselines, replay, statistics.

Prints processor seconds for made-up tables of 5,000 daily rows (20 years). Baselines are timed on
one year of the test; a default backtest has 15 of them.
"""

import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time
from typing import TypeVar

import numpy as np

from made_up import table, written
from qfolio.core.registry import BASELINES, short
from qfolio.portfolio.backtest.attribution.factors import factor_returns
from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.backtest.bound import constant_bound
from qfolio.portfolio.backtest.folds import walk_forward
from qfolio.portfolio.backtest.orders import orders
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.costs import with_cash
from qfolio.portfolio.prices.table import Prices, load

ROWS = 5000

T = TypeVar("T")

found: dict[str, list[float]] = {}
"""Seconds by name, one for each table."""


def read(assets: int, place: Path) -> Prices:
    """A made-up table, written as CSV and read from it."""
    path = written(table(assets, ROWS), place / f"{assets}.csv")
    return timed("reading", lambda: load(path))


def timed(name: str, work: Callable[[], T]) -> T:
    begun = process_time()
    result = work()
    found.setdefault(name, []).append(process_time() - begun)
    return result


def measure(prices: Prices) -> None:
    values, month = prices.values, prices.month
    folds = walk_forward(prices.dates, "5y", "1y", 1, expanding=True)
    middle = folds[len(folds) // 2]
    for name in BASELINES:
        made = baseline(name)
        asked = partial(orders, name, made, [middle], prices.dates, values, month=month)
        timed(f"{short(name)}, a year", asked)
    equal = np.full((1, ROWS - 1300, values.shape[1] + 1), 1 / (values.shape[1] + 1))
    timed("replay", lambda: simulate(values, equal, first=1290, cost=0.001))
    timed("factors", lambda: factor_returns(values, folds, 1, 252))
    growth = with_cash(values[1290:] / values[1289:-1])
    timed("bound", lambda: constant_bound(growth, 252))


def main() -> None:
    sizes = [int(each) for each in sys.argv[1:]] or [20, 100, 500, 1000]
    with tempfile.TemporaryDirectory() as place:
        for size in sizes:
            measure(read(size, Path(place)))
    print(f"{'assets':<32}" + "".join(f"{size:>10,}" for size in sizes))
    for name, seconds in found.items():
        print(f"{name:<32}" + "".join(f"{each:9.2f}s" for each in seconds))


if __name__ == "__main__":
    main()
