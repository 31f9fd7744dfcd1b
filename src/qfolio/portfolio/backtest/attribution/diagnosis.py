"""Diagnoses dead agents in plain sentences: they never trade, hold one asset, or see nothing.

It also says where an agent is compared with the idle cash of its reference.
"""

from collections.abc import Sequence

import numpy as np

from qfolio.core.text import figure
from qfolio.portfolio.backtest.replay import Entry

STILL = 1e-6
"""Turnover of a row up to which nothing counts as traded; the agents compute in float32."""

SAME = 1e-4
"""Target weights that differ by less count as the same."""

ALONE = 0.99
"""Weight above which an asset is held alone, and the share of days on which it has to be."""

IDLE = 0.02
"""Mean weight of cash by which a reference exceeds an agent, from which on this is said."""


def diagnose(
    name: str,
    entry: Entry,
    folds: Sequence[slice],
    assets: Sequence[str],
    ignored: bool,
    anchor: str = "",
) -> list[str]:
    """Sentences about a strategy that does nothing with what it observes; usually none.

    Args:
        name: Name of the strategy.
        entry: The strategy's decisions and their replay.
        folds: The days of each fold.
        assets: Names of the assets.
        ignored: Whether its targets stay the same when all that it observes is shuffled.
        anchor: What its targets depart from (default: nothing).
    """
    seeds = len(entry.decisions)
    found = [_dead(entry, seed, folds, assets) for seed in range(seeds)]
    sentences = []
    for what in dict.fromkeys(each for each in found if each):
        count = found.count(what)
        who = name if count == seeds else f"{count} of {seeds} seeds of {name}"
        sentences.append(f"{who} {what}.")
    if ignored:
        # An agent that is dead in another way did not weigh whether to leave its anchor.
        stays = anchor and not sentences
        what = f"found no reason to leave {anchor}" if stays else "ignored what it observed"
        sentences.append(
            f"{name} {what}: its targets did not change when all that it observed was shuffled."
        )
    return sentences


def idle(name: str, entry: Entry, reference: str, other: Entry) -> list[str]:
    """A sentence if the reference holds more cash than the strategy, as a mandate may force it to.

    Args:
        name: Name of the strategy.
        entry: Its replay.
        reference: Name of the reference.
        other: The reference's replay.
    """
    held, theirs = (each.simulation.weights[..., 0].mean() for each in (entry, other))
    if not theirs - held >= IDLE:
        return []
    return [
        f"{reference} held {figure(theirs, '.0%')} of its wealth in cash on average, and {name} "
        f"{figure(held, '.0%')}: part of the difference between them is what the market earned."
    ]


def _dead(entry: Entry, seed: int, folds: Sequence[slice], assets: Sequence[str]) -> str:
    """What one seed did all the time; empty if it did different things."""
    moved = np.flatnonzero(entry.simulation.turnover[seed] > STILL)
    weights, targets = entry.simulation.weights[seed], entry.decisions[seed]
    if not len(moved):
        return "never traded and stayed in cash"
    if len(moved) == 1:
        return "traded once and never again"
    alone = (weights > ALONE).mean(0)
    if alone.max() >= ALONE:
        return f"always held {('cash', *assets)[alone.argmax()]} alone"
    if all(_same(targets[days]) for days in folds):
        whole = _same(targets)
        return "ordered the same weights at every row" + (
            "" if whole else " of a fold, in each of the folds"
        )
    return ""


def _same(targets: np.ndarray) -> bool:
    """Whether all orders are the same; rows of NaN are not orders."""
    given = targets[~np.isnan(targets[:, 0])]
    return not len(given) or bool(np.ptp(given, axis=0).max() < SAME)
