"""A baseline of a backtest, which gives tomorrow's weights as a learned policy does."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.baselines.base import Baseline, History
from qfolio.portfolio.backtest.folds import latest
from qfolio.portfolio.backtest.orders import obeying
from qfolio.portfolio.costs import CostModel, cashed
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.mandate import feasible, largest_weight
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.task import Portfolio


class Rule:
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
        self.name, self.baseline, self.assets = name, baseline, assets
        self.train, self.expanding, self.cap = train, expanding, cap
        self.task = dataclasses.replace(task, signals="", anchor="", menu="")

    @property
    def costs(self) -> CostModel:
        return self.task.costs

    @property
    def mandate(self) -> str:
        return self.task.mandate

    def table(self, prices: Any, **options: Any) -> Prices:
        """The prices with the assets of the backtest, in its order."""
        table = load(prices, **options)
        if set(table.assets) != set(self.assets):
            off = sorted(set(table.assets) ^ set(self.assets))
            raise QfolioError(
                f"The price table must have the {len(self.assets)} assets of the backtest, and no "
                f"others; {off[0]!r} is in only one of the two."
            )
        return table.select(self.assets)

    def weights(self, prices: Any, holdings: Any = None, *, spent: float = 0.0) -> dict[str, float]:
        """Target weights by asset, with "cash" first; the holdings if the baseline gives no order.

        spent: turnover since the calendar year began, for a mandate that limits it. Raises
        QfolioError if the table's assets are not the backtest's, or none can be traded.
        """
        table = self.table(prices)
        held = np.array([(holdings or {"cash": 1.0}).get(n, 0.0) for n in ("cash", *self.assets)])
        fold = latest("latest", table.dates, self.train, self.expanding).complete(table.values)
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
            left = terms.unspent(terms.begin(held, spent))
            mandated = mandated if left is None else mandated.spending(left)
        history = History(table.dates, table.values, fold.train, tradable, cap, table.month)
        wanted = self.baseline.decide(history, held)
        target = held
        if wanted is not None:
            target = obeying(self.name, wanted, held, history, mandated)
            target = target if terms.beyond(held, target) else held
        return dict(zip(("cash", *self.assets), target.tolist(), strict=True))
