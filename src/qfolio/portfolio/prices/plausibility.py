"""Reports cells that are not prices, tables that are too short, and gaps in time."""

import numpy as np

from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.cells import is_percentage, not_a_number
from qfolio.portfolio.prices.findings import LISTED, Findings, day
from qfolio.portfolio.prices.frequency import every_day, spacing
from qfolio.portfolio.prices.gaps import Rest
from qfolio.portfolio.prices.grid import Block, Grid, report_cells
from qfolio.portfolio.prices.returns import (
    CLEAR,
    DOUBTFUL,
    RELATIVES,
    RUIN,
    look_like_returns,
    usual_relative,
)
from qfolio.portfolio.prices.vocabulary import is_cash

FEWEST_ROWS, FEW_ROWS = 3, 60


def check_cells(grid: Grid, findings: Findings) -> None:
    """Reports cells that are not prices or features, and a table without assets or rows."""
    table = grid.table
    if not grid.assets:
        findings.error("there is no asset", advice="Give a column of prices for each asset.")
    for name in grid.assets:
        if is_cash(name):
            findings.error(
                f"the asset {quote(name)} has the name of the money that is not invested",
                advice="Rename or remove it." if grid.long else "Rename or remove its column.",
            )
    if len(grid.dates) < FEWEST_ROWS:
        findings.error(
            f"the table has {amount(len(grid.dates), 'row')}; at least {FEWEST_ROWS} are needed",
            advice="Give a longer history.",
        )
    advice = "Write numbers as 1234.5, and leave a cell empty where there is none."
    for block in (grid.prices, *grid.features):
        texts = block.wrong.any(axis=0) & (block.wrong | np.isnan(block.values)).all(axis=0)
        texts &= not grid.long
        for j in np.flatnonzero(texts)[:LISTED].tolist():
            said = _complaint(grid, block, int(block.wrong[:, j].argmax()), j)
            findings.error(
                f"there are no numbers: {said}", column=table.names[block.columns[j]],
                advice="Remove the column, or write its numbers as 1234.5.",
            )  # fmt: skip
        findings.others("error", int(texts.sum()), "column", " without numbers")

        def said_of(i: int, j: int, block: Block = block) -> str:
            return _complaint(grid, block, i, j)

        report_cells(grid, block, block.wrong & ~texts, said_of, advice, findings)
        report_cells(grid, block, np.isinf(block.values), "is infinite", advice, findings)
    values = grid.prices.values
    if look_like_returns(values):
        findings.error(
            f"the numbers look like returns: {(values < 0).sum() / np.isfinite(values).sum():.0%} "
            "are negative",
            advice="Give prices, or choose returns='percent' or 'fraction' (--returns).",
        )
        return
    relative = usual_relative(values)
    if relative >= CLEAR:
        advice = "Give prices, or choose returns='relative' (--returns)."
        findings.error(RELATIVES, advice=advice)
        return
    if relative >= DOUBTFUL:
        findings.warn(RELATIVES, advice="If so, choose returns='relative' (--returns).")
    report_cells(
        grid, grid.prices, values == 0, "is zero",
        f"Leave the cell empty where there was no trade. {RUIN}", findings,
    )  # fmt: skip
    report_cells(
        grid, grid.prices, np.isfinite(values) & (values < 0), "is negative",
        "Give prices, not returns.", findings,
    )  # fmt: skip


def _complaint(grid: Grid, block: Block, i: int, j: int) -> str:
    cell = grid.table.columns[block.columns[j]][int(grid.lines[i, j])]
    said = not_a_number(cell, grid.table.decimal)
    if block is grid.prices and is_percentage(str(cell), grid.table.decimal):
        return f"{said}; if it is a return, choose returns='percent' (--returns)"
    return said


def check_size(grid: Grid, rest: Rest, findings: Findings) -> None:
    """Reports what is left of a table if that is too short, and gaps between its dates."""
    dates = grid.dates[rest.head :]
    if len(dates) < FEWEST_ROWS:
        findings.error(
            f"the table keeps {amount(len(dates), 'row')}; at least {FEWEST_ROWS} are needed",
            advice="Choose another late= (--late), or give a longer history.",
        )
        return
    if len(dates) < FEW_ROWS:
        findings.warn(f"the table has only {amount(len(dates), 'row')}, too few to learn from")
    if len(rest.assets) == 1:
        findings.warn(f"there is only one asset, {quote(grid.assets[rest.assets[0]])}")
    steps, usual = spacing(dates)
    closed = 0.0 if every_day(dates) else 7.0  # markets with weekends have holidays, too
    long = np.flatnonzero(steps > 3 * usual + closed)
    several = grid.long or grid.table.turned  # cells of a date are in several rows, or in a column
    spots = []
    for k in long.tolist():
        row = None if several else grid.spot(grid.prices, rest.head + k + 1, 0)["row"]
        spots.append({"row": row, "date": day(dates[k + 1])})
    for k, spot in list(zip(long.tolist(), spots, strict=True))[-LISTED:]:
        findings.warn(
            f"the previous row is {day(dates[k])}, {steps[k]:.4g} days earlier "
            f"(usual: {usual:.4g})",
            **spot,
        )
    findings.older(spots, "gap", "between dates")
