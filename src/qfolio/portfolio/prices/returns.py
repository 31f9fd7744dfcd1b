"""Cumulates returns to prices that start at 100, and tells returns from prices."""

from dataclasses import replace

import numpy as np

from qfolio.core.text import amount
from qfolio.portfolio.prices.findings import Findings
from qfolio.portfolio.prices.grid import Grid, report_cells

START = 100.0
UNITS = {"percent": (0.0, 0.01), "fraction": (0.0, 1.0), "relative": (1.0, 1.0)}
"""The number of a return of nothing, and what one more is; a relative is new price over old."""
USUAL = {"percent": (0.02, np.inf), "fraction": (0.0, 0.2), "relative": (0.0, 0.2)}
"""The range of a usual return, in its unit: from a bar of minutes to a year."""
RUIN = (
    "Keep an asset that lost everything: empty its cells from there on and choose ended='cash-out' "
    "with a delisting_haircut (--ended, --delisting-haircut)."
)
UNKNOWN = {"percent": (-99.99, -999.0)}
"""Numbers that Kenneth French's tables have where a return is missing."""
SIGNED = (0.3, 0.7)  # the share of negative numbers among returns
FEWEST = 20  # rows that tell what their numbers are
GAIN = (0.008, 0.05)  # usual gain of a row without any loss that is doubtful, and impossible
DOUBTFUL, CLEAR, MOST = 0.0005, 0.003, 0.2  # how far usual relatives, or prices near 1, are from 1
DEPOSIT = 0.05  # monthly percentages of funds that never lose are further from 1
RELATIVES = (
    "the numbers look like price relatives, new price over old: they are near 1, and as often "
    "above as below"
)
CHOICES = "'percent', 'fraction' or 'relative'"


def cumulate(grid: Grid, unit: str, findings: Findings) -> Grid | None:
    """The grid with prices in place of simple returns from the row before; None if they are none.

    An asset's price is 100 in the row before its first return. If that row is not in the table,
    it is 100 in the row of its first return, which is then not used.
    """
    if not grid.prices.values.size:
        return grid
    block, (zero, one) = replace(grid.prices, name="return"), UNITS[unit]
    if (unknown := np.isin(block.values, UNKNOWN.get(unit, ()))).any():
        findings.note(
            f"{amount(int(unknown.sum()), 'return')} of −99.99 or −999 percent, which mark missing "
            "ones in Kenneth French's tables, are not read"
        )
        block = replace(block, values=np.where(unknown, np.nan, block.values))
    with np.errstate(over="ignore", under="ignore"):
        rates = (block.values - zero) * one
        known = np.isfinite(rates)
        moved = rates[known & (rates != 0)]
        near = 0.0 if unit == "relative" else usual_relative(block.values)
        if unit == "percent" and near > DEPOSIT:
            findings.warn(RELATIVES, advice="If so, choose returns='relative' (--returns).")
        elif near >= CLEAR:
            findings.error(RELATIVES, advice="Choose returns='relative' (--returns).")
            return None
        lossless = len(rates) >= FEWEST and moved.size and (moved > 0).all()
        gain = float(np.median(moved)) if lossless else 0.0
        if gain >= GAIN[0]:
            report = findings.error if gain >= GAIN[1] else findings.warn
            report(
                "the numbers look like prices, not returns: none is a loss, and the usual gain is "
                f"{100 * gain:{',.0f' if gain > 1 else '.2g'}}%",
                advice="If they are prices, leave out returns (--returns).",
            )
            if gain >= GAIN[1]:
                return None
        report_cells(grid, block, np.isinf(rates), "is infinite", "Correct the cell.", findings)
        report_cells(
            grid, block, known & (rates <= -1), "is −100% or less",
            f"Check the unit, returns={CHOICES} (--returns). {RUIN}", findings,
        )  # fmt: skip
        growth = np.cumprod(1 + np.where(known & (rates > -1), rates, 0.0), axis=0)
        present = ~np.isnan(rates) | block.wrong
        first = present.argmax(axis=0)
        values = np.where(np.isnan(rates), np.nan, START * growth)
        unused = present.any(axis=0) & (first == 0)
        values[:, unused] /= growth[0, unused]
    for j in np.flatnonzero(first > 0).tolist():
        values[first[j] - 1, j] = START
    if unused.any():
        findings.note(
            f"prices are cumulated from returns and start at {START:g}; the first row's returns "
            "are not used, because the row before them is not in the table"
        )
    else:
        findings.note(f"prices are cumulated from returns and start at {START:g}")
    sizes = np.abs(moved) / one
    low, high = USUAL[unit]
    if sizes.size and not low <= (usual := float(np.median(sizes))) <= high:
        other = "fraction" if unit == "percent" else "percent"
        findings.warn(
            f"the usual return is {usual:.2g}, taken as {unit}",
            advice=f"Check the unit: perhaps it is {other}.",
        )
    return replace(grid, prices=replace(block, values=values, name="price"))


def usual_relative(values: np.ndarray) -> float:
    """How far numbers are from 1, if they are near it and cross it every few rows; else 0.

    So do the first rows of prices that start at 1, and therefore a few rows tell nothing.
    """
    known = values[np.isfinite(values)]
    if len(values) < FEWEST or not known.size or (known <= 0).any():
        return 0.0
    both = np.isfinite(values[1:]) & np.isfinite(values[:-1])
    crossed = (values[1:] < 1) != (values[:-1] < 1)
    if not both.any() or crossed[both].mean() < SIGNED[0]:
        return 0.0
    usual = float(np.median(abs(known - 1)))
    return usual if usual <= MOST else 0.0


def look_like_returns(values: np.ndarray) -> bool:
    """Whether many numbers are negative and many are not."""
    known = values[np.isfinite(values)]
    low, high = SIGNED
    return bool(known.size and low <= (known < 0).mean() <= high)
