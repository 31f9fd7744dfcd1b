"""Made-up price tables as files."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.portfolio.prices.findings import Finding
from qfolio.portfolio.prices.table import inspect


def all_findings(source: Any = None, **options: Any) -> list[Finding]:
    """All findings on a table."""
    return inspect(source, **options)[1]


def write_table(
    path: Path,
    rows: int = 260,
    names: Sequence[str] = ("A", "B", "C"),
    scale: float = 1.0,
    seed: int = 0,
) -> Path:
    rng = np.random.default_rng(seed)
    values = 50 * np.exp(np.cumsum(rng.normal(3e-4, 0.01, (rows, 3)), axis=0)) * scale
    dates = np.datetime64("2020-01-01") + np.arange(rows, dtype="m8[D]")
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["date", *names])
        writer.writerows([day, *row] for day, row in zip(dates, values.tolist(), strict=True))
    return path
