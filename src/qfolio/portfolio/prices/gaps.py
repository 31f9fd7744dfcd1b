"""Treats missing prices and late assets as the user chose."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.findings import LISTED, Findings, day, listing
from qfolio.portfolio.prices.grid import Grid, report_cells


@dataclass(frozen=True)
class Rest:
    """The rest of a grid after the user's choices: rows from ``head`` on, and these assets."""

    head: int
    assets: np.ndarray  # columns of the grid
    values: np.ndarray  # (rows, assets)
    features: np.ndarray  # (rows, assets, features)


class _Span(NamedTuple):
    """Where there are prices; rows are those of the grid."""

    head: int  # the first row with any price
    start: np.ndarray  # (assets,): the row of the first price; the number of rows if there is none
    end: np.ndarray  # (assets,): the row after the last price
    gaps: np.ndarray  # (rows, assets): whether there is no price, after the first one
    delists: bool  # whether there are no gaps after the last price

    @property
    def empty(self) -> np.ndarray:
        """Assets without any price."""
        return self.start >= self.end


LEAST_PAID = 1e-9
"""Least share of the last price that a haircut leaves, so that prices stay positive."""


def cash_outs(values: np.ndarray, features: np.ndarray, haircut: float) -> dict[str, np.ndarray]:
    """Prices and features continued after each asset's last row, and where assets are listed.

    values: of shape (rows, assets). After its last price, an asset's price is its payout: the last
    price less the haircut. features: (rows, assets, features); the last ones are kept. ``listed``
    is left out if no asset ends.
    """
    priced = ~np.isnan(values)
    listed = np.logical_or.accumulate(priced[::-1])[::-1]  # or before the first row
    if listed.all():
        return {}
    paid = np.where(listed, 1.0, max(1 - haircut, LEAST_PAID))
    last = fill_forward(features.reshape(len(values), -1)).reshape(features.shape)
    return {
        "values": np.where(listed, values, fill_forward(values) * paid),
        "features": np.where(listed[..., None], features, last),
        "listed": listed & priced,
    }


def complete(
    grid: Grid, missing: str, late: str, findings: Findings, *, delists: bool = False
) -> Rest:
    """Closes gaps and drops assets as the user chose: first ``missing``, then ``late``.

    delists: whether an asset ends with its last price, so that none is missing after it.
    """
    span = _span(grid, delists)
    keep = ~span.empty
    if missing == "drop-asset":
        keep = _without_gaps(grid, span, findings)
        # An asset that is left out does not say where the table starts.
        span = span._replace(head=int(span.start[keep].min()) if keep.any() else 0)
    if span.head:
        findings.warn(f"left out at the start: {amount(span.head, 'row')} without prices")
    values, channels = _treat_gaps(grid, span, keep, missing, findings)
    head, keep = _treat_late_starts(grid, span, keep, late, findings)
    if grid.assets and not keep.any():
        findings.error("no asset is left", advice="Look at the gaps of the table first.")
    if delists:
        keep = keep & (span.end > head)
        if (gone := keep & (span.end < len(values))).any():
            findings.note(f"delisted before the last row: {amount(int(gone.sum()), 'asset')}")
    channels = [np.broadcast_to(channel, values.shape) for channel in channels]
    features = np.stack(channels, axis=-1) if channels else np.empty((*values.shape, 0))
    return Rest(head, np.flatnonzero(keep), values[head:, keep], features[head:, keep])


def _span(grid: Grid, delists: bool) -> _Span:
    present = ~np.isnan(grid.prices.values) | grid.prices.wrong
    count, some = len(present), present.any(axis=0)
    start = np.where(some, present.argmax(axis=0), count)
    end = np.where(some, count - present[::-1].argmax(axis=0), 0)
    rows = np.arange(count)[:, None]
    gaps = ~present & (rows >= start) & (rows < (end if delists else count))
    return _Span(int(start.min()) if some.any() else 0, start, end, gaps, delists)


def _holes(grid: Grid, span: _Span) -> list[np.ndarray]:
    """Where each feature is missing: it starts with its asset, or with the table if of no asset."""
    rows = np.arange(len(grid.prices.values))[:, None]
    return [
        np.isnan(block.values)
        & ~block.wrong
        & (rows >= (span.start if block.by_asset else span.head))
        & (rows < (span.end if block.by_asset and span.delists else len(rows)))
        for block in grid.features
    ]


def _without_gaps(grid: Grid, span: _Span, findings: Findings) -> np.ndarray:
    """Which assets have gaps neither in prices nor in features."""
    drop = span.empty | span.gaps.any(axis=0)
    for block, hole in zip(grid.features, _holes(grid, span), strict=True):
        if block.by_asset:
            drop |= hole.any(axis=0)
    _report_dropped(grid, drop, "prices are missing", findings)
    return ~drop


def _treat_gaps(
    grid: Grid, span: _Span, keep: np.ndarray, missing: str, findings: Findings
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Prices and features with their gaps treated."""
    values, channels = grid.prices.values, [block.values for block in grid.features]
    rows = np.arange(len(values))[:, None]
    holes = [
        hole & keep if block.by_asset else hole
        for hole, block in zip(_holes(grid, span), grid.features, strict=True)
    ]
    if missing != "drop-asset":
        earlier = "Give prices from before it was delisted, or remove the asset."
        _report_assets(
            grid, span.empty, lambda j: "there are no prices at all", "without prices",
            earlier if span.delists else "Remove the asset.", findings,
        )  # fmt: skip
    if missing == "forward-fill":
        if span.gaps.any():
            _report_filled(grid, span.gaps, findings)
        filled = fill_forward(values)
        values = np.where(span.gaps, filled, values) if span.delists else filled
        channels = [fill_forward(channel) for channel in channels]
        holes = [h & np.isnan(channel) for h, channel in zip(holes, channels, strict=True)]
    if missing == "error":
        advice = (
            "Fill the cells, or choose how to treat gaps: missing='forward-fill' or "
            "'drop-asset' (--missing)."
        )
        within = span.gaps & (rows < span.end)
        report_cells(grid, grid.prices, within, "is missing", advice, findings)
        ends = ~span.empty & (span.end < len(values)) & (not span.delists)
        _report_assets(
            grid, ends,
            lambda j: f"there are no prices after {day(grid.dates[span.end[j] - 1])}",
            "whose prices end early",
            f"{advice} If they were delisted, choose ended='cash-out' (--ended).", findings,
        )  # fmt: skip
    advice = (
        "Fill the cells, start the table where the features do, or choose "
        "missing='forward-fill' (--missing)."
    )
    for block, unknown in zip(grid.features, holes, strict=True):
        report_cells(grid, block, unknown, "is missing", advice, findings)
    return values, channels


def _treat_late_starts(
    grid: Grid, span: _Span, keep: np.ndarray, late: str, findings: Findings
) -> tuple[int, np.ndarray]:
    """The row at which the table is to start, and which assets to keep."""
    behind = keep & (span.start > span.head)
    if not behind.any():
        return span.head, keep
    if late == "error":
        _report_assets(
            grid, behind,
            lambda j: f"the first price is on {day(grid.dates[span.start[j]])}, the table starts "
            f"on {day(grid.dates[span.head])}",
            "with a late start",
            "Choose how to treat late starts: late='drop-asset', 'trim' or 'join' (--late).",
            findings,
        )  # fmt: skip
    elif late == "drop-asset":
        _report_dropped(grid, behind, "they start late", findings)
        return span.head, keep & ~behind
    elif late == "trim":
        head = int(span.start[behind].max())
        findings.warn(f"the table starts on {day(grid.dates[head])}, with the last asset to start")
        return head, keep
    else:
        findings.warn(f"joining after the first row: {amount(int(behind.sum()), 'asset')}")
    return span.head, keep


def fill_forward(values: np.ndarray) -> np.ndarray:
    """Values of shape (rows, columns) with gaps closed by the last one before; NaN before any."""
    rows = np.where(np.isnan(values), 0, np.arange(len(values))[:, None])
    return np.take_along_axis(values, np.maximum.accumulate(rows, axis=0), axis=0)


def _report_assets(
    grid: Grid,
    which: np.ndarray,
    said: Callable[[int], str],
    kind: str,
    advice: str,
    findings: Findings,
) -> None:
    """An error for each of these assets; ``kind`` describes those that are only counted."""
    found: Sequence[int] = np.flatnonzero(which).tolist()
    for j in found[:LISTED]:
        name = f"{quote(grid.assets[j])}: " if grid.long else ""
        column = grid.table.names[grid.prices.columns[j]]
        findings.error(name + said(j), column=column, advice=advice)
    findings.others("error", len(found), "asset", f" {kind}", advice=advice)


def _report_dropped(grid: Grid, drop: np.ndarray, reason: str, findings: Findings) -> None:
    if drop.any():
        listed = listing(grid.assets[j] for j in np.flatnonzero(drop))
        count = amount(int(drop.sum()), "asset")
        findings.warn(f"left out, because {reason}: {listed} ({count})")


def _report_filled(grid: Grid, gaps: np.ndarray, findings: Findings) -> None:
    """Warns how many prices are filled, and where the longest gap is."""
    run = np.zeros(gaps.shape[1], dtype=np.int64)
    longest = np.zeros_like(run)
    for row in gaps:
        run = (run + 1) * row
        longest = np.maximum(longest, run)
    j, latest = int(longest.argmax()), int(np.flatnonzero(gaps.any(axis=1))[-1])
    findings.warn(
        f"filled forward: {amount(int(gaps.sum()), 'missing price')}; "
        f"the longest gap is of {quote(grid.assets[j])}, {amount(int(longest[j]), 'row')}; "
        "the latest gap is on this date",
        date=day(grid.dates[latest]),
    )
    if gaps[-1].any():
        names = listing(grid.assets[j] for j in np.flatnonzero(gaps[-1]))
        findings.warn(
            f"the last row has no price of {names}, and takes an earlier one",
            date=day(grid.dates[-1]),
            advice="Nobody trades at that price now; fetch the table again if it is late.",
        )
