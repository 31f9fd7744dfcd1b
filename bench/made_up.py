"""Made-up price tables for benchmarks."""

from pathlib import Path

import numpy as np

from qfolio.portfolio.prices.table import Prices

MINUTES = 390
"""In a trading day."""


def table(assets: int, rows: int, *, daily: bool = True) -> Prices:
    """Prices of one common factor and as much noise, of each business day or of each minute."""
    rng = np.random.default_rng(0)
    moves = 2e-4 + 0.01 * (rng.normal(size=(rows, 1)) + rng.normal(size=(rows, assets)))
    day, minute = np.arange(rows), np.zeros(rows, int)
    if not daily:
        moves /= MINUTES**0.5
        day, minute = np.divmod(day, MINUTES)
    days = np.busday_offset("2000-01-03", day, roll="forward").astype("datetime64[s]")
    dates = days + (60 * minute).astype("timedelta64[s]")
    return Prices(dates, tuple(f"A{i}" for i in range(assets)), 50 * np.exp(np.cumsum(moves, 0)))


def written(made: Prices, path: Path) -> Path:
    """The file of prices to which a table was written as CSV."""
    with path.open("w") as file:
        file.write(",".join(["date", *made.assets]) + "\n")
        for time, row in zip(made.dates, made.values, strict=True):
            file.write(f"{time}," + ",".join(f"{value:.6f}" for value in row) + "\n")
    return path
