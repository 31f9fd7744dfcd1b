"""Prices that are about to be traded although they may be wrong."""

from qfolio.core.arrays import Bools
from qfolio.core.errors import QfolioError
from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.moves import sort_moves
from qfolio.portfolio.prices.table import Prices


def require_plausible(table: Prices, traded: Bools) -> None:
    """Raises QfolioError if a move into the last row, at which orders are made, is that of a split.

    A number that a download was cut within looks the same. Other jumps, as in a crash, are only
    warned of.

    Args:
        table: The prices of the decision.
        traded: Which assets are held or may be bought, of shape (assets,).
    """
    found, last = sort_moves(table.known), len(table) - 2
    doubtful = {j: ratio for (i, j), ratio in found.splits.items() if i == last and traded[j]}
    if not doubtful:
        return
    (asset, ratio), *others = doubtful.items()
    more = f" ({amount(len(others), 'more asset')} likewise)" if others else ""
    raise QfolioError(
        f"On {day(table.dates[-1])}, {quote(table.assets[asset])} moves by a factor of "
        f"{found.relatives[last, asset]:.4g}, close to {ratio}{more}: perhaps a split that was not "
        "adjusted, another unit, or a number that was cut; correct the prices or, if they did move "
        "like this, add --anyway."
    )
