"""Made-up prices, in memory and as files."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.portfolio.prices.findings import Finding
from qfolio.portfolio.prices.table import Prices, inspect


def days(count: int, start: str = "2020-01-01") -> np.ndarray:
    """Dates without a gap."""
    return np.datetime64(start) + np.arange(count, dtype="m8[D]")


def weekdays(count: int, start: str = "2020-01-01") -> np.ndarray:
    """Dates from Monday to Friday."""
    return np.busday_offset(start, np.arange(count), roll="forward").astype("datetime64[s]")


def random_walk(
    rows: int,
    assets: int = 3,
    seed: int | np.random.Generator = 0,
    drift: float | np.ndarray = 0.0,
    volatility: float | np.ndarray = 0.01,
) -> np.ndarray:
    """Prices that begin near 50."""
    moves = np.random.default_rng(seed).normal(drift, volatility, (rows, assets))
    return np.asarray(50 * np.exp(moves.cumsum(0)))


def price_table(
    values: np.ndarray,
    names: Sequence[str] = "ABCDEFGH",
    dates: np.ndarray | None = None,
    **more: Any,
) -> Prices:
    """A table of prices; without names and dates, of A, B, … on consecutive days."""
    dates = days(len(values)) if dates is None else dates
    return Prices(dates, tuple(names[: values.shape[1]]), values, **more)


def findings(source: Any = None, severity: str | None = None, **options: Any) -> list[Finding]:
    """Findings on a table, of one severity or of all."""
    return [f for f in inspect(source, **options)[1] if severity in (None, f.severity)]


def featured_table(rows: int, features: int, seed: int = 0, drift: float = 0.0) -> Prices:
    """Prices of assets a, b and c with features f0, f1, …."""
    rng = np.random.default_rng(seed)
    values = random_walk(rows, 3, rng, drift, 0.02)
    drawn, names = rng.normal(3, 2, (rows, 3, features)), [f"f{i}" for i in range(features)]
    return price_table(values, "abc", features=drawn, feature_names=tuple(names))


def write_table(
    path: Path,
    rows: int = 260,
    names: Sequence[str] = ("A", "B", "C"),
    scale: float = 1.0,
    seed: int = 0,
) -> Path:
    """A file of prices."""
    values = random_walk(rows, seed=seed, drift=3e-4) * scale
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["date", *names])
        writer.writerows([day, *row] for day, row in zip(days(rows), values.tolist(), strict=True))
    return path
