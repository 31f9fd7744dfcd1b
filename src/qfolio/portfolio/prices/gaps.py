"""Treats missing prices and assets that start late as the user chose."""

from dataclasses import dataclass

import numpy as np

from qfolio.core.text import quote
from qfolio.portfolio.prices.findings import LISTED, Findings, amount, day, listing
from qfolio.portfolio.prices.grid import Grid, report_cells


@dataclass(frozen=True)
class Rest:
    """What remains of a grid after the user's choices: rows from ``head`` on, and these assets."""

    head: int
    assets: np.ndarray  # columns of the grid
    values: np.ndarray
    features: np.ndarray


def complete(grid: Grid, missing: str, late: str, findings: Findings) -> Rest:
    """Close gaps and drop assets as the user chose: first ``missing``, then ``late``."""
    values, names = grid.prices.values, grid.assets
    present = ~np.isnan(values) | grid.prices.wrong
    rows = np.arange(len(values))[:, None]
    begun = np.flatnonzero(present.any(axis=1))
    head = int(begun[0]) if len(begun) else 0
    if head:
        findings.warn(f"left out at the start: {amount(head, 'row')} without prices")
    start = np.where(present.any(axis=0), present.argmax(axis=0), len(values))
    end = np.where(present.any(axis=0), len(values) - present[::-1].argmax(axis=0), 0)
    empty = ~present.any(axis=0)
    gaps = ~present & (rows >= start)
    drop = np.zeros(len(names), dtype=bool)
    # Features start with their asset; those of the market with the table.
    unknown = [
        np.isnan(block.values) & ~block.wrong & (rows >= (start if block.by_asset else head))
        for block in grid.features
    ]
    filled = [block.values for block in grid.features]

    if missing == "drop-asset":
        drop = empty | gaps.any(axis=0)
        for block, holes in zip(grid.features, unknown, strict=True):
            if block.by_asset:
                drop |= holes.any(axis=0)
        unknown = [
            holes & ~drop if block.by_asset else holes
            for block, holes in zip(grid.features, unknown, strict=True)
        ]
        _report_dropped(names, drop, "prices are missing", findings)
    else:
        for j in np.flatnonzero(empty)[:LISTED].tolist():
            _of_asset(grid, j, "there are no prices at all", "Remove the asset.", findings)
        if (rest := int(empty.sum()) - LISTED) > 0:
            findings.error(f"and {amount(rest, 'more asset')} without prices", count=rest)
    if missing == "forward-fill":
        if gaps.any():
            _report_filled(grid, gaps, findings)
        values = _fill_forward(values)
        filled = [_fill_forward(channel) for channel in filled]
        unknown = [holes & np.isnan(c) for holes, c in zip(unknown, filled, strict=True)]
    if missing == "error":
        advice = (
            "Fill the cells, or choose how to treat gaps: missing='forward-fill' or "
            "'drop-asset' (--missing)."
        )
        report_cells(grid, grid.prices, gaps & (rows < end), "is missing", advice, findings)
        stops = np.flatnonzero((start < end) & (end < len(values)))
        for j in stops[:LISTED].tolist():
            last = day(grid.dates[end[j] - 1])
            _of_asset(grid, j, f"there are no prices after {last}", advice, findings)
        if (rest := len(stops) - LISTED) > 0:
            findings.error(f"and {amount(rest, 'more asset')} whose prices end early", count=rest)
    for block, holes in zip(grid.features, unknown, strict=True):
        report_cells(
            grid, block, holes, "is missing",
            "Fill the cells, start the table where the features do, or choose "
            "missing='forward-fill' (--missing).", findings,
        )  # fmt: skip

    keep = ~drop & ~empty
    behind = keep & (start > head)
    if behind.any():
        advice = "Choose how to treat late starts: late='drop-asset', 'trim' or 'join' (--late)."
        if late == "error":
            for j in np.flatnonzero(behind)[:LISTED].tolist():
                said = f"the first price is that of {day(grid.dates[start[j]])}"
                _of_asset(grid, j, f"{said}, the table's {day(grid.dates[head])}", advice, findings)
            if (rest := int(behind.sum()) - LISTED) > 0:
                findings.error(
                    f"and {amount(rest, 'more asset')} with a late start", advice=advice, count=rest
                )
        elif late == "drop-asset":
            _report_dropped(names, behind, "they start late", findings)
            keep &= ~behind
        elif late == "trim":
            head = int(start[behind].max())
            findings.warn(
                f"the table starts on {day(grid.dates[head])}, with the last asset to start",
            )
        else:
            findings.warn(f"joining later than the first row: {amount(int(behind.sum()), 'asset')}")
    if grid.assets and not keep.any():
        findings.error("no asset is left", advice="Look at the gaps of the table first.")
    shape = (len(values), len(names))
    channels = [np.broadcast_to(channel, shape) for channel in filled]
    features = np.stack(channels, axis=-1) if channels else np.empty((*shape, 0))
    return Rest(head, np.flatnonzero(keep), values[head:, keep], features[head:, keep])


def _fill_forward(values: np.ndarray) -> np.ndarray:
    rows = np.where(np.isnan(values), 0, np.arange(len(values))[:, None])
    return np.take_along_axis(values, np.maximum.accumulate(rows, axis=0), axis=0)


def _of_asset(grid: Grid, j: int, said: str, advice: str, findings: Findings) -> None:
    if grid.long:
        said = f"{quote(grid.assets[j])}: {said}"
    column = grid.table.names[grid.prices.columns[j]]
    findings.error(said, column=column, advice=advice)


def _report_dropped(
    names: tuple[str, ...], drop: np.ndarray, reason: str, findings: Findings
) -> None:
    if drop.any():
        listed = listing(names[j] for j in np.flatnonzero(drop))
        count = amount(int(drop.sum()), "asset")
        findings.warn(f"left out, because {reason}: {listed} ({count})")


def _report_filled(grid: Grid, gaps: np.ndarray, findings: Findings) -> None:
    """Warn how much is filled, and where the longest gap is."""
    run = np.zeros(gaps.shape[1], dtype=np.int64)
    longest = np.zeros_like(run)
    for row in gaps:
        run = (run + 1) * row
        longest = np.maximum(longest, run)
    j = int(longest.argmax())
    findings.warn(
        f"filled forward: {amount(int(gaps.sum()), 'missing price')}; "
        f"the longest gap is of {quote(grid.assets[j])}, {amount(int(longest[j]), 'row')}",
    )
