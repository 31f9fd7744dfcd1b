"""Reads current holdings: shares and cash, as brokers export them."""

import math
from collections.abc import Sequence
from numbers import Real
from pathlib import Path

import numpy as np

from qfolio.core.errors import QfolioError, require_type
from qfolio.core.text import hint, quote
from qfolio.portfolio.desk.orders_csv import spelled
from qfolio.portfolio.prices.cells import CURRENCIES, is_missing, label, not_a_number, numbers
from qfolio.portfolio.prices.reading import read
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.prices.vocabulary import ASSET_NAMES, CASH, SHARES_NAMES, is_cash, plain


def read_holdings(
    path: Path | None, assets: Sequence[str], capital: float | None, *, debts: bool = False
) -> tuple[np.ndarray, float]:
    """Shares of each asset, of shape (assets,), and cash.

    Classes of shares may be spelled as brokers do: BRK B, BRK.B or BRK/B for BRK-B.

    Args:
        path: A table with a column of assets (asset, symbol, ticker, …) and one of shares (shares,
            quantity, qty, …), in which a row "cash" holds money; other columns are ignored.
            Without it, all is cash.
        assets: The assets that may be held.
        capital: Cash, if the table does not give it.
        debts: Whether shares may be negative (sold short). Cash always may: it is a loan, or an
            overdraft.

    Raises:
        QfolioError: The file is not such a table or has no rows, names an unknown asset or one
            asset twice, a number cannot be read or is negative without debts, or cash is given
            twice.
    """
    if capital is not None:
        require_type("capital", capital, Real, "a sum of money, such as 10000")
        if not 0 <= capital < math.inf:
            raise QfolioError(f"--capital is {capital}; it must be a sum of money, at least 0.")
    money = float(capital or 0)
    shares = np.zeros(len(assets))
    if path is None:
        return shares, money
    table = read(path, _name_columns)
    name_column = _only_column(path, table.names, ASSET_NAMES)
    shares_column = _only_column(path, table.names, SHARES_NAMES)
    cells = table.columns[shares_column]
    values, wrong = numbers(cells, table.decimal)
    places = {name: j for j, name in enumerate(assets)}
    held: dict[str, float] = {}
    for i, cell in enumerate(table.columns[name_column].tolist()):
        where = f"{path}, line {table.first_row + i}"
        name, amount = _known(label(cell), assets), float(values[i])
        if not name and is_missing(cells[i]):
            continue
        if is_cash(name):
            name = CASH
            if capital is not None:
                raise QfolioError(f"{where}: cash is also given by --capital; leave out one.")
        elif name not in places:
            known = f"the backtest does not know {quote(name)}{hint(name, assets)}"
            raise QfolioError(f"{where}: {known if name else 'the asset has no name'}.")
        if name in held:
            raise QfolioError(f"{where}: {quote(name)} appears twice; add the two numbers up.")
        if is_missing(cells[i]):
            raise QfolioError(f"{where}: there is no number of shares of {quote(name)}.")
        if wrong[i] or (name != CASH and CURRENCIES & set(str(cells[i]))):
            raise QfolioError(f"{where}: {not_a_number(cells[i], table.decimal)}.")
        if not math.isfinite(amount) or (amount < 0 and name != CASH and not debts):
            wanted = "a number" if debts or name == CASH else "0 or more: the backtest is long-only"
            raise QfolioError(f"{where}: {quote(name)} has {amount:,.12g} shares; give {wanted}.")
        held[name] = amount
    if not held:  # an export may have been cut short
        raise QfolioError(f"{path} lists no holdings; leave it out if all is cash.")
    cash = held.pop(CASH, money)
    for name, amount in held.items():
        shares[places[name]] = amount
    return shares, cash


def cashed_out(
    shares: np.ndarray, cash: float, prices: Prices
) -> tuple[np.ndarray, float, list[str]]:
    """Shares and cash after a cash-out of the assets that a table's last row no longer lists.

    Returns:
        Shares of shape (assets,), cash, and a sentence for each asset that was cashed out.
    """
    if prices.listed is None:
        return shares, cash, []
    gone = (shares != 0) & ~prices.listed[-1] & (prices.first_rows < len(prices))
    paid = np.where(gone, shares * prices.values[-1], 0.0)
    said = [
        f"{prices.assets[j]} is delisted; {shares[j]:,.12g} shares count as {paid[j]:,.2f} in cash."
        for j in np.flatnonzero(gone)
    ]
    return np.where(gone, 0.0, shares), cash + float(paid.sum()), said


def _known(name: str, assets: Sequence[str]) -> str:
    """The asset of a name that only a broker spells like this; any other name as it is."""
    if name in assets:
        return name
    alike = [asset for asset in assets if spelled(asset, " ") == spelled(name, " ")]
    return alike[0] if len(alike) == 1 else name


def _name_columns(names: tuple[str, ...]) -> set[int]:
    """The columns that stay text, because names may look like numbers."""
    return {j for j, name in enumerate(names) if plain(name) in ASSET_NAMES}


def _only_column(path: Path, names: tuple[str, ...], known: tuple[str, ...]) -> int:
    found = [j for j, name in enumerate(names) if plain(name) in known]
    if not found:
        raise QfolioError(
            f"{path} needs a first line with the columns asset (or symbol, ticker) and shares "
            "(or quantity, qty)."
        )
    if len(found) > 1:
        listed = " and ".join(quote(names[j]) for j in found)
        raise QfolioError(f"{path}: the columns {listed} could both be the {known[0]}; keep one.")
    return found[0]
