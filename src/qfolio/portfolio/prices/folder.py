"""Joins the tables of a folder, such as one file of bars for each asset, into one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.findings import LISTED, Findings, day
from qfolio.portfolio.prices.grid import Grid, check_currencies
from qfolio.portfolio.prices.reading import PARQUET_FILES, TEXT_FILES
from qfolio.portfolio.prices.vocabulary import kind


def join(
    folder: Path, read: Callable[[Path], tuple[Grid, Findings]], channels: tuple[str, ...]
) -> tuple[Any, Findings]:
    """A long data frame of all tables in a folder, and findings, such as the tables' warnings.

    Cells that are empty in a table stay empty: what they are depends on the other tables.

    read: gives the cells of one of them. An asset that its file does not name takes the name of the
    file. channels: names of the grids' features.

    Raises:
        QfolioError: A table has errors, or the folder has none.
    """
    import pandas as pd

    known = (*TEXT_FILES, *PARQUET_FILES)
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in known)
    if not files:
        raise QfolioError(f"{quote(folder, 300)} is a folder without tables (.csv or .parquet).")
    parts, findings, tables = [], Findings(), []
    for file in files:
        grid, found = read(file)
        tables.append((grid.table, grid.prices.columns))
        findings += [
            replace(finding, message=f"in {quote(file.name)}: {finding.message}")
            for finding in found
            if finding.severity == "warning"
        ]
        for j, name in enumerate(grid.assets):
            columns = {
                "date": grid.dates,
                "ticker": np.full(len(grid.dates), file.stem if kind(name) else name, dtype=object),
                "close": grid.prices.values[:, j],
            }
            for channel, block in zip(channels, grid.features, strict=True):
                columns[channel] = block.values[:, j if block.by_asset else 0]
            parts.append(pd.DataFrame(columns))
    shorter = [table for table, _ in tables if table.left_out]
    for table in shorter[:LISTED]:
        findings.note(f"of {quote(table.source)}, {table.left_out}")
    findings.others("note", len(shorter), "file", " with lines that are left out")
    together = Findings()
    check_currencies(tables, together)
    for finding in together:  # a file that has them all is named already
        if not any(one.message.endswith(finding.message) for one in findings):
            findings.append(finding)
    frame = pd.concat(parts, ignore_index=True)
    filled = frame.iloc[:, 2:].notna().any(axis=1)
    frame = frame[filled | ~frame.duplicated(["date", "ticker"], keep=False)]
    some = filled[frame.index].groupby(frame["date"]).transform("any")
    if not some.all():
        empty = np.unique(frame["date"][~some])
        findings.warn(
            f"left out: {amount(len(empty), 'row')} without any number; the latest has this date",
            date=day(empty[-1]),
        )
    return frame[some].reset_index(drop=True), findings
