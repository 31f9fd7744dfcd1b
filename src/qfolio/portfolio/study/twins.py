"""Finds tables of a study that hold the same prices, as a table and its rounded copy do.

The pooled evidence takes tables for independent ones, and would count their days twice.
"""

import itertools
from collections.abc import Mapping

import numpy as np

from qfolio.core.text import amount
from qfolio.portfolio.prices.table import Prices

SAME = 0.99  # correlation of returns from which on two tables hold the same prices
SHARED = 0.5  # of the shorter table's rows, from which on two tables cover the same time
FEWEST = 20  # returns that tell


def twins(tables: Mapping[str, Prices]) -> list[str]:
    """A sentence on each two tables of the same assets whose returns are nearly the same."""
    return [
        f"{one} and {other} hold nearly the same prices: their returns on "
        f"{amount(rows, 'common date')} have a correlation of {found:.4g}, so that the pooled "
        "evidence counts the same days twice; leave one of them out."
        for (one, first), (other, second) in itertools.combinations(tables.items(), 2)
        for found, rows in [_correlation(first, second)]
        if found >= SAME
    ]


def _correlation(one: Prices, other: Prices) -> tuple[float, int]:
    """The usual asset's correlation of returns between common dates, and the number of dates.

    It is 0 for tables that differ in their assets, or that have few dates in common.
    """
    if set(one.assets) != set(other.assets):
        return 0.0, 0
    _, mine, its = np.intersect1d(one.dates, other.dates, return_indices=True)
    if len(mine) < SHARED * min(len(one), len(other)):
        return 0.0, len(mine)
    values = one.known[mine], other.select(one.assets).known[its]
    found = []
    for first, second in zip(*(np.diff(np.log(each), axis=0).T for each in values), strict=True):
        known = np.isfinite(first) & np.isfinite(second)
        first, second = first[known], second[known]
        if len(first) >= FEWEST and first.std() and second.std():
            found.append(np.corrcoef(first, second)[0, 1])
    return float(np.median(found)) if found else 0.0, len(mine)
