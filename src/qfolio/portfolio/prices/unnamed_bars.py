"""Reports open, high, low and close of one asset under names that are not known.

As four assets they would be traded, and be known at the same time.
"""

import itertools

import numpy as np

from qfolio.core.text import quote
from qfolio.portfolio.prices.findings import Findings, listing
from qfolio.portfolio.prices.gaps import Rest
from qfolio.portfolio.prices.grid import Grid

MOST = 50  # assets of a table in which bars are looked for
FEWEST, ENOUGH = 50, 5000  # rows, of which the last are looked at
NEAR = 0.2  # in log: how far the high usually is from the others at most
NEARLY_ALL = 0.99  # of the rows, on which the high is above and the low below
OFTEN = 0.2  # of the rows, on which the open is above the close, and below it
CHANGING = 0.15  # usual change of a day's range from row to row, as a share of the usual range
TOUCHING = 0.01  # of the rows, and at least three, on which the open or the close is high or low


def check_unnamed_bars(grid: Grid, rest: Rest, findings: Findings) -> None:
    """Report columns between two others that are always above and below them, and as close by.

    Between assets that keep their order, such as share classes of one fund, the distance changes
    little from row to row; and assets hardly ever have equal prices, while a day may open or close
    at its high or low.
    """
    count = len(rest.assets)
    if not 4 <= count <= MOST or len(rest.values) < FEWEST:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.log(values := rest.values[-ENOUGH:])
    known = np.isfinite(logs)
    above = np.array([_share(logs[:, [i]] >= logs, known[:, [i]] & known) for i in range(count)])
    for high, low in np.argwhere(above >= NEARLY_ALL).tolist():
        if not _is_range(logs[:, high] - logs[:, low]):  # as nearly all pairs of assets
            continue
        between = (above[high] >= NEARLY_ALL) & (above[:, low] >= NEARLY_ALL)
        within = [j for j in np.flatnonzero(between).tolist() if j not in (high, low)]
        pairs = itertools.combinations(within, 2)
        crossing = any(OFTEN <= above[pair] <= 1 - OFTEN for pair in pairs)
        inner, ends = values[:, within], values[:, [high, low]]
        touches = int((inner[..., None] == ends[:, None]).any(axis=(1, 2)).sum())
        if crossing and touches >= max(3, TOUCHING * len(logs)):
            names = [grid.assets[rest.assets[j]] for j in sorted({high, low, *within})]
            top, bottom = (quote(grid.assets[rest.assets[j]]) for j in (high, low))
            findings.error(
                f"{listing(names)} look like open, high, low and close of one asset: {top} is "
                f"never below the others, and {bottom} never above them",
                advice="Keep the column of closing prices, or name them open, high, low and close.",
            )
            return


def _share(true: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The share of known rows on which something is true, by column; 0 if they are few."""
    counts = known.sum(axis=0)
    return np.where(counts >= FEWEST, (true & known).sum(axis=0) / np.maximum(counts, 1), 0.0)


def _is_range(apart: np.ndarray) -> bool:
    """Whether distances of log prices are small, and differ from row to row."""
    usual = float(np.nanmedian(apart))
    return 0 < usual <= NEAR and float(np.nanmedian(abs(np.diff(apart)))) >= CHANGING * usual
