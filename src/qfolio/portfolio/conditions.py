"""What cost models read at each row besides prices: dates and columns of the table."""

from typing import Any, NamedTuple

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.portfolio.costs import Context, CostModel, Limits
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices

YEAR = np.timedelta64(365, "D") / np.timedelta64(1, "s")
"""Seconds in a year of interest (actual/365)."""

MEMORY = 21
"""Number of log returns that a volatility is estimated from."""

FEWEST = 5
"""Fewest of them that say more about an asset's volatility than those of the other assets."""


class Conditions(NamedTuple):
    """Dates and columns of a table, in numpy or jax arrays; empty if a cost model reads none.

    years: time of each row since the first, shape (row,). values: each column at each row, of shape
    (row, asset), or (row, 1) if all assets share it, by name. sums: their integrals over the years
    since the first row, of the same shapes; between two rows, a column keeps the value of the
    earlier one. listed: 1 where an asset has a price, of shape (row, asset); None if none is ever
    delisted.
    """

    years: Any
    values: dict[str, Any]
    sums: dict[str, Any]
    listed: Any = None

    @staticmethod
    def of(prices: Prices, costs: CostModel | None = None) -> "Conditions":
        """The columns that a cost model asks for (default: none).

        Raises QfolioError if the table lacks one, or a value is outside the model's limits.
        """
        columns = costs.columns if costs else ()
        values = {name: _column(name, prices) for name in columns if name != "years"}
        for name, limits in (costs.limits if costs else {}).items():
            _require(name, values[name], prices, limits)
        listed = None if prices.listed is None else prices.listed.astype(float)
        if not columns:
            return Conditions(np.empty(0), {}, {}, listed)
        years = (prices.dates - prices.dates[0]) / np.timedelta64(1, "s") / YEAR
        sums = {name: _sums(x, years) for name, x in values.items()}
        return Conditions(years, values, sums, listed)

    def part(self, start: int, stop: int) -> "Conditions":
        """The conditions of rows ``start`` to ``stop``, the last one excluded.

        Years and sums are not counted anew: only their differences are ever used.
        """
        values, sums = ({k: x[start:stop] for k, x in d.items()} for d in (self.values, self.sums))
        listed = None if self.listed is None else self.listed[start:stop]
        return Conditions(self.years[start:stop], values, sums, listed)

    def trade(self, row: Any, rows: Any, wealth: Any = 1.0) -> Context:
        """The circumstances of trades at some rows, ``rows`` after their decisions."""
        columns = {name: x[row] for name, x in self.values.items()}
        return Context(rows=rows, columns=columns, wealth=wealth)

    def holding(self, start: Any, end: Any) -> Context:
        """The holding periods from some rows to others."""
        listed = None if self.listed is None else self.listed[end]
        if not self.years.shape[0]:
            return Context(rows=end - start, listed=listed)
        columns = {name: x[end] - x[start] for name, x in self.sums.items()}
        years = self.years[end] - self.years[start]
        return Context(end - start, years, columns, listed=listed)


def _column(name: str, prices: Prices) -> Floats:
    """A column's values, of shape (row, asset) or (row, 1); 0 before an asset's first price."""
    if name == "price":
        if prices.levels:
            raise QfolioError(
                "Returns give no share prices, on which per_share and impact depend; leave these "
                "out of the cost model, or give a table of prices."
            )
        return np.nan_to_num(prices.values)
    if name in prices.feature_names:
        return np.nan_to_num(prices.features[..., prices.feature_names.index(name)])
    if name in prices.market_names:
        return prices.market[:, [prices.market_names.index(name)]]
    if name == "volatility":
        return _volatility(prices.known)
    known = ", ".join(prices.feature_names + prices.market_names) or "none"
    raise QfolioError(
        f"The cost model reads the column {name!r}, which the price table does not have (it has "
        f"{known}); load it as a feature or as a column, or give a number instead."
    )


def _require(name: str, values: Floats, prices: Prices, limits: Limits) -> None:
    """Raises QfolioError if a column is outside limits where there is a price."""
    wrong = ~((values >= limits.least) & (values <= limits.most)) & ~np.isnan(prices.values)
    if wrong.any():
        row, asset = np.argwhere(wrong)[0]
        shared = values.shape[1] == 1
        whose = "" if shared else f" for {prices.assets[asset]}"
        raise QfolioError(
            f"The column {name!r} is {values[row, 0 if shared else asset]:g} on "
            f"{day(prices.dates[row])}{whose}; the cost model needs numbers {limits.words}."
        )


def _sums(values: Floats, years: Floats) -> Floats:
    each = values[:-1] * np.diff(years)[:, None]
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(each, 0)])


def _volatility(values: Floats) -> Floats:
    """The volatility of the last ``MEMORY`` log returns at each row, or of as many as there are.

    Assets with fewer than ``FEWEST`` have the mean of those with as many or more, if there are any.
    """
    logs = np.full(values.shape, np.nan)
    logs[1:] = np.diff(np.log(values), axis=0)
    known, logs = np.isfinite(logs), np.nan_to_num(logs)
    before = np.maximum(np.arange(len(values)) - MEMORY, 0)
    counts, sums, squares = (
        total - total[before] for total in (np.cumsum(x, 0) for x in (known, logs, logs**2))
    )
    n = np.maximum(counts, 1)
    found = np.sqrt(np.maximum(squares / n - (sums / n) ** 2, 0))
    enough = counts >= FEWEST
    mean = (enough * found).sum(1, keepdims=True) / np.maximum(enough.sum(1, keepdims=True), 1)
    return np.where(enough | ~enough.any(1, keepdims=True), found, mean)
