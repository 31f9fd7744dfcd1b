"""From a run to orders: allocations that the run's ledger records and can reproduce."""

import datetime
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.registry import again
from qfolio.core.text import amount, listed, near, quote
from qfolio.core.version import __version__
from qfolio.portfolio import anchors
from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.backtest.baselines.base import window_rows
from qfolio.portfolio.backtest.folder import BacktestFolder
from qfolio.portfolio.backtest.folds import latest
from qfolio.portfolio.backtest.own import Own
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.calendars import band, decision_rows
from qfolio.portfolio.desk.allocation import NOISE, Allocation
from qfolio.portfolio.desk.holdings import cashed_out
from qfolio.portfolio.desk.ledger import Ledger, Record, file_digest, holdings_digest
from qfolio.portfolio.desk.standing import Kind
from qfolio.portfolio.desk.untrained import Ordered, Rule, Untrained
from qfolio.portfolio.policy import UNKNOWN, Policy
from qfolio.portfolio.prices.findings import Finding, day, first_of
from qfolio.portfolio.prices.frequency import require_alike, spacing
from qfolio.portfolio.prices.table import Prices, accepted, inspect

SLOW = 6.0
"""Days between the rows of a table from which on a lag of one is no longer the next day."""

LATE = 5
"""Last rows without a price that may only be late; of more, an asset may be said to be delisted."""

SAME = 1e-6
"""How far reproduced weights may be off: policies decide in float32, which differs by machine."""


@dataclass
class Desk:
    """A run whose agents, baselines and strategies of the user's own are followed.

    inspect: how prices are read, from the options of the command line. findings: what was found on
    the table that was read last. delists: whether the user said that prices which end early are
    those of delisted assets.
    """

    run: Backtest
    folder: Path
    inspect: Callable[..., tuple[Prices | None, list[Finding]]] = field(default=inspect)
    findings: list[Finding] = field(default_factory=list)
    delists: bool = False

    @staticmethod
    def open(folder: Path | str, **options: Any) -> "Desk":
        """The desk of a finished backtest; options are those of ``prices.load``."""
        run = Backtest.open(folder)
        known = {**options, "features": options.get("features") or tuple(run.config.feature_names)}
        known["columns"] = options.get("columns") or tuple(run.config.prices.get("columns", ()))
        ends = "gap" if run.prices.listed is None else "cash-out"
        known["ended"] = options.get("ended") or ends
        if known.get("delisting_haircut") is None:
            lost = run.prices.haircut if known["ended"] == "cash-out" else None
            known["delisting_haircut"] = lost or 0.0
        # Policies and baselines look at the last rows only; assets may start at any row before.
        known["late"] = "join"
        delists = options.get("ended") == "cash-out"
        return Desk(run, Path(folder), partial(inspect, **known), delists=delists)

    @property
    def ledger(self) -> Ledger:
        return Ledger(self.folder / "ledger")

    @property
    def resume(self) -> str:
        """The command line that finishes the backtest, or writes its tables again."""
        return again("qfolio backtest --resume", self.folder, *self.run.parts)

    @property
    def debts(self) -> bool:
        """Whether its mandate lets assets be sold short or cash be borrowed."""
        return not self.run.any_task.feasible.long_only

    @cached_property
    def own(self) -> dict[str, Own]:
        """The user's own strategies, and the benchmark if it is a file or an asset."""
        return BacktestFolder(self.folder).read_own(self.run.config)

    def kind(self, name: str) -> Kind:
        """What a name stands for; raises QfolioError if the backtest has no such strategy."""
        known: dict[Kind, Any] = {
            "agent": self.run.agents, "baseline": self.run.baselines, "strategy": self.own,
        }  # fmt: skip
        for kind, names in known.items():
            if name in names:
                return kind
        names = [name for names in known.values() for name in names]
        raise QfolioError(
            f"The backtest has no agent, baseline or strategy {quote(name)}; {near(name, names)}"
        )

    def followed(self, name: str, stored: str | None = None) -> Policy | Untrained:
        """An agent's policy (default: the newest), a baseline, or a strategy of the user's own.

        Raises QfolioError if there is none of this name, or its weights are not known.
        """
        kind = self.kind(name)
        if kind == "agent":
            return self.run.policy(name, stored)
        config, assets = self.run.config, self.run.prices.assets
        task = self.run.any_task
        if kind == "strategy":
            return Ordered(name, self.own[name], assets, task, config.cap)
        return Rule(
            name,
            self.run.baselines[name],
            assets,
            task,
            train=config.train,
            expanding=config.expanding,
            cap=config.cap,
        )

    def table(self, followed: Policy | Untrained, prices: Path | None) -> Prices:
        """The prices to decide on (default: those of the backtest).

        Raises QfolioError, also if no asset may be held at their last row.
        """
        if prices is None:
            return self.run.prices
        table = self.read(prices)
        if (there := table.tradable) is not None and not there[-1].any():
            raise QfolioError(
                f"No asset may be held on {day(table.dates[-1])}, so that all would be sold; give "
                "the latest memberships with --members."
            )
        return followed.table(table)

    def read(self, prices: Path | None) -> Prices:
        """The latest prices of the backtest's assets (default: those of the backtest).

        Raises:
            QfolioError: They cannot be read, are of other assets or another frequency, or those of
                some asset end early.
        """
        if prices is None:
            return self.run.prices
        read, self.findings = self.inspect(prices)
        table = accepted(read, self.findings, prices)
        if table.members is None and self.run.prices.members is not None:
            raise QfolioError(
                "The backtest's universe has members that change over time; give the latest "
                "memberships with --members."
            )
        known = self.run.prices
        if known.listed is not None:
            gone = np.flatnonzero(~known.listed[-1] & ~np.isin(known.assets, table.assets)).tolist()
            if gone:
                raise QfolioError(
                    f"The price table lacks {_with_ends(known, gone)}, delisted in the backtest; "
                    "give prices that begin earlier, as the backtest's do."
                )
        table = table.exactly(known.assets, "the backtest")
        require_alike(table.dates, known.periods_per_year, "the backtest has")
        self._require_last_prices(table)
        return table

    def _require_last_prices(self, table: Prices) -> None:
        """Raises QfolioError if prices may be late, unless the user said that assets ended."""
        listed, ended = table.listed, self._ended(table)
        late = [] if listed is None else [j for j in ended if listed[-1 - LATE :, j].any()]
        if late and not self.delists:
            raise QfolioError(
                f"The prices end on {day(table.dates[-1])}, but those of {_with_ends(table, late)} "
                "end earlier; fetch them again or, if the assets were delisted, add --ended "
                "cash-out."
            )

    def _ended(self, table: Prices) -> list[int]:
        """The assets that were there at the backtest's end and are no more at a table's."""
        if table.listed is None:
            return []
        before = self.run.prices.listed
        there = True if before is None else before[-1]
        return np.flatnonzero(there & ~table.listed[-1]).tolist()

    @property
    def news(self) -> list[Finding]:
        """The findings on those rows of the last table read that are later than the backtest's."""
        last = day(self.run.prices.dates[-1])
        return [found for found in self.findings if found.date and found.date > last]

    def hindsight(self, followed: Policy | Untrained, table: Prices) -> str:
        """Says so if a policy has learned from later rows than a table's last one; else ""."""
        last = table.dates[-1]
        if not isinstance(followed, Policy) or not followed.learned > last:
            return ""
        return (
            f"The policy has learned from prices up to {day(followed.learned)}, which were not "
            f"known on {day(last)}"
        )

    def fill(self, name: str) -> int:
        """Rows over which orders are filled: those of the user's own strategies at once."""
        return 1 if self.kind(name) == "strategy" else self.run.any_task.terms.fill

    def spent(
        self, followed: Policy | Untrained, table: Prices, before: int | None = None
    ) -> float:
        """The ledger's turnover since the calendar year of a table's last row began.

        Of an order that is filled over several rows, the parts of earlier rows count, until a later
        order takes its place. It is 0 if the mandate does not limit turnover. before: number of a
        record; only those before it count (default: all).
        """
        if followed.task.written.trading.turnover_a_year is None:
            return 0.0
        band = self.run.any_task.terms.band
        records = [record for record in self.ledger.current(before) if record.replaces(band)]
        rows = np.searchsorted(table.dates, [record.moment for record in records]).tolist()
        years, last = table.dates.astype("datetime64[Y]"), len(table) - 1
        total = 0.0
        for record, row, until in zip(records, rows, [*rows, last][1:], strict=True):
            fill = self.fill(record.agent)
            filled = years[row : min(row + fill, until, last)]
            share = float((filled == years[-1]).sum()) / fill
            if record.moment < table.dates[0]:  # the table does not say which parts were filled
                share = float(record.moment.astype("datetime64[Y]") == years[-1])
            total += share * record.turnover
        return total

    def terms(
        self, followed: Policy | Untrained, table: Prices, allocation: Allocation, spent: float
    ) -> list[str]:
        """Sentences on when and how the backtest and its mandate would trade an allocation."""
        trading = followed.task.written.trading
        given = followed, table, allocation
        said = [*self._doubts(*given), *self._timing(*given)]
        if allocation.trades.any():
            said += [*waiting(table, self.run.config.lag), *self._pending(table)]
        if trading.fill > 1:
            said.append(
                f"The mandate fills orders over {trading.fill} rows: trade an equal part of each "
                "order at each of these rows. The expected cost assumes a single trade; fees per "
                "trade and market impact will differ."
            )
        if (most := trading.turnover_a_year) is not None:
            said.append(
                f"The mandate allows a turnover of {most:.0%} a year: the ledger's orders have "
                f"used {spent:.1%} this year, and this one uses {allocation.turnover:.1%}."
            )
        return said

    def _doubts(
        self, followed: Policy | Untrained, table: Prices, allocation: Allocation
    ) -> Iterator[str]:
        """What an order rests on and the user may know better."""
        if ended := self._ended(table):
            yield f"These assets count as delisted since the backtest: {_with_ends(table, ended)}."
        dates = self.run.prices.dates
        known = np.concatenate([dates[dates < table.dates[0]], table.dates])
        late = UNKNOWN
        # Where assets come and go, a rule without estimates may hold each from its first price on.
        if table.tradable is None or (isinstance(followed, Rule) and followed.baseline.estimates):
            before = self.run.prices
            late = before.dates[min(int(before.first_rows.max()), len(before) - 1)]
        what, rows = lookback(followed, known, table.month, late)
        if rows > len(table):
            yield (
                f"The prices begin on {day(table.dates[0])}, but {what} looks back to "
                f"{day(known[-rows])}; give them from there on, as the backtest has them, or the "
                "orders may differ from those that it would give."
            )
        records = [record for record in self.ledger.current() if record.moment < table.dates[-1]]
        # Cash may have earned interest since, or paid a fee.
        same = records and np.allclose(allocation.shares, records[-1].shares, rtol=1e-9, atol=1e-5)
        if same and any(records[-1].trades):
            yield (
                f"The holdings are those of record {records[-1].number} before its trades; if "
                "these were filled, export the holdings again."
            )

    def _pending(self, table: Prices) -> list[str]:
        """Says so if parts of earlier orders are filled between the last row and its trade."""
        last, lag = len(table) - 1, self.run.config.lag
        if lag < 2:
            return []
        records = [record for record in self.ledger.current() if any(record.trades)]
        moments = np.array([record.moment for record in records], table.dates.dtype)
        rows = np.searchsorted(table.dates, moments)
        fills = np.array([self.fill(record.agent) for record in records], int)
        pending = (rows < last) & (last < rows + lag + fills - 1)
        dates = [record.date for record, yes in zip(records, pending, strict=True) if yes]
        if not dates:
            return []
        return [
            f"With the backtest's lag of {lag} rows, the orders of {listed(dates)} are not filled "
            "yet; if the holdings do not contain them, the same trades are ordered again."
        ]

    def _timing(
        self, followed: Policy | Untrained, table: Prices, allocation: Allocation
    ) -> list[str]:
        """Says so if the backtest's calendar has no order at a table's last row.

        The first allocation is due at any row, as in the backtest, and strategies of the user's own
        have their own dates.
        """
        terms, calendar = followed.task.terms, self.run.config.calendar
        days, within = table.dates, band(calendar)
        if not allocation.trades.any():
            if abs(allocation.weights - allocation.held)[1:].max() > NOISE:
                return [
                    "Nothing is ordered: every trade is less than a whole share or lot, or costs "
                    "more than it moves."
                ]
            if within:
                far = f"no weight is more than {within:g} from what is wanted"
                return [f"Nothing is ordered: {far}."]
        started = any(record.moment < days[-1] for record in self.ledger.current())
        if not started or isinstance(followed, Ordered) or terms.calls(allocation.held):
            return []
        if calendar.isdecimal() and days[0] != self.run.prices.dates[0]:
            return []  # rows are counted from the first one of the backtest
        due = decision_rows(calendar, days)
        if due[-1]:
            return []
        often = f"every {calendar} rows" if calendar.isdecimal() else calendar
        return [
            f"The backtest decides {often}, and would not on {day(days[-1])}; its latest decision "
            f"was due on {day(days[due][-1])}."
        ]

    def record(
        self, name: str, allocation: Allocation, prices: Prices, whole_shares: bool
    ) -> tuple[Record, str]:
        """Appends an allocation by the newest policy of an agent, or by another strategy.

        Returns the record, and a sentence that says what was done.
        """
        learned = name in self.run.agents
        stored = self.run.newest(name) if learned else None
        held = holdings_digest(allocation.assets, allocation.shares, allocation.cash)
        digests = {"prices": prices.sha256, "holdings": held, **self._digests(name, stored)}
        return self.ledger.append(
            allocation,
            prices,
            keep_prices=prices.sha256 != self.run.prices.sha256,
            agent=name,
            policy=stored,
            digests=digests,
            whole_shares=whole_shares,
            made=datetime.datetime.now().astimezone().isoformat(" ", "seconds"),
            version=__version__,
        )

    def reproduce(
        self,
        date: str,
        prices: Path | None = None,
        holdings: tuple[np.ndarray, float] | None = None,
    ) -> tuple[Record, Allocation]:
        """The allocation of a date, computed again.

        Args:
            date: Date of the allocation, as in the ledger.
            prices: Prices to compare with those of the ledger; later rows are left out.
            holdings: Shares and cash to compare with those of the ledger.

        Raises:
            QfolioError: An input or the result differs; the error says which.
        """
        record = self.ledger.on(date)
        name = f"Record {record.number} ({record.date})"
        digests = self._digests(record.agent, record.policy)
        followed = self.followed(record.agent, record.policy)
        if prices is None:
            table = self.ledger.prices(record, self.run.prices)
        else:
            table = self.table(followed, prices)
            table = table.between(None, int((table.dates <= record.moment).sum()))
        shares, cash = np.array(record.shares), record.cash
        if holdings is not None:
            shares, cash, _ = cashed_out(*holdings, table)
        digests["prices"] = table.sha256
        digests["holdings"] = holdings_digest(self.run.prices.assets, shares, cash)
        said = {
            "prices": f"the prices up to {record.date}",
            "policy": f"the file of the policy {record.policy}",
            "settings": "config.json",
            "holdings": "the holdings",
        }
        differing = [
            words for key, words in said.items() if digests.get(key) != record.digests.get(key)
        ]
        if differing:
            raise QfolioError(
                f"{name} cannot be reproduced: {' and '.join(differing)} differ from those of the "
                "ledger; restore them."
            )
        spent = self.spent(followed, table, record.number)
        whole = record.whole_shares
        remade = Allocation.of(
            followed, table, shares, cash, whole_shares=whole, spent=spent, debts=self.debts
        )
        off = float(abs(remade.weights - np.array(record.target)).max())
        if off > SAME:
            raise QfolioError(
                f"{name} gives other weights from the same inputs: one is off by {off:.2g}; use "
                f"qfolio {record.version}, which made it (this is {__version__})."
            )
        return record, remade

    def _digests(self, name: str, stored: str | None) -> dict[str, str]:
        """Digests of the run's settings and, with ``stored``, of an agent's policy."""
        found = {"settings": file_digest(self.folder / "config.json")}
        if stored is not None:
            path = BacktestFolder(self.folder).policy_file(name, stored)
            if not path.is_file():
                raise QfolioError(f"{path} is missing; restore it.")
            found["policy"] = file_digest(path)
        return found


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


def _with_ends(table: Prices, which: list[int]) -> str:
    """Assets that ended, each with the date of its last price."""
    assert table.listed is not None
    ends = {j: table.dates[np.flatnonzero(table.listed[:, j])[-1]] for j in which}
    return first_of(f"{table.assets[j]} ({day(end)})" for j, end in ends.items())


def waiting(prices: Prices, lag: int) -> list[str]:
    """Says so if orders wait for long, because the rows of a table are far apart."""
    usual = spacing(prices.dates)[1] if len(prices) > 1 else 0.0
    if not lag or usual < SLOW:
        return []
    return [
        f"The backtest and follow fill these orders {amount(lag, 'row')} later, after about "
        f"{lag * usual:.0f} days; if you trade at once, allocate from a backtest with --lag 0."
    ]
