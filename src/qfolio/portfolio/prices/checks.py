"""Runs all checks of a price table, in order."""

from typing import Any

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.columns import find_columns
from qfolio.portfolio.prices.findings import Finding, Findings
from qfolio.portfolio.prices.gaps import complete
from qfolio.portfolio.prices.grid import arrange
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.moves import check_moves
from qfolio.portfolio.prices.plausibility import FEWEST_ROWS, check_cells, check_size

MISSING = ("error", "drop-asset", "forward-fill")
LATE = ("error", "drop-asset", "trim", "join")


def examine(
    table: Table, missing: str, late: str, features: tuple[str, ...], date: str | None
) -> tuple[dict[str, Any], list[Finding]]:
    """The arguments of ``Prices`` (none if the table has errors), and all findings.

    Raises:
        QfolioError: ``missing`` or ``late`` is not one of the choices.
    """
    for name, value, known in (("missing", missing, MISSING), ("late", late, LATE)):
        if value not in known:
            raise QfolioError(f"{name} is {quote(value)}; it must be one of {', '.join(known)}.")
    findings = Findings()
    columns = find_columns(table, features, date, findings)
    grid = None if columns is None else arrange(table, columns, findings)
    if grid is None:
        return {}, findings
    ordered = not findings.bad
    check_cells(grid, findings)
    if not ordered or not grid.assets or len(grid.dates) < FEWEST_ROWS:
        return {}, findings
    rest = complete(grid, missing, late, findings)
    if not len(rest.assets):
        return {}, findings
    check_moves(grid, rest, findings)
    check_size(grid, rest, findings)
    if findings.bad:
        return {}, findings
    content = {
        "dates": grid.dates[rest.head :],
        "assets": tuple(grid.assets[j] for j in rest.assets),
        "values": rest.values,
        "features": rest.features,
        "feature_names": features,
    }
    return content, findings
