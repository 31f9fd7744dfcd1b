"""The ledger marked to market: what its allocations have earned since."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel
from qfolio.portfolio.desk.allocation import context_of, settled
from qfolio.portfolio.desk.ledger import Record
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices


@dataclass(frozen=True)
class Live:
    """Rows since the first trade; arrays of shape (rows,)."""

    dates: np.ndarray
    returns: np.ndarray  # net; the cost of a trade is charged to the row after it
    wealth: np.ndarray  # in money, before the row's trades
    cash: np.ndarray  # part of wealth
    costs: np.ndarray  # money paid for the trades of the row before
    flows: np.ndarray  # holdings given to an allocation at the row before, less those expected
    gross: np.ndarray  # absolute values of assets, as a multiple of wealth; infinite without any
    first: int  # row of the table before the first return
    short: int  # number of trades that left an overdraft: prices rose before they were filled

    @property
    def ruin(self) -> np.datetime64 | None:
        """The date at which debts exceeded what was owned; None if they never did."""
        lost = np.flatnonzero(self.returns <= -1)
        return self.dates[lost[0]] if lost.size else None


def mark(
    records: Sequence[Record], prices: Prices, model: CostModel, lag: int, fill: int = 1
) -> Live:
    """Follows the allocations of a ledger along a price table.

    Trades of an allocation are filled from ``lag`` rows after it on, at the close, in the shares of
    the ledger and at the costs of the model, until those of a later one take their place. Each
    allocation begins with the holdings that it was given; their difference from those expected
    (deposits, other fills) is a flow, not a return. Shares are converted to units of the table:
    where an adjusted price differs from the ledger's, after a split or a dividend, the value at the
    allocation is the same.

    Args:
        records: One record for each date, in order of date.
        prices: A table with a row for each of these dates and the assets of the records.
        model: Costs of trading and holding.
        lag: Rows from an allocation to its trades.
        fill: Rows over which the trades are filled, in equal parts.

    Raises:
        QfolioError: The ledger is empty, or prices do not fit it.
    """
    if not records:
        raise QfolioError("The ledger is empty; record an allocation with qfolio allocate first.")
    rows = np.searchsorted(prices.dates, [record.moment for record in records])
    known = Conditions.of(prices, model)
    values = np.nan_to_num(prices.values)
    at: dict[int, Record] = {}
    for row, record in zip(rows.tolist(), records, strict=True):
        if row == len(prices) or prices.dates[row] != record.moment:
            raise QfolioError(
                f"The prices, {day(prices.dates[0])} to {day(prices.dates[-1])}, have no row of "
                f"{record.date}, on which record {record.number} was made; give a table with it."
            )
        if tuple(record.assets) != prices.assets:
            raise QfolioError(
                f"Record {record.number} has other assets than the price table; give a table with "
                "the record's."
            )
        at[row] = record
    first = int(rows[0])
    units, cash = np.zeros(values.shape[1]), 0.0
    base = total = paid = flow = 0.0
    due: dict[int, np.ndarray] = {}
    table: list[tuple[float, ...]] = []
    short, loan = 0, False
    for row in range(first, len(prices)):
        if row > first:
            before = np.append(cash, units * values[row - 1])
            relatives = np.divide(
                values[row], values[row - 1], out=np.ones(len(units)), where=values[row - 1] > 0
            )
            growth = model.growth(before, relatives, known.holding(row - 1, row))
            # What a holding earns besides its price is paid in cash, as brokers do: the shares
            # of the next record are the account's, so none may be bought with it here.
            cash = cash * growth[0] + float(before[1:] @ (growth[1:] - relatives))
            if known.listed is not None:  # delisted assets become cash, and their orders void
                gone = known.listed[row] == 0
                cash += float(units[gone] @ values[row][gone])
                units = np.where(gone, 0.0, units)
                due = {then: np.where(gone, 0.0, part) for then, part in due.items()}
            total = cash + float(units @ values[row])
            if row > first + lag:
                # As in the backtest, an account loses at most everything, and then earns nothing.
                earned = max(total / base - 1, -1.0) if base > 0 else 0.0
                held = float(abs(units * values[row]).sum())
                gross = held / total if total > 0 else np.inf
                table.append((earned, total, cash, paid, flow, gross))
        paid, flow, after = 0.0, 0.0, total
        if row in due:
            units, cash, paid = _filled(due.pop(row), units, cash, prices, row, model)
            after, short = total - paid, short + (not loan and cash < -1e-9 * total)
        if row in at:
            record = at[row]
            loan = record.target[0] < -1e-6  # negative cash was wanted
            scale = np.divide(
                np.array([price or 0.0 for price in record.prices]), values[row],
                out=np.ones(len(units)), where=values[row] > 0,
            )  # fmt: skip
            units, cash = np.array(record.shares) * scale, record.cash
            flow = cash + float(units @ values[row]) - after
            if row == first:
                total, flow = total + flow, 0.0
            part = np.array(record.trades) * scale / fill
            # Earlier orders go on until this one takes the place of what is left of them.
            due = {then: parts for then, parts in due.items() if then < row + lag}
            due |= {row + lag + later: part for later in range(fill)}
            if lag == 0:
                units, cash, more = _filled(due.pop(row), units, cash, prices, row, model)
                paid, short = paid + more, short + (not loan and cash < -1e-9 * total)
        base = total + flow
    returns, wealth, money, costs, flows, gross = np.array(table).reshape(-1, 6).T
    dates = prices.dates[first + lag + 1 :]
    return Live(dates, returns, wealth, money, costs, flows, gross, first + lag, int(short))


def _filled(
    trades: np.ndarray, units: np.ndarray, cash: float, prices: Prices, row: int, model: CostModel
) -> tuple[np.ndarray, float, float]:
    """Units and cash after trades at a row's prices, and what they cost."""
    values = np.nan_to_num(prices.values[row])
    wealth = cash + float(units @ values)
    if not trades.any() or wealth <= 0:
        return units, cash, 0.0
    held = np.append(cash, units * values) / wealth
    context = context_of(model, prices.between(None, row + 1), wealth)
    left, costs = settled(model, context, held, wealth, units, values, trades)
    return units + trades, left, sum(costs.values())
