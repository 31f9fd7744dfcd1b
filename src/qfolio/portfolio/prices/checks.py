"""Runs all checks of a price table, in order."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError, require_type
from qfolio.core.text import near, quote
from qfolio.portfolio.prices.columns import find_columns
from qfolio.portfolio.prices.duplicates import check_duplicates
from qfolio.portfolio.prices.findings import Findings
from qfolio.portfolio.prices.gaps import cash_outs, complete
from qfolio.portfolio.prices.grid import Grid, arrange
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.moves import check_moves
from qfolio.portfolio.prices.plausibility import FEWEST_ROWS, check_cells, check_size
from qfolio.portfolio.prices.rates import check_rates
from qfolio.portfolio.prices.returns import UNITS, cumulate
from qfolio.portfolio.prices.stale import check_stale
from qfolio.portfolio.prices.unnamed_bars import check_unnamed_bars

MISSING = ("error", "drop-asset", "forward-fill")
LATE = ("error", "drop-asset", "trim", "join")
ENDED = ("gap", "cash-out")

SEPARATOR = "="
"""Between the name of a column and the file that it is in."""


@dataclass(frozen=True)
class Choices:
    """How a table is read; see ``table.load``."""

    missing: str = "error"
    late: str = "error"
    ended: str = "gap"
    delisting_haircut: float = 0.0
    members: Any = None
    features: Sequence[str] = ()
    columns: Sequence[str] = ()
    returns: str | None = None
    date: str | None = None

    def __post_init__(self) -> None:
        known = {"missing": MISSING, "late": LATE, "ended": ENDED, "returns": (None, *UNITS)}
        for name, choices in known.items():
            if (value := getattr(self, name)) not in choices:
                advice = near(str(value), filter(None, choices))
                raise QfolioError(f"{name} is {quote(value)}; {advice}")
        haircut = self.delisting_haircut
        require_type("delisting_haircut", haircut, Real, "a number")
        if not 0 <= haircut <= 1:
            raise QfolioError(f"delisting_haircut is {haircut}; it must be from 0 to 1.")
        if haircut and self.ended != "cash-out":
            raise QfolioError(
                f"delisting_haircut is {haircut}, but no asset is cashed out; set ended=cash-out "
                "(--ended cash-out), or leave the haircut out."
            )
        for name in ("features", "columns"):
            given = getattr(self, name)
            names = (given,) if isinstance(given, str) else tuple(given)
            object.__setattr__(self, name, names)

    @property
    def own_columns(self) -> tuple[str, ...]:
        """Those of ``columns`` that are in the table itself."""
        return tuple(name for name in self.columns if SEPARATOR not in name)

    @property
    def series(self) -> dict[str, str]:
        """The files of those of ``columns`` that have one, by name."""
        return dict(text.split(SEPARATOR, 1) for text in self.columns if SEPARATOR in text)


def cells(table: Table, choices: Choices) -> tuple[Grid | None, Findings]:
    """The cells by date and asset before gaps are treated (None if rows or columns have errors)."""
    findings = Findings()
    features, shared = tuple(choices.features), choices.own_columns
    returns = choices.returns is not None
    columns = find_columns(table, features, shared, choices.date, findings, returns=returns)
    grid = (
        None
        if columns is None
        else arrange(table, columns, findings, percent=choices.returns == "percent")
    )
    if grid is None:
        return None, findings
    ordered = not findings.bad
    if choices.returns:
        grid = cumulate(grid, choices.returns, findings)
    if grid is None:
        return None, findings
    check_cells(grid, findings)
    if not ordered or not grid.assets or len(grid.dates) < FEWEST_ROWS:
        return None, findings
    return grid, findings


def examine(table: Table, choices: Choices) -> tuple[dict[str, Any], Findings]:
    """The arguments of ``Prices`` (none if the table has errors), and all findings."""
    grid, findings = cells(table, choices)
    if grid is None:
        return {}, findings
    delists = choices.ended == "cash-out"
    rest = complete(grid, choices.missing, choices.late, findings, delists=delists)
    if not len(rest.assets):
        return {}, findings
    check_unnamed_bars(grid, rest, findings)
    check_moves(grid, rest, findings)
    check_stale(grid, rest, findings, check_rates(grid, rest, findings))
    check_duplicates(grid, rest, findings)
    check_size(grid, rest, findings)
    if findings.bad:
        return {}, findings
    features, shared = tuple(choices.features), choices.own_columns
    dates = grid.dates[rest.head :]
    market = np.array(rest.features[:, 0, len(features) :])
    seen = np.array(rest.features[..., : len(features)])
    content = {
        "dates": dates,
        "assets": tuple(grid.assets[j] for j in rest.assets),
        "values": rest.values,
        "features": seen,
        "feature_names": features,
        "market": market,
        "market_names": shared,
    }
    if delists:
        content |= cash_outs(rest.values, seen, choices.delisting_haircut)
    return content, findings
