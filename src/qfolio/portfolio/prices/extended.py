"""Checks that a price table is an earlier one with more rows at its end."""

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices

REMEDY = "start a new backtest, or restore the earlier rows."


def require_grown(before: Prices, after: Prices) -> None:
    """Raises QfolioError unless a table begins with all rows of an earlier one.

    Prices that a provider adjusts again after each dividend do not: all of their rows change.
    """
    for kind, old, new in (
        ("asset", before.assets, after.assets),
        ("feature", before.feature_names, after.feature_names),
        ("column", before.market_names, after.market_names),
    ):
        for name in old:
            if name not in new:
                raise QfolioError(
                    f"The new table has no {kind} {quote(name)}; add it, or start a new backtest."
                )
        for name in new:
            if name not in old:
                raise QfolioError(
                    f"The new table has the {kind} {quote(name)}, which the backtest's lacks; "
                    "leave it out, or start a new backtest."
                )
        if old != new:
            raise QfolioError(
                f"The new table has its {kind}s in another order; restore that order."
            )
    # A first delisting may be new, but not where assets started late: it lets them be held earlier.
    ends = before.listed is None and not np.isnan(before.values).any()
    if before.masks.keys() != after.masks.keys() - ({"listed"} if ends else set()):
        raise QfolioError(
            "Assets come and go in one of the tables, the backtest's or the new one, and not in "
            "the other; give the same options as before, or start a new backtest."
        )
    if len(after) < len(before):
        raise QfolioError(
            f"The new table has {len(after):,} rows up to {day(after.dates[-1])}, fewer than the "
            f"backtest's {len(before):,} up to {day(before.dates[-1])}; give all of them."
        )
    _require_same(before, after.between(0, len(before)))


def _require_same(before: Prices, after: Prices) -> None:
    """Raises QfolioError, naming the first row and column that differ, unless none does."""
    for old_day, new_day in zip(before.dates, after.dates, strict=True):
        if old_day != new_day:
            raise QfolioError(
                f"The new table has a row of {day(new_day)} where the backtest's has one of "
                f"{day(old_day)}; {REMEDY}"
            )
    names = before.assets
    blocks = [(list(names), before.values, after.values)]
    for i, name in enumerate(before.feature_names):
        label = [f"{name} of {asset}" for asset in names]
        blocks.append((label, before.features[..., i], after.features[..., i]))
    blocks.append((list(before.market_names), before.market, after.market))
    for what in before.masks | after.masks:  # a table that lists all needs no mask
        old, new = (table.masks.get(what, ~np.isnan(table.values)) for table in (before, after))
        blocks.append(([f"{what} of {name}" for name in names], old, new))
    columns = [name for label, *_ in blocks for name in label]
    old = np.concatenate([block.astype(float) for _, block, _ in blocks], axis=1)
    new = np.concatenate([block.astype(float) for *_, block in blocks], axis=1)
    different = np.argwhere((old != new) & ~(np.isnan(old) & np.isnan(new)))
    if len(different):
        row, column = different[0]
        raise QfolioError(
            f"The new table has {_number(new[row, column])} for {quote(columns[column])} on "
            f"{day(before.dates[row])} where the backtest's has {_number(old[row, column])}; "
            f"{REMEDY}"
        )


def _number(value: float) -> str:
    return "nothing" if np.isnan(value) else repr(float(value))
