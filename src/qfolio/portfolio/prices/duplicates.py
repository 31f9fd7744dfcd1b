"""Reports assets with the same returns: one asset under two names, or in two units.

Index funds and share classes move nearly alike, but not to the last digit that is printed. Only
assets that grow by nearly the same in several periods are compared row by row, so that a table of a
thousand assets takes no time.
"""

import numpy as np

from qfolio.core.text import quote
from qfolio.portfolio.prices.findings import LISTED, Findings, first_of
from qfolio.portfolio.prices.gaps import Rest
from qfolio.portfolio.prices.grid import Grid

PERIODS, NEIGHBORS = 32, 3
CLOSE = 1e-3  # in log: how far the growth of such assets in a period may differ, by rounding
FEWEST = 20  # rows on which they must move
NEARLY_ALL = 0.99  # of these rows
NOISE = 1e-6  # of returns from prices in single precision
CLEAR = 10.0  # how many times its rounding a usual move must be for rounding to be allowed for
DECIMALS = 6  # with which prices are printed at most


def check_duplicates(grid: Grid, rest: Rest, findings: Findings) -> None:
    """Report assets whose returns are the same on nearly all rows, up to the prices' rounding."""
    if len(rest.values) <= FEWEST:
        return
    values = np.where(np.isfinite(rest.values) & (rest.values > 0), rest.values, np.nan)
    names = [quote(grid.assets[j]) for j in rest.assets]
    group = np.arange(len(names))  # the first of the assets with the same returns
    for i, j in _candidates(values):
        if group[i] != group[j] and _same(values[:, i], values[:, j]):
            group[group == max(group[i], group[j])] = min(group[i], group[j])
    found = [j for j in np.unique(group).tolist() if (group == j).sum() > 1]
    for first in found[:LISTED]:
        members = np.flatnonzero(group == first).tolist()
        if len(members) > 2:
            said = f"{first_of(names[j] for j in members)} have the same returns"
        else:
            one, other = members
            said = _both(names[one], names[other], values[:, other] / values[:, one])
        findings.warn(
            f"{said}: perhaps one asset under {'two' if len(members) == 2 else 'several'} names",
            advice="If so, keep one: equal weights and caps count each name.",
        )
    findings.others("warning", len(found), "group", " of assets with equal returns")


def _both(one: str, other: str, ratios: np.ndarray) -> str:
    """What two assets with the same returns share, in words; ratios: of their prices."""
    ratio = float(np.nanmedian(ratios))
    if abs(ratio - 1) <= NOISE:
        return f"{one} and {other} have the same prices"
    return f"{other} has the returns of {one}, at {ratio:.6g} times its price"


def _candidates(values: np.ndarray) -> list[tuple[int, int]]:
    """Assets that grow by nearly the same in at least half of the periods in which either moves.

    Sorted by their growth in a period, such assets are neighbors.
    """
    logs = np.log(values)
    moves = np.abs(np.diff(logs, axis=0))
    usual = np.nansum(moves, axis=0) / np.maximum((~np.isnan(moves)).sum(axis=0), 1)
    ends = np.unique(np.linspace(0, len(values) - 1, PERIODS + 1).round().astype(int))
    growth = np.diff(logs[ends], axis=0)  # (periods, assets)
    pairs = []
    for each in growth:
        order = np.argsort(each)  # NaN last
        for step in range(1, NEIGHBORS + 1):
            near = each[order[step:]] - each[order[:-step]] < CLOSE
            pairs.append(np.sort(np.stack([order[:-step][near], order[step:][near]]), axis=0))
    found = np.unique(np.concatenate(pairs, axis=1), axis=1)
    one, other = found
    apart = np.abs(growth[:, one] - growth[:, other])
    telling = ~np.isnan(apart) & ((growth[:, one] != 0) | (growth[:, other] != 0))
    near = telling & (apart < np.minimum(CLOSE, np.minimum(usual[one], usual[other]) / 5))
    likely = near.sum(axis=0) >= np.maximum(1, telling.sum(axis=0) / 2)
    return [(i, j) for i, j in found[:, likely].T.tolist()]


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two assets have the same moves on nearly all rows on which either moves."""
    both = ~np.isnan(one) & ~np.isnan(other)
    one, other = one[both], other[both]
    moves, others = np.diff(np.log(one)), np.diff(np.log(other))
    moving = (moves != 0) | (others != 0)
    if moving.sum() < FEWEST:
        return False
    usual = float(np.median(np.maximum(np.abs(moves), np.abs(others))[moving]))
    rounding = (_unit(one) / one + _unit(other) / other)[1:]
    if usual < CLEAR * float(np.median(rounding)):
        rounding *= 0  # such moves look alike by their rounding alone
    equal = np.abs(moves - others) <= min(NOISE, usual / 10_000) + rounding
    return bool(equal[moving].mean() >= NEARLY_ALL)


def _unit(prices: np.ndarray) -> float:
    """The last printed digit of prices; 0 if they were not rounded."""
    for decimals in range(DECIMALS + 1):
        if np.array_equal(np.round(prices, decimals), prices):
            return float(10.0**-decimals)
    return 0.0
