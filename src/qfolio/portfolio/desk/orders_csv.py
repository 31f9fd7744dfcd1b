"""Orders as CSV, in columns that brokers read."""

import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.files import UNFINISHED, naming, target_of, write_csv
from qfolio.core.text import near, quote
from qfolio.portfolio.desk.allocation import Allocation

DIGITS = 6
"""Decimal places of fractional shares; anything smaller is not ordered."""

Rows = list[list[Any]]


def order_rows(allocation: Allocation, layout: str, currency: str) -> tuple[list[str], Rows]:
    """The header and a row for each trade of an allocation; sales come first.

    Args:
        allocation: What is to be traded.
        layout: One of ``LAYOUTS``.
        currency: Code of the currency, for layouts that name it.

    Raises:
        QfolioError: The layout is unknown, or cannot hold the trades.
    """
    if layout not in LAYOUTS:
        raise QfolioError(f"--layout is {quote(layout)}; {near(layout, LAYOUTS)}")
    return LAYOUTS[layout](allocation, currency)


@contextmanager
def prepared(path: Path, header: list[str], rows: Rows) -> Iterator[Callable[[], object]]:
    """Orders under a temporary name; within the block, the function that it gets names them so.

    What cannot be written is found before anything is recorded, and earlier orders stay until then,
    even if the process is killed.

    Raises QfolioError for what ``target_of`` refuses.
    """
    target = target_of(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.new{UNFINISHED}")
    with naming(path):
        write_csv(temporary, header, rows)

    def place() -> None:
        with naming(path):
            temporary.replace(target)

    try:
        yield place
    finally:
        with suppress(OSError):  # on a disk that has become read-only
            temporary.unlink(missing_ok=True)


def require_apart(
    written: Path, option: str, source: Any, *, by: str = "--orders", what: str = "orders"
) -> None:
    """Raises QfolioError if a file that is written would replace one that an option reads.

    by: the option that names the file, for the message. what: its content, likewise.
    """
    if isinstance(source, str | os.PathLike) and _real(source) == _real(written):
        raise QfolioError(f"{option} and {by} name one file; give {what} their own.")


def require_outside(run: Path, written: Path, option: str) -> None:
    """Raises QfolioError if a file would lie in the folder of a run, and might replace its own."""
    if _real(written).is_relative_to(_real(run)):
        raise QfolioError(
            f"{option} is {written}, in the folder of the backtest, which has its own files there; "
            "name a place outside of it."
        )


def _real(path: os.PathLike[str] | str) -> Path:
    """What a path leads to; of links in a loop, one of them."""
    return Path(os.path.realpath(path))


def _generic(allocation: Allocation, currency: str) -> tuple[list[str], Rows]:
    """Market orders, each with its weights and its expected cost."""
    header = [
        "date", "symbol", "side", "quantity", "order_type", "price", "notional", "weight_before",
        "weight_after", "expected_cost",
    ]  # fmt: skip
    rows = []
    for i, side, quantity in _orders(allocation):
        price = float(allocation.prices[i])
        rows.append(
            [
                allocation.date,
                allocation.assets[i],
                side,
                quantity,
                "MARKET",
                price,
                round(quantity * price, 2),
                round(float(allocation.held[1 + i]), 6),
                round(float(allocation.reached[1 + i]), 6),
                round(float(allocation.order_costs[i]), 2),
            ]
        )
    return header, rows


def _interactive_brokers(allocation: Allocation, currency: str) -> tuple[list[str], Rows]:
    """A basket for the Trader Workstation: market orders for the day, routed by SMART.

    Source: IBKR Guides, "Manually Create a Basket File" and "Basket Fields".
    """
    header = [
        "Action", "Quantity", "Symbol", "SecType", "Exchange", "Currency", "TimeInForce",
        "OrderType", "BasketTag",
    ]  # fmt: skip
    tag = f"qfolio {allocation.date}"
    rows: Rows = []
    for i, side, quantity in _orders(allocation):
        if quantity != int(quantity):
            raise QfolioError(
                "A basket of Interactive Brokers takes whole shares only; add --whole-shares."
            )
        symbol = spelled(allocation.assets[i], " ")
        rows.append([side, int(quantity), symbol, "STK", "SMART", currency, "DAY", "MKT", tag])
    return header, rows


def _alpaca(allocation: Allocation, currency: str) -> tuple[list[str], Rows]:
    """Market orders for the day, in the fields of POST /v2/orders; Alpaca does not import files.

    Source: Alpaca, "Working with /orders". It answers others with "fractional orders are not
    allowed to short".
    """
    header = ["symbol", "qty", "side", "type", "time_in_force"]
    rows: Rows = []
    for i, instruction, quantity in _legs(allocation):
        if instruction == "SELL_SHORT" and quantity != int(quantity):
            raise QfolioError("Alpaca sells whole shares short only; add --whole-shares.")
        side = "buy" if instruction.startswith("BUY") else "sell"
        rows.append([spelled(allocation.assets[i], "."), quantity, side, "market", "day"])
    return header, rows


def _schwab(allocation: Allocation, currency: str) -> tuple[list[str], Rows]:
    """Market orders for the day, in the fields of the Trader API; Schwab does not import files.

    Source: Schwab Trader API, "Place Order": instruction, quantity, symbol and assetType are those
    of a leg in ``orderLegCollection``; orderStrategyType is SINGLE.
    """
    header = [
        "symbol", "assetType", "instruction", "quantity", "orderType", "session", "duration",
    ]  # fmt: skip
    rows: Rows = []
    for i, instruction, quantity in _legs(allocation):
        if quantity != int(quantity):
            raise QfolioError(
                "An order at Schwab takes whole shares only; add --whole-shares, or first trade "
                f"what is held of {allocation.assets[i]} beyond whole shares."
            )
        symbol = spelled(allocation.assets[i], "/")
        rows.append([symbol, "EQUITY", instruction, int(quantity), "MARKET", "NORMAL", "DAY"])
    return header, rows


LAYOUTS: dict[str, Callable[[Allocation, str], tuple[list[str], Rows]]] = {
    "generic": _generic,
    "ib": _interactive_brokers,
    "alpaca": _alpaca,
    "schwab": _schwab,
}
"""Layouts of an order file, by name."""


def _orders(allocation: Allocation) -> list[tuple[int, str, float]]:
    """Index, side and quantity of each asset traded; sales first, since they raise the cash."""
    scale = 10**DIGITS
    found = []
    for i in map(int, np.argsort(allocation.trades, kind="stable")):
        trade = float(allocation.trades[i])
        size = math.floor(abs(trade) * scale + 1e-3) / scale
        if size:
            side = "BUY" if trade > 0 else "SELL"
            found.append((i, side, _number(size)))
    sales = [order for order in found if order[1] == "SELL"]
    return sales + [order for order in found if order[1] == "BUY"]


def _legs(allocation: Allocation) -> list[tuple[int, str, float]]:
    """The orders, with short positions told apart: SELL, SELL_SHORT, BUY_TO_COVER or BUY.

    A trade through zero becomes two orders, of which the first closes the position.
    """
    found = []
    for i, side, quantity in _orders(allocation):
        held = float(allocation.shares[i])
        closed = min(quantity, max(held if side == "SELL" else -held, 0.0))
        first, then = ("SELL", "SELL_SHORT") if side == "SELL" else ("BUY_TO_COVER", "BUY")
        sizes = ((first, closed), (then, round(quantity - closed, DIGITS)))
        found += [(i, name, _number(size)) for name, size in sizes if size]
    return found


def spelled(name: str, mark: str) -> str:
    """An asset's name with a broker's mark before the class of a share: BRK-B, BRK.B, BRK/B.

    Other letters after a dot stand for an exchange, as in TSCO.L.
    """
    return re.sub(r"(?<=[A-Z])[-./ ](?=[ABC]$)", mark, name)


def _number(shares: float) -> float:
    """A whole number of shares without a decimal point."""
    return int(shares) if shares == int(shares) else shares
