"""Reports prices that stand still: of one asset while others move, or of all at once.

Illiquid stocks have unchanged days, and funds that are valued once a month stand still for weeks. A
spell of equal prices is therefore long only by the measure of its own asset, and rows on which
nothing moves, such as holidays, do not lengthen it.
"""

from collections.abc import Collection, Iterator
from typing import NamedTuple

import numpy as np

from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.findings import LISTED, Findings, day
from qfolio.portfolio.prices.gaps import Rest, fill_forward
from qfolio.portfolio.prices.grid import Grid

FEWEST = 20  # unchanged rows of a long spell: a month of days
UNUSUAL = 5.0  # times the unchanged rows of the asset's other spells …
USUAL = 0.9  # … of which shorter ones hold this share of its rows
IDLE = 0.02  # the share of rows on which nothing moves from which a note is due


class _Spell(NamedTuple):
    """A long spell of an unchanged price."""

    rows: int  # on which other assets move and this one does not
    asset: int
    start: int  # the first and the last row with this price
    end: int
    whole: bool  # whether the asset never had another price


def check_stale(
    grid: Grid, rest: Rest, findings: Findings, rates: Collection[int] = frozenset()
) -> None:
    """Report prices that no longer change, never did, or long did not, and rows without moves.

    rates: assets of the rest whose numbers may change rarely, because they seem to be no prices.
    """
    values, dates = rest.values, grid.dates[rest.head :]
    if len(values) <= FEWEST:
        return
    known = ~np.isnan(values)
    both = known[1:] & known[:-1]
    moves = both & (values[1:] != values[:-1])
    idle = ~moves.any(axis=1) & (both.sum(axis=1) > 1)  # an asset alone may stand still
    _report_idle(dates, idle, moves, both, findings)
    clock = np.concatenate([[0], np.cumsum(~idle)])
    spells = [each for each in _spells(known, changes(values), clock) if each.asset not in rates]
    last = len(values) - 1
    constant = [spell for spell in spells if spell.whole]
    _report_constant(grid, rest, constant, findings)
    ended = [spell for spell in spells if spell.end == last and not spell.whole]
    _report_ended(grid, rest, ended, findings)
    if others := [spell for spell in spells if spell.end < last and not spell.whole]:
        rows, j, start, end, _ = max(others)
        findings.note(
            f"{amount(len(others), 'long spell')} of an unchanged price; the "
            f"longest: {quote(grid.assets[rest.assets[j]])} from {day(dates[start])} to "
            f"{day(dates[end])} ({amount(rows, 'row')})",
            advice="If there was no trade, leave the cells empty and choose how to treat gaps "
            "(--missing, --late, --ended).",
        )


def changes(values: np.ndarray) -> np.ndarray:
    """Whether a price differs from the last one before it, of shape (rows − 1, assets)."""
    filled = fill_forward(values)
    return (filled[1:] != filled[:-1]) & ~np.isnan(filled[:-1])


def _spells(known: np.ndarray, moves: np.ndarray, clock: np.ndarray) -> Iterator[_Spell]:
    """The long spells, by asset and row.

    Args:
        known: Whether there is a price, of shape (rows, assets).
        moves: Whether it differs from the last one before it, of shape (rows − 1, assets).
        clock: The number of rows so far on which anything moves, of shape (rows,).
    """
    for j in np.flatnonzero(known.any(axis=0)).tolist():
        rows = np.flatnonzero(known[:, j])
        changes = np.flatnonzero(moves[:, j]) + 1
        starts, ends = np.append(rows[0], changes), np.append(changes - 1, rows[-1])
        unchanged = clock[ends] - clock[starts] if len(changes) else ends - starts
        for k in np.flatnonzero(unchanged >= _long(unchanged)).tolist():
            start, end = int(starts[k]), int(ends[k])
            yield _Spell(int(unchanged[k]), j, start, end, not len(changes))


def _long(unchanged: np.ndarray) -> float:
    """From how many unchanged rows on a spell is long for its asset.

    unchanged: those of each spell, in order. The longest and the last one set no measure.
    """
    others = np.sort(np.delete(unchanged, [int(unchanged.argmax()), len(unchanged) - 1]))
    if not len(others):
        return FEWEST
    rows = np.cumsum(others + 1)
    return max(FEWEST, UNUSUAL * float(others[np.searchsorted(rows, USUAL * rows[-1])]))


def _report_ended(grid: Grid, rest: Rest, spells: list[_Spell], findings: Findings) -> None:
    """A warning for each price that no longer changes, at the last row, which is traded."""
    last = len(rest.values) - 1
    for rows, j, start, *_ in spells[:LISTED]:
        column = int(rest.assets[j])
        findings.warn(
            f"{grid.subject(grid.prices, column)} has been {rest.values[last, j]:.6g} since "
            f"{day(grid.dates[rest.head + start])} ({amount(rows, 'row')}): "
            "perhaps the asset was delisted, and its last price carried forward",
            advice="If so, empty the cells after its last trade and choose ended='cash-out' "
            "(--ended); otherwise it can still be bought.",
            **grid.spot(grid.prices, rest.head + last, column),
        )
    said = " unchanged for long up to the last row"
    findings.others("warning", len(spells), "price", said, date=day(grid.dates[-1]))


def _report_constant(grid: Grid, rest: Rest, spells: list[_Spell], findings: Findings) -> None:
    for _, j, *_ in spells[:LISTED]:
        findings.warn(
            f"the price of {quote(grid.assets[rest.assets[j]])} never changes",
            advice="Remove the asset unless it is meant to earn nothing; cash needs no asset.",
        )
    findings.others("warning", len(spells), "price", " that never change")


def _report_idle(
    dates: np.ndarray, idle: np.ndarray, moves: np.ndarray, both: np.ndarray, findings: Findings
) -> None:
    """A note on rows on which no price moves, if there are more than chance makes."""
    share = float(idle.mean())
    chance = float((1 - moves.sum(axis=0) / np.maximum(both.sum(axis=0), 1)).prod())
    if share > chance + IDLE and (count := int(idle.sum())) > 1:
        first = day(dates[1 + int(idle.argmax())])
        findings.note(
            f"on {amount(count, 'row')} ({share:.1%}) no price moves, first on {first}: perhaps "
            "holidays, filled with the prices before",
            advice="If so, leave out these rows: nobody could trade on them, and figures per year "
            "count them as days of trading.",
        )
