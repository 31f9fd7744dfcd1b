"""From a run to orders: allocations that the run's ledger records and can reproduce."""

import datetime
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.files import path_of
from qfolio.core.mdp import Agent
from qfolio.core.registry import again
from qfolio.core.text import amount, near, quote
from qfolio.core.version import __version__
from qfolio.portfolio.backtest.folder import BacktestFolder
from qfolio.portfolio.backtest.own import Own
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.desk import notes
from qfolio.portfolio.desk.allocated import Allocated
from qfolio.portfolio.desk.allocation import Allocation, require_fresh
from qfolio.portfolio.desk.doubts import require_plausible
from qfolio.portfolio.desk.drivers import reasons, sentence
from qfolio.portfolio.desk.history import revisions
from qfolio.portfolio.desk.holdings import cashed_out, read_holdings
from qfolio.portfolio.desk.ledger import Ledger, Record, file_digest, holdings_digest
from qfolio.portfolio.desk.orders_csv import (
    order_rows,
    prepared,
    require_apart,
    require_outside,
)
from qfolio.portfolio.desk.standing import Kind, Standing
from qfolio.portfolio.desk.untrained import Ordered, Rule, Untrained
from qfolio.portfolio.mandate.limits import lots
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.prices.findings import Finding, day
from qfolio.portfolio.prices.frequency import require_alike
from qfolio.portfolio.prices.table import Prices, accepted, inspect

LATE = 5
"""Last rows without a price that may only be late; of more, an asset may be said to be delisted."""

SAME = 1e-6
"""How far reproduced weights may be off: policies decide in float32, which differs by machine."""


@dataclass
class Desk:
    """A run whose agents, baselines and strategies of the user's own are followed.

    inspect: how prices are read, from the options of the command line. news: what was found on the
    table that was read last and the backtest did not know: on later rows, and where its history is
    another. delists: whether the user said that prices which end early are those of delisted
    assets.
    """

    run: Backtest
    folder: Path
    inspect: Callable[..., tuple[Prices | None, list[Finding]]] = field(default=inspect)
    news: list[Finding] = field(default_factory=list)
    delists: bool = False

    @staticmethod
    def open(
        folder: Path | str, agents: Mapping[str, Agent] | None = None, **options: Any
    ) -> "Desk":
        """The desk of a finished backtest.

        agents: by name, those that the folder cannot restore, as for ``Backtest.open``. options:
        those of ``prices.load``.
        """
        run = Backtest.open(folder, agents)
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
        """The records of past allocations."""
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

    def table(self, followed: Policy | Untrained, prices: Any) -> Prices:
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

    def read(self, prices: Any) -> Prices:
        """The latest prices of the backtest's assets (default: those of the backtest).

        Raises:
            QfolioError: They cannot be read, are of other assets or another frequency, or those of
                some asset end early or are another's.
        """
        if prices is None:
            return self.run.prices
        read, findings = self.inspect(prices)
        table = accepted(read, findings, prices)
        last = day(self.run.prices.dates[-1])
        self.news = [found for found in findings if found.date and found.date > last]
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
                    f"The price table lacks {notes.with_ends(known, gone)}, delisted in the "
                    "backtest; give prices that begin earlier, as the backtest's do."
                )
        table = table.exactly(known.assets, "the backtest")
        require_alike(table.dates, known.periods_per_year, "the backtest has")
        self.news = [*revisions(known, table), *self.news]
        self._require_last_prices(table)
        return table

    def _require_last_prices(self, table: Prices) -> None:
        """Raises QfolioError if prices may be late, unless the user said that assets ended."""
        listed, ended = table.listed, self._ended(table)
        late = [] if listed is None else [j for j in ended if listed[-1 - LATE :, j].any()]
        if late and not self.delists:
            raise QfolioError(
                f"The prices end on {day(table.dates[-1])}, but those of "
                f"{notes.with_ends(table, late)} end earlier; fetch them again or, if the assets "
                "were delisted, add --ended cash-out."
            )

    def _ended(self, table: Prices) -> list[int]:
        """The assets that were there at the backtest's end and are no more at a table's."""
        if table.listed is None:
            return []
        before = self.run.prices.listed
        there = True if before is None else before[-1]
        return np.flatnonzero(there & ~table.listed[-1]).tolist()

    def allocate(
        self,
        agent: str | None = None,
        prices: Any = None,
        holdings: Path | str | None = None,
        capital: float | None = None,
        *,
        anyway: bool = False,
        whole_shares: bool = False,
        as_of: str | datetime.date | None = None,
        update: bool = False,
        orders: Path | str | None = None,
        layout: str = "generic",
        currency: str = "USD",
        dry_run: bool = False,
    ) -> Allocated:
        """Tomorrow's trades, which the ledger records.

        If anything fails, the ledger and the file of orders stay as they were. If the process is
        killed, the orders are those before it until there is a record, and the same allocation made
        again writes its own. A policy may have been updated in both cases; it is followed then.

        The arguments are the options of ``qfolio allocate``, but ``prices`` may be anything that
        ``qfolio.load_prices`` reads (default: those of the backtest).

        Raises:
            QfolioError: The backtest advises against the agent, an input does not fit, the last
                prices are doubtful, or the policy has learned from later ones.
        """
        source = None if holdings is None else path_of("holdings", holdings)
        place = None if orders is None else path_of("orders", orders)
        if place is not None:
            require_apart(place, "--prices", prices)
            require_apart(place, "--holdings", source)
            require_outside(self.folder, place, "--orders")
        name = next(iter(self.run.agents)) if agent is None else agent
        standing = Standing.of(self.folder, name, self.kind(name))
        if not anyway:
            standing.require_sound(self.resume, named=agent is not None)
        stored = self.run.newest(name) if standing.kind == "agent" else None
        followed = self.followed(name, stored)
        table = self.table(followed, prices)
        if table.levels:
            in_shares = whole_shares or holdings is not None or orders is not None
            _require_weights_alone(followed, in_shares)
        age = require_fresh(table, as_of)
        held = read_holdings(source, table.assets, capital, debts=self.debts)
        shares, cash, said = cashed_out(*held, table)
        if not anyway:
            open_ = True if table.tradable is None else table.tradable[-1]
            require_plausible(table, (shares != 0) | open_)
        updated = None
        if update:
            if not isinstance(followed, Policy):
                raise QfolioError(f"{name} learns nothing; leave out --update.")
            if followed.learned == table.dates[-1]:  # as when this is done again
                said += notes.learned(followed)
            else:
                followed = updated = followed.update(table)
        hindsight = notes.hindsight(followed, table)
        if hindsight and not anyway:
            raise QfolioError(
                f"{hindsight}; give later prices, or add --anyway, which then records nothing."
            )
        spent = self.spent(followed, table)
        allocation = self._allocation(followed, table, shares, cash, whole_shares, spent)
        wanted = None
        if place is not None:
            wanted = place, *order_rows(allocation, layout, currency)
        trained, why = None, None
        if isinstance(followed, Policy):
            trained = "an unknown date" if np.isnat(followed.learned) else day(followed.learned)
            why = reasons(followed, table, allocation, spent)
            said = [*(f"Why {sentence(reason)}" for reason in why), *said]
        else:
            said = [*said, *followed.notes(table, allocation.held, spent=spent)]
        said += notes.aged(table, age)
        said += self.terms(followed, table, allocation, spent)
        record, done = None, "A dry run: nothing is written."
        if not dry_run:
            with nullcontext(lambda: None) if wanted is None else prepared(*wanted) as write:
                if hindsight:
                    write()
                    done = f"{hindsight}, so that nothing is recorded."
                else:
                    record, done = self.record(
                        name, allocation, table, whole_shares, stored, updated, write
                    )
            if wanted is not None:
                done += f" {wanted[0]} has {amount(len(wanted[-1]), 'order')}."
        said.append(done)
        return Allocated(allocation, standing, trained, table, spent, why, said, record)

    def _allocation(
        self, followed: Policy | Untrained, table: Prices, shares: np.ndarray, cash: float,
        whole_shares: bool, spent: float,
    ) -> Allocation:  # fmt: skip
        """The allocation under the terms of the backtest."""
        return Allocation.of(
            followed, table, shares, cash, whole_shares=whole_shares, spent=spent,
            debts=self.debts, lag=self.run.config.lag,
        )  # fmt: skip

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
        known, config = self.run.prices, self.run.config
        trading = followed.task.written.trading
        earlier = [each for each in self.ledger.current() if each.moment < table.dates[-1]]
        said = [
            *notes.ended(table, self._ended(table)),
            *notes.too_short(followed, table, known),
            *notes.not_traded(allocation, earlier),
        ]
        # The first allocation is due at any row, as in the backtest, and strategies of the user's
        # own have their own dates.
        free = not earlier or isinstance(followed, Ordered)
        due = free or followed.task.terms.calls(allocation.held)
        idle = notes.nothing_ordered(allocation, config.calendar)
        said += idle or ([] if due else notes.not_due(config.calendar, table, known))
        if allocation.trades.any():
            fills = [self.fill(record.agent) for record in earlier]
            said += notes.waiting(table, config.lag)
            said += notes.pending(table, config.lag, earlier, fills)
        said += notes.filled_over(trading.fill)
        said += notes.dear(allocation)
        said += notes.other_capital(allocation.wealth, followed.task.costs)
        return said + notes.budget(trading.turnover_a_year, spent, allocation)

    def record(
        self,
        name: str,
        allocation: Allocation,
        prices: Prices,
        whole_shares: bool,
        stored: str | None = None,
        updated: Policy | None = None,
        then: Callable[[], object] = lambda: None,
    ) -> tuple[Record, str]:
        """Appends an allocation by a policy of an agent, or by another strategy.

        stored: name of the policy. updated: what it has become, the agent's newest from now on.
        then: called once there is a record, which goes again if this fails.

        Returns the record, and a sentence that says what was done.

        Raises QfolioError if another process updates the policy or allocates at the same time.
        """
        held = holdings_digest(allocation.assets, allocation.shares, allocation.cash)
        with self.ledger.locked():
            if updated is not None:
                if self.run.newest(name) != stored:
                    raise QfolioError(
                        f"Another process has updated {name} meanwhile; allocate again."
                    )
                stored = self.run.keep(name, updated)
            digests = {"prices": prices.sha256, "holdings": held, **self._digests(name, stored)}
            return self.ledger.append(
                allocation,
                prices,
                keep_prices=prices.sha256 != self.run.prices.sha256,
                then=then,
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
        remade = self._allocation(followed, table, shares, cash, record.whole_shares, spent)
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


def _require_weights_alone(followed: Policy | Untrained, in_shares: bool) -> None:
    """Raises QfolioError if shares are asked for, or lots, of which returns give no prices."""
    if in_shares:
        raise QfolioError(
            "Returns give no share prices; leave out --holdings, --whole-shares and --orders, or "
            "give a table of prices (--prices, without --returns)."
        )
    if lots(followed.mandate) is not None:
        raise QfolioError(
            "The mandate has lots, but returns give no share prices; give a table of prices "
            "(--prices, without --returns)."
        )
