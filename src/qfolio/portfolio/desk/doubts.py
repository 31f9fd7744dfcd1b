"""Prices that are about to be traded although they may be wrong."""

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import amount
from qfolio.portfolio.prices.findings import Finding, Findings, day
from qfolio.portfolio.prices.gaps import Rest
from qfolio.portfolio.prices.grid import Block, Grid
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.moves import check_moves
from qfolio.portfolio.prices.table import Prices


def require_plausible(table: Prices) -> None:
    """Raises QfolioError if a price of the last row, at which orders are made, is doubtful.

    A download that was cut within its last number looks like this, as does a true crash.
    """
    if not (found := _doubts(table)):
        return
    count = sum(each.count for each in found) - 1
    more = f", and there {'is' if count == 1 else 'are'} {amount(count, 'more such move')}"
    raise QfolioError(
        f"On {found[0].date}, {found[0].message}{more * bool(count)}; correct the prices or, if "
        "they did move like this, add --anyway."
    )


def _doubts(table: Prices) -> list[Finding]:
    """The warnings on moves that end at the last row."""
    found, every = Findings(), np.arange(len(table.assets))
    values = table.known
    prices = Block(values, np.isnan(values), tuple(every.tolist()), "price", by_asset=True)
    nowhere = np.full(values.shape, -1)
    cells = Table(table.assets, (), 0, table.source)
    grid = Grid(cells, True, table.dates, table.assets, nowhere, prices, ())
    check_moves(grid, Rest(0, every, values, table.features), found)
    last = day(table.dates[-1])
    return [each for each in found if each.severity == "warning" and each.date == last]
