"""Reports columns that seem to hold no prices but a rate, a yield or a volatility index."""

import numpy as np

from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.findings import LISTED, Findings
from qfolio.portfolio.prices.gaps import Rest
from qfolio.portfolio.prices.grid import Grid
from qfolio.portfolio.prices.stale import changes
from qfolio.portfolio.prices.vocabulary import is_rate, plain

FEWEST = 100  # rows on which numbers must be known to tell how often they change
RARELY = 0.0125  # of these rows: less often than funds that are valued once a quarter
OFTEN = 0.5  # of them, on which the usual asset of the table changes


def check_rates(grid: Grid, rest: Rest, findings: Findings) -> set[int]:
    """Report assets whose names say that they are rates, or whose numbers almost never change.

    Returns their places in the rest.
    """
    if len(rest.assets) < 2:
        return set()
    rows = (~np.isnan(rest.values)).sum(axis=0)
    counts = changes(rest.values).sum(axis=0)
    shares = counts / np.maximum(rows - 1, 1)
    rare = (counts > 0) & (rows >= FEWEST) & (shares < RARELY) & (np.median(shares) >= OFTEN)
    said: dict[str, str] = {}
    found: set[int] = set()
    for j, asset in enumerate(rest.assets.tolist()):
        name = grid.assets[asset]
        # RF is a ticker, too, of a share that is dearer than a rate.
        if is_rate(name) or (plain(name) == "rf" and np.nanmedian(rest.values[:, j]) < 1):
            said[name] = "has the name of a rate or an index, which cannot be bought"
        elif rare[j]:
            often = f"{counts[j]:,} of {amount(int(rows[j]), 'row')}"
            said[name] = f"changes on only {often}: perhaps it is a rate, not a price"
        else:
            continue
        found.add(j)
    for name, what in list(said.items())[:LISTED]:
        out = f"choose columns=[{quote(name)}] (--columns {quote(name)})"
        if grid.long:
            out = "leave out its rows"
        findings.warn(f"{quote(name)} {what}", advice=f"If so, {out}; otherwise it is traded.")
    findings.others("warning", len(said), "asset", " that may be rates")
    return found
