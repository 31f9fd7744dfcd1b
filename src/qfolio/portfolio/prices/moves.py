"""Reports moves that no market makes: impossible ones, bad ticks and splits that were not adjusted.

A jump is a large move for its asset that the other assets do not share. One that reverts within a
few rows is a bad tick. One that persists, at a ratio at which companies split their shares, looks
like a split, or like another unit. Any other is left for the reader to judge, unless hardly any
price moves by as much, or it is about to be traded.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.text import amount, quote
from qfolio.portfolio.prices.findings import LISTED, Findings, day, first_of
from qfolio.portfolio.prices.frequency import periods_per_year
from qfolio.portfolio.prices.gaps import Rest
from qfolio.portfolio.prices.grid import Grid

LARGEST_MOVE = 1e6  # within one row; beyond it relatives and their products overflow float32
LEAST_JUMP = 0.3  # in log; the smallest split, 3/2, is 0.41
UNUSUAL = 6.0  # times the usual move of the asset, over the table and around the jump
AROUND = 30  # rows before and after a jump: in a crisis large moves are usual
TICKS = 10  # a jump of fewer price ticks says nothing: the next price above 0.02 is 0.03
BRIEF = 3  # rows that a bad tick lasts at most
SPLITS = (1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 40, 50, 100, 1000)
EXACT = 0.005  # how far a jump's ratio may be from one of these

# The price also moves on the day of a split. A ratio of whole numbers may therefore be further off:
# by so many times the asset's usual move, and by so much in log at most. Prices do fall by about
# one half at times; hardly ever do they fall to a third, or rise to its inverse.
HALF = (2.0, 0.035)
RARE = (6.0, 0.1)
ABSURD = 5.0  # a rise to so many times the price before is doubtful at any ratio; firms do fail

EMPTY_IT = "If so, correct it, or empty the cell and choose missing='forward-fill' (--missing)."

Jump = tuple[int, int]  # the row before the jump, and the asset


class Sorted(NamedTuple):
    """The moves of prices (rows × assets), and their jumps by what they look like.

    ticks: bad ticks, with the rows that they last. splits: with their ratios. others: the rest.
    """

    values: Floats
    relatives: Floats
    moves: Floats
    ticks: dict[Jump, int]
    splits: dict[Jump, str]
    others: list[Jump]


def sort_moves(values: Floats) -> Sorted:
    """Sorts out the jumps of prices; those that are missing or not positive are left out."""
    values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        relatives, logs = values[1:] / values[:-1], np.log(values)
    moves = np.diff(logs, axis=0)
    jumps = _jumps(values, moves, np.abs(moves))
    return Sorted(values, relatives, moves, *_sort_out(logs, moves, jumps))


def check_moves(grid: Grid, rest: Rest, findings: Findings) -> None:
    """Report impossible moves, bad ticks, likely splits and other jumps."""
    values, relatives, moves, ticks, splits, others = sort_moves(rest.values)
    sizes, dates = np.abs(moves), grid.dates[rest.head :]

    def spot(i: int, j: int) -> dict[str, Any]:
        return grid.spot(grid.prices, rest.head + i, int(rest.assets[j]))

    def subject(j: int) -> str:
        return grid.subject(grid.prices, int(rest.assets[j]))

    wild = np.argwhere(sizes > np.log(LARGEST_MOVE))  # NaN compares false
    for i, j in wild[:LISTED].tolist():
        findings.error(
            f"{subject(j)} goes from {values[i, j]:.6g} to {values[i + 1, j]:.6g} in one row",
            advice="Check the units of both prices.", **spot(i + 1, j),
        )  # fmt: skip
    findings.others("error", len(wild), "price", " that change by such factors")

    def warn(jumps: Iterable[Jump], say: Callable[[Jump], tuple[str, str]], *rest: str) -> None:
        """Warnings on the latest of some jumps, and the number of the others."""
        every = [(jump, spot(jump[0] + 1, jump[1])) for jump in jumps]
        for jump, where in every[-LISTED:]:
            said, advice = say(jump)
            message = f"{subject(jump[1])} is {relatives[jump]:.4g} times the one before{said}"
            findings.warn(message, advice=advice, **where)
        findings.older([where for _, where in every], *rest)

    def tick(jump: Jump) -> tuple[str, str]:
        spell = "in the next row" if ticks[jump] == 1 else f"{ticks[jump]} rows later"
        power = round(np.log10(relatives[jump]))
        misplaced = power and abs(moves[jump] - power * np.log(10)) < LEAST_JUMP
        how = ", a digit or the decimal mark misplaced" if misplaced else ""
        return f" and goes back {spell}: perhaps a wrong price{how}", EMPTY_IT

    def split(jump: Jump) -> tuple[str, str]:
        unit = splits[jump].strip("0") in ("1", "1/1")  # a power of ten
        return f", close to {splits[jump]}: perhaps a split that was not adjusted", (
            "If so, use adjusted prices; "
            + "if the unit changed, as from pence to pounds, convert it; " * unit
            + "if the price did move like this, leave it."
        )

    def doubt(jump: Jump) -> tuple[str, str]:
        return (
            ", which neither other assets nor a usual split explain: perhaps a wrong price",
            "If so, correct it; if the price did move like this, leave it.",
        )

    newest = len(moves) - max(1, round(periods_per_year(dates) / 12))  # the last month begins
    doubtful = [jump for jump in others if jump[0] >= newest or moves[jump] > np.log(ABSURD)]
    warn(ticks, tick, "price", "that may be wrong")
    warn(splits, split, "move", "that may be splits")
    warn(doubtful, doubt, "move", "that nothing explains")
    others = sorted(set(others) - set(doubtful), key=lambda jump: -sizes[jump])
    if others:
        (i, j), *further = others
        more = first_of(
            (
                f"{quote(grid.assets[rest.assets[b]])} on {day(dates[a + 1])} "
                f"({relatives[a, b]:.4g})"
                for a, b in further
            ),
            LISTED - 1,
        )
        findings.note(
            f"{amount(len(others), 'large move')} that neither other assets nor a split explain; "
            f"the largest: {subject(j)} on {day(dates[i + 1])} is {relatives[i, j]:.4g} times the "
            "one before" + f", then {more}" * bool(more),
            advice="Check them: a split on a day on which the price also moved looks like this.",
            **spot(i + 1, j),
            count=len(others),
            cells=tuple(spot(a + 1, b) for a, b in others),
        )


def _jumps(values: np.ndarray, moves: np.ndarray, sizes: np.ndarray) -> list[Jump]:
    """Moves that are large for their asset and that most others do not share, by row."""
    jumps = sizes > LEAST_JUMP
    for j in np.flatnonzero(jumps.any(axis=0)).tolist():
        usual = _usual(sizes[:, j])
        steps = np.abs(np.diff(values[:, j]))
        tick = steps[steps > 0].min()
        jumps[:, j] &= (sizes[:, j] > UNUSUAL * usual) & (steps / (TICKS - 0.5) > tick)
        for i in np.flatnonzero(jumps[:, j]).tolist():
            around = sizes[max(i - AROUND, 0) : i + AROUND + 1, j]
            jumps[i, j] = sizes[i, j] > UNUSUAL * float(np.nanmedian(around)) / 0.6745
    for i in np.flatnonzero(jumps.any(axis=1)).tolist():
        known = np.sort(moves[i][~np.isnan(moves[i])])
        where = np.flatnonzero(jumps[i])
        half = moves[i, where] / 2
        above = len(known) - np.searchsorted(known, half)
        as_far = np.where(half > 0, above, np.searchsorted(known, half, "right"))
        others = len(known) - 1
        jumps[i, where] &= (as_far - 1 < others / 2) | (others == 0)
    return [(i, j) for i, j in np.argwhere(jumps).tolist()]


def _sort_out(
    logs: np.ndarray, moves: np.ndarray, jumps: Iterable[Jump]
) -> tuple[dict[Jump, int], dict[Jump, str], list[Jump]]:
    """Bad ticks with the number of rows that they last, splits with their ratios, other jumps."""
    ticks: dict[Jump, int] = {}
    splits: dict[Jump, str] = {}
    others: list[Jump] = []
    sound: dict[int, int] = {}  # the first row after the last bad tick, by asset
    ratios = np.log(np.array(SPLITS))
    for i, j in jumps:
        if i < sound.get(j, 0):
            continue  # the way back
        jump = moves[i, j]
        after = logs[i + 2 : i + 2 + BRIEF, j]
        back = (np.abs(after - logs[i, j]) < abs(jump) / 4) & (
            -moves[i + 1 : i + 1 + len(after), j] * np.sign(jump) > abs(jump) / 2
        )
        if back.any():
            rows = int(back.argmax()) + 1
            ticks[i, j] = rows
            sound[j] = i + 1 + rows
            continue
        distances = np.abs(ratios - abs(jump))
        fits = distances <= _tolerances(_usual(np.abs(moves[:, j])), jump > 0)
        if fits.any():
            closest = int(np.where(fits, distances, np.inf).argmin())
            splits[i, j] = _ratio(SPLITS[closest], jump > 0)
        else:
            others.append((i, j))
    return ticks, splits, others


def _tolerances(usual: float, up: bool) -> np.ndarray:
    """How far a jump of an asset with this usual move may be from each of the ratios, in log."""

    def loose(split: float) -> float:
        # Prices rise to about the double in takeovers, and fall by about a third on bad news.
        if split % 1 or (up and split < 3):
            return 0.0
        times, most = RARE if split >= 3 else HALF
        return min(times * usual, most)

    return np.array([max(np.log1p(EXACT), loose(split)) for split in SPLITS])


def _usual(sizes: np.ndarray) -> float:
    """The deviation of moves of these sizes, by their median, which jumps leave as it is."""
    return float(np.median(sizes[sizes > 0])) / 0.6745


def _ratio(split: float, up: bool) -> str:
    over, under = (int(2 * split), 2) if split % 1 else (int(split), 1)
    over, under = (over, under) if up else (under, over)
    return str(over) if under == 1 else f"{over}/{under}"
