"""Live performance of a run's ledger beside what its backtest promised."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.files import write_csv
from qfolio.core.text import amount, figure
from qfolio.portfolio.backtest.folder import BacktestFolder, followed
from qfolio.portfolio.backtest.folds import overdue, spell_all
from qfolio.portfolio.backtest.statistics.measures import drawdown, log_growth, measures
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import CostModel
from qfolio.portfolio.desk import consistency
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.ledger import Record
from qfolio.portfolio.desk.live import Live, mark
from qfolio.portfolio.desk.reference import reference
from qfolio.portfolio.prices.findings import day, first_of
from qfolio.portfolio.prices.table import Prices

COLUMNS = (
    "date", "return", "wealth", "cash", "cost", "flow", "growth", "benchmark", "band_low",
    "band_middle", "band_high", "evidence",
)  # fmt: skip
"""Columns of follow.csv; docs/reference/files.md explains them."""

URGENT = ("ALARM", "MARGIN CALL", "WIPED OUT")
"""How sentences begin that should not be overlooked."""

SEED = 0
"""Seed of the bootstrap: the same ledger gives the same evidence whenever one looks."""


@dataclass(frozen=True)
class Following:
    """A ledger marked to market; arrays have an entry for each live row.

    agent: that of the last allocation. tested: its net returns in the backtest, shape (T,).
    cash, tested_cash: what cash earned, live and in the backtest, of the same shapes.
    benchmark: name of the backtest's benchmark. reference: its live net returns. note: a remark on
    these, or "". band: growth of wealth that the backtest leads one to expect, shape (3, rows).
    evidence: evidence against the backtest. learned: date of the last row that the policy learned
    from; None without one. overdue: whether the newest policy learned a test length ago or more.
    test: the test length. called: gross exposure, relative to the wealth, above which the margin
    calls. newer: as ``learned``, of a newer policy that no allocation has used yet; None without
    one.
    """

    agent: str
    records: list[Record]
    live: Live
    tested: np.ndarray
    cash: np.ndarray
    tested_cash: np.ndarray
    benchmark: str
    reference: np.ndarray
    note: str
    band: np.ndarray
    evidence: np.ndarray
    periods_per_year: float
    learned: np.datetime64 | None
    overdue: bool
    test: str
    called: float = np.inf
    newer: np.datetime64 | None = None

    @cached_property
    def growth(self) -> np.ndarray:
        """Wealth, as a multiple of that before the first trade."""
        return np.asarray(np.cumprod(1 + self.live.returns))

    @property
    def alarm(self) -> np.datetime64 | None:
        """The date of the first alarm, which refutes the backtest; None without one."""
        over = np.flatnonzero(self.evidence >= consistency.ALARM)
        return self.live.dates[over[0]] if over.size else None

    def sentences(self) -> list[str]:
        """What the ledger shows, in sentences."""
        live, count = self.live, len(self.records)
        agents = ", ".join(dict.fromkeys(record.agent for record in self.records))
        since = f"{amount(count, 'allocation')} of {agents} since {self.records[0].date}"
        if not len(live.returns):
            return [f"{since}: no trade has earned a return yet.", self._retrain()]
        low, middle, high = (figure(x - 1, "+.1%") for x in self.band[:, -1])
        earned, other = self.growth[-1], np.prod(1 + self.reference)
        place = " Live is below the band." if earned < self.band[0, -1] else ""
        place = " Live is above the band." if earned > self.band[2, -1] else place
        said = [
            f"{since}, {amount(len(live.returns), 'row')} up to {day(live.dates[-1])}: "
            f"{figure(earned - 1, '+.1%')} after costs, and {self.benchmark} "
            f"{figure(other - 1, '+.1%')}.",
            f"Of histories like the backtest's, 95% end between {low} and {high}, and half end "
            f"above {middle}.{place}",
        ]
        level = f"evidence against it {self.evidence[-1]:.2g}, alarm at {consistency.ALARM:.0f}"
        if live.ruin is not None:
            said.append(
                f"WIPED OUT on {day(live.ruin)}: the account's debts exceeded what it owned."
            )
        elif self.alarm is None and place:
            said.append(f"There is no alarm yet: the backtest is not refuted ({level}).")
        elif self.alarm is None:
            said.append(f"Live returns are consistent with the backtest ({level}).")
        if self.alarm is not None:
            said.append(
                f"ALARM since {day(self.alarm)}: live returns are worse than the backtest's "
                f"({level})."
            )
        gross = live.gross[-1]
        if gross > self.called and live.ruin is None:
            said.append(
                f"MARGIN CALL on {day(live.dates[-1])}: gross exposure is {gross:.3g} times the "
                f"wealth, and the mandate's margin allows {self.called:.3g}; allocate again."
            )
        said += [self._retrain(), *([self.note] if self.note else [])]
        if live.differences:
            last = live.differences[-1]
            total = figure(sum(found.total for found in live.differences), "+,.2f")
            most = figure(last.money, "+,.2f")
            said.append(
                f"Holdings differed from those expected {amount(len(live.differences), 'time')}, "
                f"by {total} in all (deposits, other fills); this is not counted as a return. The "
                f"last time, on {last.date}, {last.where} differed most, by {most}."
            )
        if unfilled := [found.unfilled for found in live.differences if found.unfilled]:
            said.append(
                f"The orders of {first_of(unfilled)} were not filled, since the next holdings are "
                "those before them; live returns count them as if they had been."
            )
        if live.short:
            said.append(
                f"Cash became negative after {amount(live.short, 'trade')}: prices moved before "
                "they were filled, or costs were higher than expected."
            )
        return said

    def _retrain(self) -> str:
        if self.learned is None:
            return f"{self.agent} learns nothing, so there is nothing to train."
        until = f"The policy has learned from prices up to {day(self.learned)}"
        if self.newer is not None:
            until = (
                f"{until}, and a newer one, which the next allocation will use, up to "
                f"{day(self.newer)}"
            )
        if why := self._reasons():
            return f"{until}; a retrain is due because of {' and '.join(why)}."
        return f"{until}; no retrain is due before it is {self.test} old."

    def _reasons(self) -> list[str]:
        """Why a retrain is due; an alarm is answered by a policy that has learned from its row."""
        answered = self.alarm is None or (self.newer is not None and self.newer >= self.alarm)
        why = [] if answered else ["the alarm"]
        return why + [f"its age of {self.test} or more, the backtest's test length"] * self.overdue

    def rows(self) -> dict[str, dict[str, float]]:
        """Growth in all and per year, volatility, Sharpe ratio and maximum drawdown, by name.

        What cannot be said of so few rows is NaN.
        """
        year = self.periods_per_year
        return {
            "live": _measures(self.live.returns, self.cash, year),
            f"{self.benchmark}, live": _measures(self.reference, self.cash, year),
            f"{self.agent}, backtest": _measures(self.tested, self.tested_cash, year),
        }

    def write(self, path: Path) -> None:
        """Writes a CSV file with a row for each live row."""
        live = self.live
        columns = (
            live.returns, live.wealth, live.cash, live.costs, live.flows, self.growth,
            np.cumprod(1 + self.reference), *self.band, self.evidence,
        )  # fmt: skip
        days = spell_all(live.dates, live.dates) if len(live.dates) else []
        write_csv(path, COLUMNS, zip(days, *(x.tolist() for x in columns), strict=True))

    def to_json(self) -> dict[str, Any]:
        return {
            "agent": self.agent,
            "allocations": len(self.records),
            "rows": len(self.live.returns),
            "benchmark": self.benchmark,
            "benchmark_growth": float(np.prod(1 + self.reference)) if len(self.growth) else None,
            "growth": float(self.growth[-1]) if len(self.growth) else None,
            "band": self.band[:, -1].tolist() if len(self.growth) else None,
            "evidence": float(self.evidence[-1]) if len(self.growth) else None,
            "alarm_at": consistency.ALARM,
            "alarm_since": None if self.alarm is None else day(self.alarm),
            "retrain_due": bool(self._reasons()),
            "newer_policy_learned": None if self.newer is None else day(self.newer),
            "flows": float(self.live.flows.sum()),
            "costs": float(self.live.costs.sum()),
            "sentences": self.sentences(),
        }


def follow(desk: Desk, prices: Path | None = None, benchmark: Path | None = None) -> Following:
    """Marks a run's ledger to market and compares it with the backtest.

    Args:
        desk: The run.
        prices: A table with the rows since the first allocation (default: the backtest's).
        benchmark: Latest table of the benchmark, if that is a strategy of the user's own (default:
            the table that the backtest kept).

    Raises:
        QfolioError: The ledger is empty, prices or the benchmark do not fit it, or the backtest is
            not finished.
    """
    records, run = desk.ledger.current(), desk.run
    if not records:
        raise QfolioError(
            f"The ledger of {desk.folder} is empty; record an allocation with qfolio allocate."
        )
    agent, lag = records[-1].agent, run.config.lag
    known = desk.followed(agent, records[-1].policy)
    table = desk.read(prices)
    fills = [desk.fill(record.agent) for record in records]
    live = mark(records, table, known.costs, lag, fills, known.task.terms.band)
    other, count = run.config.benchmark, len(live.returns)
    tested, before = (_tested(desk, name, records[0]) for name in (agent, other))
    theirs, note = reference(desk, table, live.first - lag, count, benchmark)
    rng = np.random.default_rng(SEED)
    band, evidence = np.ones((3, count)), np.ones(count)
    if count:
        band = consistency.band(tested, count, rng)
        pairs = [(tested, live.returns)]
        if agent != other:
            pairs.append((tested - before, live.returns - theirs))
        evidence = consistency.together(
            [
                consistency.evidence(consistency.Promise.of(promised, rng, len(pairs)), now)
                for promised, now in pairs
            ]
        )
    learned, newer = getattr(known, "learned", None), None
    if learned is not None and run.newest(agent) != records[-1].policy:
        newer = run.policy(agent).learned
    latest = learned if newer is None else newer
    return Following(
        agent=agent,
        records=records,
        live=live,
        tested=tested,
        cash=_earned_by_cash(table, known.costs, live.first, count),
        tested_cash=run.replay.growth[: len(tested), 0] - 1,
        benchmark=other,
        reference=theirs,
        note=note,
        band=band,
        evidence=evidence,
        periods_per_year=table.periods_per_year,
        learned=learned,
        overdue=latest is not None and overdue(latest, run.config.test, table.dates),
        test=run.config.test,
        called=known.task.terms.called,
        newer=newer,
    )


def _tested(desk: Desk, name: str, first: Record) -> np.ndarray:
    """The net returns of a strategy in the backtest, all seeds of an agent together.

    Rows that were added to the table since the first allocation are live, and are left out.
    """
    files, dates = BacktestFolder(desk.folder), desk.run.prices.dates
    last = dates[files.read_config().prices["rows"] - 1]
    count = int((desk.run.dates <= max(last, first.moment)).sum())
    _, columns = files.read_returns()
    column = followed(name, columns)
    if column not in columns:
        column = f"{name}/{desk.run.config.seed}"
    if column not in columns:
        raise QfolioError(f"returns.csv has no {name}; write it again with {desk.resume}.")
    return columns[column][:count]


def _earned_by_cash(table: Prices, costs: CostModel, first: int, count: int) -> np.ndarray:
    """What cash earned over some rows of a table; the first return begins at row ``first``."""
    rows, known = np.arange(first, first + count), Conditions.of(table, costs)
    still = np.ones((count, len(table.assets)))
    return np.asarray(costs.carry(still, known.holding(rows, rows + 1))[:, 0] - 1)


def _measures(returns: np.ndarray, cash: np.ndarray, year: float) -> dict[str, float]:
    """The measures that some returns allow; the annual ones are NaN below a quarter of a year."""
    found = dict.fromkeys(("growth", "a year", "volatility", "sharpe", "drawdown"), np.nan)
    if len(returns):
        found["growth"] = float(np.expm1(log_growth(returns).sum()))
        found["drawdown"] = float(drawdown(returns).max())
    if len(returns) >= max(2, year / 4):
        none = np.zeros(len(returns))
        annual = measures(returns, none, none, year, cash)
        found["a year"] = float(annual["growth"])
        found |= {name: float(annual[name]) for name in ("volatility", "sharpe")}
    return found
