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
class Difference:
    """Holdings given to an allocation that are not those expected.

    unfilled: date of the orders before, if the holdings are those before these; else None.
    """

    date: str  # of the allocation
    where: str  # the asset that differs most in value, or cash
    money: float  # by which it does
    total: float  # by which all assets and cash do
    unfilled: str | None


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
    short: int  # number of trades that left an overdraft
    differences: list[Difference]

    @property
    def ruin(self) -> np.datetime64 | None:
        """The date at which debts exceeded what was owned; None if they never did."""
        lost = np.flatnonzero(self.returns <= -1)
        return self.dates[lost[0]] if lost.size else None


def mark(
    records: Sequence[Record],
    prices: Prices,
    model: CostModel,
    lag: int,
    fills: Sequence[int] = (),
    band: float = 0.0,
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
        fills: For each record, the rows over which its trades are filled, in equal parts (default:
            one row).
        band: Of the calendar. An allocation within it, which trades nothing, leaves what remains of
            an earlier one.

    Raises:
        QfolioError: The ledger is empty, or prices do not fit it.
    """
    if not records:
        raise QfolioError("The ledger is empty; record an allocation with qfolio allocate first.")
    rows = np.searchsorted(prices.dates, [record.moment for record in records])
    at: dict[int, tuple[Record, int]] = {}
    for row, record, fill in zip(rows.tolist(), records, fills or [1] * len(rows), strict=True):
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
        at[row] = record, fill
    first = int(rows[0])
    account = _Account(prices, model, lag, band)
    differences: list[Difference] = []
    base = total = 0.0
    paid = flow = 0.0
    table: list[tuple[float, ...]] = []
    for row in range(first, len(prices)):
        if row > first:
            account.grow(row)
            total = account.wealth(row)
            if row > first + lag:
                # As in the backtest, an account loses at most everything, and then earns nothing.
                earned = max(total / base - 1, -1.0) if base > 0 else 0.0
                table.append((earned, total, account.cash, paid, flow, account.gross(row)))
        paid, flow = account.fill(row) if lag else 0.0, 0.0
        if row in at:
            if row > first:
                differences += account.differences(at[row][0], row)
            flow = account.take(*at[row], row) - (total - paid)
            if row == first:
                total, flow = total + flow, 0.0
        if lag == 0:  # parts of an earlier order that this row's takes the place of are not filled
            paid = account.fill(row)
        base = total + flow
    returns, wealth, money, costs, flows, gross = np.array(table).reshape(-1, 6).T
    dates = prices.dates[first + lag + 1 :]
    columns = (returns, wealth, money, costs, flows, gross)
    return Live(dates, *columns, first + lag, account.short, differences)


class _Account:
    """Units and cash along the rows of a table, and orders that are still to be filled.

    short: number of trades that left an overdraft which was not wanted.
    """

    def __init__(self, prices: Prices, model: CostModel, lag: int, band: float) -> None:
        self._model, self._lag, self._band = model, lag, band
        self._values = np.nan_to_num(prices.values)
        self._known = Conditions.of(prices, model)
        self._due: dict[int, np.ndarray] = {}  # by row
        self._loan = False  # whether negative cash was wanted
        self._taken: tuple[Record, np.ndarray] | None = None  # the last one, and its units
        self.units, self.cash, self.short = np.zeros(self._values.shape[1]), 0.0, 0

    def wealth(self, row: int) -> float:
        return self.cash + float(self.units @ self._values[row])

    def gross(self, row: int) -> float:
        """Absolute values of assets, as a multiple of wealth; infinite without any."""
        total = self.wealth(row)
        return float(abs(self.units * self._values[row]).sum()) / total if total > 0 else np.inf

    def grow(self, row: int) -> None:
        """Goes on from the row before."""
        values, earlier, known = self._values[row], self._values[row - 1], self._known
        before = np.append(self.cash, self.units * earlier)
        relatives = np.divide(values, earlier, out=np.ones(len(values)), where=earlier > 0)
        growth = self._model.growth(before, relatives, known.holding(row - 1, row))
        # What a holding earns besides its price is paid in cash, as brokers do: the shares of the
        # next record are the account's, so none may be bought with it here.
        self.cash = self.cash * growth[0] + float(before[1:] @ (growth[1:] - relatives))
        if known.listed is not None:  # delisted assets become cash, and their orders void
            gone = known.listed[row] == 0
            self.cash += float(self.units[gone] @ values[gone])
            self.units = np.where(gone, 0.0, self.units)
            self._due = {then: np.where(gone, 0.0, part) for then, part in self._due.items()}

    def _scale(self, record: Record, row: int) -> np.ndarray:
        """Units of the table for each share of a record: prices may have been adjusted since."""
        values, prices = self._values[row], np.array([price or 0.0 for price in record.prices])
        return np.divide(prices, values, out=np.ones(len(values)), where=values > 0)

    def differences(self, record: Record, row: int) -> list[Difference]:
        """Where the holdings of a later record are not those expected; at most one."""
        given = np.array(record.shares) * self._scale(record, row)
        off = np.append(record.cash - self.cash, (given - self.units) * self._values[row])
        most = int(abs(off).argmax())
        if not abs(off[most]) > 1e-6 * abs(self.wealth(row)):
            return []
        assert self._taken is not None
        before, units = self._taken
        same = np.allclose(given, units, rtol=1e-6) and not np.allclose(self.units, units)
        where = ("cash", *record.assets)[most]
        money, total = float(off[most]), float(off.sum())
        return [Difference(record.date, where, money, total, before.date if same else None)]

    def take(self, record: Record, fill: int, row: int) -> float:
        """Takes an allocation's holdings and orders; returns the wealth of these holdings.

        fill: rows over which the orders are filled.
        """
        scale = self._scale(record, row)
        self._loan = record.target[0] < -1e-6
        self.units, self.cash = np.array(record.shares) * scale, record.cash
        self._taken = record, self.units
        # Earlier orders go on until this one takes the place of what is left of them.
        if record.replaces(self._band):
            first, part = row + self._lag, np.array(record.trades) * scale / fill
            self._due = {then: parts for then, parts in self._due.items() if then < first}
            self._due |= {first + later: part for later in range(fill)}
        return self.wealth(row)

    def fill(self, row: int) -> float:
        """Fills what is due at a row's prices; returns what that costs."""
        trades, wealth = self._due.pop(row, None), self.wealth(row)
        if trades is None:
            return 0.0
        paid = 0.0
        if trades.any() and wealth > 0:
            held = np.append(self.cash, self.units * self._values[row]) / wealth
            context = context_of(self._model, self._known, row, wealth, self._lag)
            given = (self.units, self._values[row], trades)
            self.cash, costs = settled(self._model, context, held, wealth, *given)
            self.units, paid = self.units + trades, sum(costs.values())
        self.short += int(not self._loan and self.cash < -1e-9 * wealth)
        return paid
