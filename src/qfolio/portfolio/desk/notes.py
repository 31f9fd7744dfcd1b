"""What the desk has to say of an allocation besides its figures, in sentences."""

import datetime
from collections.abc import Sequence

import numpy as np

from qfolio.core.text import amount, listed
from qfolio.portfolio import anchors
from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.backtest.baselines.base import window_rows
from qfolio.portfolio.backtest.folds import latest
from qfolio.portfolio.calendars import band, decision_rows
from qfolio.portfolio.costs import CostModel
from qfolio.portfolio.desk.allocation import NOISE, Allocation, duration
from qfolio.portfolio.desk.ledger import Record
from qfolio.portfolio.desk.untrained import Ordered, Rule, Untrained
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.policy import UNKNOWN, Policy
from qfolio.portfolio.prices.findings import day, first_of
from qfolio.portfolio.prices.frequency import spacing
from qfolio.portfolio.prices.table import Prices

DEAR = 0.02
"""Share of the value traded from which on a cost is remarkable."""

FAR = 5.0
"""Factor between an account and the backtest's capital from which on costs that depend on wealth
say little about the account's."""

SLOW = 6.0
"""Days between the rows of a table from which on a lag of one is no longer the next day."""


def hindsight(followed: Policy | Untrained, table: Prices) -> str:
    """Says so if a policy has learned from later rows than a table's last one; else ""."""
    last = table.dates[-1]
    if not isinstance(followed, Policy) or not followed.learned > last:
        return ""
    return (
        f"The policy has learned from prices up to {day(followed.learned)}, which were not "
        f"known on {day(last)}"
    )


def learned(policy: Policy) -> list[str]:
    """Says why a policy that was to be updated is not."""
    return [
        f"The policy has already learned from the prices up to {day(policy.learned)}, and is "
        "followed as it is, even if they were corrected since."
    ]


def ended(table: Prices, which: list[int]) -> list[str]:
    """Says so if assets have ended since the backtest."""
    if not which:
        return []
    return [f"These assets count as delisted since the backtest: {with_ends(table, which)}."]


def with_ends(table: Prices, which: list[int]) -> str:
    """Assets that ended, each with the date of its last price."""
    assert table.listed is not None
    ends = {j: table.dates[np.flatnonzero(table.listed[:, j])[-1]] for j in which}
    return first_of(f"{table.assets[j]} ({day(end)})" for j, end in ends.items())


def too_short(followed: Policy | Untrained, table: Prices, known: Prices) -> list[str]:
    """Says so if a table begins later than its strategy looks back.

    known: the backtest's prices.
    """
    dates = np.concatenate([known.dates[known.dates < table.dates[0]], table.dates])
    late = UNKNOWN
    # Where assets come and go, a rule without estimates may hold each from its first price on.
    if table.tradable is None or (isinstance(followed, Rule) and followed.baseline.estimates):
        late = known.dates[min(int(known.first_rows.max()), len(known) - 1)]
    what, rows = lookback(followed, dates, table.month, late)
    if rows <= len(table):
        return []
    return [
        f"The prices begin on {day(table.dates[0])}, but {what} looks back to "
        f"{day(dates[-rows])}; give them from there on, as the backtest has them, or the "
        "orders may differ from those that it would give."
    ]


def lookback(
    followed: Policy | Untrained, dates: np.ndarray, month: int, late: np.datetime64 = UNKNOWN
) -> tuple[str, int]:
    """What of a strategy looks back on most rows of a table, and on how many.

    A policy's signals are not counted: it needs the rows that they look back on.

    late: date of the first price of the last asset to start. A baseline holds an asset once it has
    prices in all of the training window, and cannot tell where these begin later.
    """
    found = {"": 0}
    task = followed.task
    if isinstance(followed, Rule):
        fold, rows = latest("", dates, followed.train, followed.expanding), 0
        if followed.baseline.estimates:
            months, least = followed.baseline.months, followed.baseline.least
            window = len(dates) if months is None else window_rows(months, least, month)
            rows = min(window, fold.train.stop - fold.train.start)
        if late > dates[fold.recent.start]:
            rows = max(rows, fold.recent.stop - fold.recent.start)
        found[followed.name] = rows
    if any(baseline(name).estimates for name in anchors.baselines(task.anchor)):
        found["the agent's anchor"] = (anchors.MONTHS + 1) * month  # it decides once a month
    risk = task.written.risk
    limited = risk.volatility is not None or risk.tracking_error is not None
    if limited and not isinstance(followed, Ordered):
        found["the mandate's limit on risk"] = risk.rows + 1
    what = max(found, key=found.__getitem__)
    return what, min(found[what], len(dates))


def aged(table: Prices, age: datetime.timedelta) -> list[str]:
    """Says so if prices of several times a day are older than two of their rows."""
    usual = spacing(table.dates)[1] if len(table) > 1 else 1.0
    if usual >= 1 or age <= datetime.timedelta(days=2 * usual):
        return []
    return [
        f"The latest prices, of {day(table.dates[-1])}, are {duration(age)} old if their times are "
        "in UTC; the orders are made at them."
    ]


def not_traded(allocation: Allocation, earlier: Sequence[Record]) -> list[str]:
    """Says so if the holdings are those of an earlier record before its trades.

    They are not, if they are also those of a later record, or the same, after its trades.
    """
    for record in reversed(earlier):
        after = np.add(record.shares, record.trades)
        if any(record.trades) and np.allclose(allocation.shares, after, rtol=1e-9, atol=1e-5):
            break
        # Cash may have earned interest since, or paid a fee; alone, it tells how much there is.
        before = np.allclose(allocation.shares, record.shares, rtol=1e-9, atol=1e-5)
        if not any(record.shares):
            before &= abs(allocation.cash - record.cash) <= 0.01 * abs(record.cash)
        if before and any(record.trades):
            return [
                f"The holdings are those of record {record.number} before its trades; if "
                "these were filled, export the holdings again."
            ]
    return []


def nothing_ordered(allocation: Allocation, calendar: str) -> list[str]:
    """Says why an allocation has no trades; nothing if the holding is what is wanted."""
    if allocation.trades.any():
        return []
    if abs(allocation.weights - allocation.held)[1:].max() > NOISE:
        return [
            "Nothing is ordered: every trade is less than a whole share or lot, or costs "
            "more than it moves."
        ]
    if within := band(calendar):
        return [f"Nothing is ordered: no weight is more than {within:g} from what is wanted."]
    return []


def not_due(calendar: str, table: Prices, known: Prices) -> list[str]:
    """Says so if the backtest's calendar has no order at a table's last row.

    known: the backtest's prices.
    """
    days = table.dates
    if calendar.isdecimal() and days[0] != known.dates[0]:
        return []  # rows are counted from the first one of the backtest
    due = decision_rows(calendar, days)
    if due[-1]:
        return []
    often = f"every {calendar} rows" if calendar.isdecimal() else calendar
    return [
        f"The backtest decides {often}, and would not on {day(days[-1])}; its latest decision "
        f"was due on {day(days[due][-1])}."
    ]


def waiting(prices: Prices, lag: int) -> list[str]:
    """Says so if orders wait for long, because the rows of a table are far apart."""
    usual = spacing(prices.dates)[1] if len(prices) > 1 else 0.0
    if not lag or usual < SLOW:
        return []
    return [
        f"The backtest and follow fill these orders {amount(lag, 'row')} later, after about "
        f"{lag * usual:.0f} days; if you trade at once, allocate from a backtest with --lag 0."
    ]


def pending(table: Prices, lag: int, earlier: Sequence[Record], fills: Sequence[int]) -> list[str]:
    """Says so if parts of earlier orders are filled between a table's last row and its trade.

    fills: for each record, the rows over which its orders are filled.
    """
    if lag < 2:
        return []
    last = len(table) - 1
    moments = np.array([record.moment for record in earlier], table.dates.dtype)
    rows = np.searchsorted(table.dates, moments).tolist()
    dates = [
        record.date
        for record, row, fill in zip(earlier, rows, fills, strict=True)
        if any(record.trades) and row < last < row + lag + fill - 1
    ]
    if not dates:
        return []
    return [
        f"With the backtest's lag of {lag} rows, the orders of {listed(dates)} are not filled "
        "yet; if the holdings do not contain them, the same trades are ordered again."
    ]


def filled_over(rows: int) -> list[str]:
    """Says so if the mandate fills orders over several rows."""
    if rows == 1:
        return []
    return [
        f"The mandate fills orders over {rows} rows: trade an equal part of each order at each of "
        "these rows. The expected cost is that of all parts, each with its own fees."
    ]


def dear(allocation: Allocation) -> list[str]:
    """Says so if the expected cost is a large part of what is traded."""
    moved = float(np.nansum(abs(allocation.trades * allocation.prices)))
    if not allocation.cost > DEAR * moved:
        return []
    return [
        f"The expected cost is {allocation.cost / moved:.1%} of the value traded, "
        f"{moved:,.2f}: fees weigh less on larger orders, and market impact on smaller ones."
    ]


def other_capital(wealth: float, costs: CostModel) -> list[str]:
    """Says so if an account is far from the capital on which the backtest's costs depend."""
    if not isinstance(costs, Itemized) or not costs.depends_on_wealth:
        return []
    if 1 / FAR < wealth / costs.capital < FAR:
        return []
    return [
        f"The account is worth {wealth:,.2f}, but the backtest began with a capital of "
        f"{costs.capital:,.0f}, on which its costs depend; to learn what they leave of such an "
        f"account, run it with capital={wealth:.0f} in --cost-model."
    ]


def budget(most: float | None, spent: float, allocation: Allocation) -> list[str]:
    """What is used of the turnover that the mandate allows in a year, if it limits it.

    spent: turnover of the ledger's orders since the year began.
    """
    if most is None:
        return []
    return [
        f"The mandate allows a turnover of {most:.0%} a year: the ledger's orders have "
        f"used {spent:.1%} this year, and this one uses {allocation.turnover:.1%}."
    ]
