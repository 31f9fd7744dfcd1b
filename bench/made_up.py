"""Made-up price tables for benchmarks."""

import numpy as np

from qfolio.portfolio.prices.table import Prices


def table(assets: int, rows: int) -> Prices:
    """Daily prices of one common factor and as much noise."""
    rng = np.random.default_rng(0)
    moves = 2e-4 + 0.01 * (rng.normal(size=(rows, 1)) + rng.normal(size=(rows, assets)))
    days = np.busday_offset("2000-01-03", np.arange(rows), roll="forward").astype("datetime64[s]")
    return Prices(days, tuple(f"A{i}" for i in range(assets)), 50 * np.exp(np.cumsum(moves, 0)))
