"""Strategies that learn nothing, and give tomorrow's weights as a learned policy does.

These are the baselines of a backtest and the strategies of the user's own.
"""

import abc
import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.baselines.base import Baseline, History
from qfolio.portfolio.backtest.folds import latest
from qfolio.portfolio.backtest.orders import TOLERANCE, ask, holdable, obeying
from qfolio.portfolio.backtest.own import Own, rows_at
from qfolio.portfolio.costs import CostModel, cashed
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.feasible import TURNOVER_OF_YEAR
from qfolio.portfolio.mandate.limits import feasible, largest_weight
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.frequency import require_alike
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.task import Portfolio


class Untrained(abc.ABC):
    """A strategy of a backtest that learns nothing, under the terms of any agent's task."""

    def __init__(self, name: str, assets: tuple[str, ...], task: Portfolio, cap: float) -> None:
        self.name, self.assets, self.cap = name, assets, cap
        self.task = dataclasses.replace(
            task, signals="", anchor="", menu="", active=False, tracking_aversion=0.0
        )

    @property
    def costs(self) -> CostModel:
        return self.task.costs

    @property
    def mandate(self) -> str:
        return self.task.mandate

    def table(self, prices: Any, **options: Any) -> Prices:
        """The prices with the assets of the backtest, in its order."""
        table = load(prices, **options).exactly(self.assets, "the backtest")
        require_alike(table.dates, float(self.task.year), "the backtest has")
        return table

    @abc.abstractmethod
    def weights(self, prices: Any, holdings: Any = None, *, spent: float = 0.0) -> dict[str, float]:
        """Target weights by asset after the last row, with "cash" first.

        spent: turnover since the calendar year began, for a mandate that limits it. Raises
        QfolioError if the table's assets are not the backtest's, or there is nothing to order.
        """

    def notes(self, prices: Any, held: Floats | None = None, *, spent: float = 0.0) -> list[str]:
        """Sentences on the order after the last row.

        held: the weights now, cash first. spent: as for ``weights``.
        """
        return []


class Rule(Untrained):
    """A baseline's orders after the last row of a table; of its calendar, only a band applies.

    The baseline learns from the training window that ends there: all rows, or the last ``train``.
    """

    def __init__(
        self,
        name: str,
        baseline: Baseline,
        assets: tuple[str, ...],
        task: Portfolio,
        *,
        train: str,
        expanding: bool,
        cap: float,
    ) -> None:
        super().__init__(name, assets, task, cap)
        self.baseline, self.train, self.expanding = baseline, train, expanding

    def weights(self, prices: Any, holdings: Any = None, *, spent: float = 0.0) -> dict[str, float]:
        """The baseline's target; without one, the holdings, which a margin call reduces."""
        table = self.table(prices)
        held = np.array([(holdings or {"cash": 1.0}).get(n, 0.0) for n in ("cash", *self.assets)])
        fold = latest("latest", table.dates, self.train, self.expanding).complete(table.known)
        there = tradable = fold.tradable(table.values)
        if table.tradable is not None:
            priced = ~np.isnan(table.values[fold.train]).any(0)
            there = table.tradable[-1]
            tradable = there & (priced | (not self.baseline.estimates))
        if table.listed is not None:
            held = cashed(held, table.listed[-1])
        if not tradable.any():
            raise QfolioError(
                f"No asset has prices in all of the last {self.train}; give earlier prices."
            )
        mandated, cap, terms = None, self.cap, self.task.terms
        if self.mandate:
            mandated, _ = checks.relaxed(feasible(self.mandate, there, cap))
            cap = min(cap, largest_weight(self.mandate))
            if mandated.limits_risk:
                last = jnp.array(len(table) - 1)
                mandated = mandated.knowing(self.task.on(table).risk_at(last))
            mandated = mandated.spending(terms.unspent(terms.begin(held, spent)))
        open_to = holdable(tradable, mandated)
        history = History(table.dates, table.values, fold.train, open_to, cap, table.month)
        wanted = ask(self.name, self.baseline, history, held, mandated)
        if wanted is None and terms.calls(held):
            wanted = held  # as in the backtest
        target = held
        if wanted is not None:
            target = obeying(wanted, held, mandated)
            target = target if terms.beyond(held, target) else held
        return dict(zip(("cash", *self.assets), target.tolist(), strict=True))


class Ordered(Untrained):
    """A strategy of the user's own: its latest order up to the last row of a table.

    As in the backtest, its orders are carried out even if they break the mandate or the cap, and
    each is filled at once.
    """

    def __init__(
        self, name: str, own: Own, assets: tuple[str, ...], task: Portfolio, cap: float
    ) -> None:
        """Raises QfolioError if the strategy has returns or levels only."""
        if own.kind != "weights":
            raise QfolioError(
                f"The backtest knows only the {own.kind} of {name}, not its weights, so that it "
                "cannot be followed; follow another strategy, or run a backtest with its weights."
            )
        super().__init__(name, assets, task.filled_at_once(), cap)
        self.own = own

    def weights(self, prices: Any, holdings: Any = None, *, spent: float = 0.0) -> dict[str, float]:
        """The weights of the latest order; those of delisted assets are in cash."""
        table = self.table(prices)
        target = self._target(table)
        unpriced = (target[1:] != 0) & np.isnan(table.values[-1])
        if unpriced.any():
            raise QfolioError(
                f"{self.name} orders {self.assets[int(unpriced.argmax())]}, which has no price on "
                f"{day(table.dates[-1])}; give prices of it."
            )
        return dict(zip(("cash", *self.assets), target.tolist(), strict=True))

    def notes(self, prices: Any, held: Floats | None = None, *, spent: float = 0.0) -> list[str]:
        """Says of which date the order is, and where it breaks the mandate, but for risk.

        An asset, which is bought once, needs no date. Without the weights held, turnover and the
        smallest trade are not checked.
        """
        table = self.table(prices)
        if self.name in self.assets:
            said = [f"{self.name} is bought with all the money, and held."]
        else:
            dates, latest = self.own.dates, self._latest(table)
            said = [
                f"These are the weights of {self.name} of {day(dates[latest])}, its latest up to "
                f"{day(table.dates[-1])} in the backtest's copy, which ends on {day(dates[-1])}."
            ]
        if self.mandate:
            there = ~np.isnan(table.values[-1])
            mandated, _ = checks.relaxed(feasible(self.mandate, there, self.cap))
            target = self._target(table)
            found = mandated.violations(target, held)
            if held is not None:
                left = self.task.terms.unspent(self.task.terms.begin(held, spent))
                if left is not None:
                    change = abs(target - held)[1:].sum()
                    found[TURNOVER_OF_YEAR] = change - left
            broken = [f"{what} {by:.2g}" for what, by in found.items() if by > TOLERANCE]
            if broken:
                said.append(
                    f"The weights break the mandate ({', '.join(broken)}), and are carried out all "
                    "the same, as in the backtest."
                )
        return said

    def _target(self, table: Prices) -> Floats:
        """The weights of the latest order, cash first."""
        target = self.own.values[self._latest(table)]
        return target if table.listed is None else cashed(target, table.listed[-1])

    def _latest(self, table: Prices) -> int:
        """Number of the latest order; one on a day without a row counts at the next row."""
        rows, _ = rows_at(self.name, self.own.dates, table)
        known = int((rows < len(table)).sum())
        if not known:
            raise QfolioError(
                f"{self.name} has no order up to {day(table.dates[-1])}; its first is of "
                f"{day(self.own.dates[0])}."
            )
        return known - 1
